"""`popgen study check-browser`."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from popgen.cli.arguments import add_command, at_least
from popgen.cli.printing import ERROR, OK, print_json
from popgen.cli.training import bound_threads

PEOPLE = "people"


def add(kinds: Any) -> None:
    """`study check-browser`."""
    check = add_command(
        kinds,
        "check-browser",
        check_browser,
        "prove that rules and egos in the browser do what they do here",
        "Plays all recorded transitions of people, and random ones in every layout and cooking mode, in JavaScript "
        "(Node, or a headless browser) and in the simulator: next states, rewards, ends, events and observations must "
        "be equal. With --ego it plays games of these members instead: actions and probabilities must be those of "
        "their programs here to the last bit; `network` counts actions that PyTorch's float32 would not take at the "
        "same random number. Ends with code 2 where something differs. Keys of --json: engine, kitchens (layout, "
        "cooking, source, transitions, differing), transitions, egos (ego, states, differing, network, furthest), "
        "differing.",
    )
    check.add_argument("--ego", metavar="POPULATION[:MEMBER]", action="append", default=[], help="may be repeated")
    check.add_argument("--states", type=at_least(1), default=10_000, help="of each ego, whole games (%(default)s)")
    check.add_argument("--layout", action="append", metavar="NAME", help="of overcooked_ai; all by default")
    check.add_argument("--transitions", type=at_least(1), default=1_000_000, help="random ones in all (%(default)s)")
    check.add_argument("--no-people", action="store_true", help="leave the recorded transitions out")
    check.add_argument("--engine", metavar="PROGRAM", default=None, help="Node or Chromium; what is installed")
    check.add_argument("--seed", type=at_least(0), default=0, help="of random transitions (%(default)s)")


def check_browser(args: argparse.Namespace) -> int:
    """Play in both, compare and print."""
    bound_threads(1)
    from dataclasses import asdict

    from popgen.study.script_engine import open_engine

    with open_engine(args.engine) as engine:
        egos = [{"ego": name, **asdict(_check_member(engine, name, args))} for name in args.ego]
        checked = [] if egos else _check_rules(engine, args)
        rows = [{"source": source, **asdict(found)} for source, found in checked]
    transitions = sum(row["transitions"] for row in rows)
    differing = sum(row["differing"] for row in (*rows, *egos))
    if args.json:
        told = {"engine": engine.name, "kitchens": rows, "transitions": transitions, "egos": egos}
        print_json({**told, "differing": differing})
    else:
        _print_kitchens(engine.name, rows)
        for one in egos:
            beside = "" if one["network"] is None else f", {one['network']} from the network's in float32"
            print(f"{one['ego']}: {one['states']:,} states, {one['differing']} differ{beside}")
    return ERROR if differing else OK


def _print_kitchens(engine: str, rows: list[dict[str, Any]]) -> None:
    for row in rows:
        if row["differing"]:
            print(f"{row['layout']}, {row['cooking']}, {row['source']}: {row['differing']:,} transitions differ")
    if rows:
        counted = {source: sum(row["transitions"] for row in rows if row["source"] == source) for source in _SOURCES}
        told = ", ".join(f"{count:,} {source}" for source, count in counted.items())
        differing = sum(row["differing"] for row in rows)
        print(f"{engine}: {len(rows)} kitchens, transitions: {told}; {differing:,} differ")


_SOURCES = ("random", PEOPLE)


def _check_rules(engine: Any, args: argparse.Namespace) -> Any:
    """(source, what was found) of each kitchen."""
    import numpy as np

    from popgen.humans.recordings import LAYOUTS, load_games
    from popgen.study.browser_check import check_transitions, draw_transitions, list_recorded, open_kitchens

    envs = list(open_kitchens(args.layout))
    seeds = np.random.SeedSequence(args.seed).spawn(len(envs))
    each = -(-args.transitions // len(envs))
    for number, (env, seed) in enumerate(zip(envs, seeds, strict=True), start=1):
        yield "random", check_transitions(engine, env, draw_transitions(env, each, np.random.default_rng(seed)))
        if not args.quiet and number % 10 == 0:
            print(f"{number} of {len(envs)} kitchens", file=sys.stderr, flush=True)
    known = [layout for layout in LAYOUTS if args.layout is None or layout in args.layout]
    if known and not args.no_people:
        for env, played in list_recorded(load_games(layouts=known)):
            yield PEOPLE, check_transitions(engine, env, played)


def _check_member(engine: Any, name: str, args: argparse.Namespace) -> Any:
    """An ego in whole games."""
    from popgen.errors import UserError
    from popgen.population import load_population
    from popgen.study.browser_check import check_ego
    from popgen.study.study_definition import check_kitchen

    path, colon, member = name.rpartition(":")
    path, number = (path, int(member)) if colon and member.isdecimal() else (name, 1)
    population = load_population(path)
    env = check_kitchen(population)
    if not 1 <= number <= len(population):
        raise UserError("--ego", f"{path} has no member {number}", f"it has {len(population)}")
    try:
        return check_ego(engine, env, population[number], -(-args.states // env.horizon), args.seed)
    except ValueError as error:
        raise UserError("--ego", f"{name}: {error}", "leave it out") from None
