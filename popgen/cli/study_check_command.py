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
        "prove that the rules in the browser are the simulator's",
        "Plays all recorded transitions of people, and random ones in every layout and cooking mode, in JavaScript "
        "(Node, or a headless browser) and in the simulator: next states, rewards, ends, events and observations must "
        "be equal. Ends with code 2 where one is not. Keys of --json: engine, kitchens (layout, cooking, source, "
        "transitions, differing), transitions, differing.",
    )
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
        rows = [{"source": source, **asdict(found)} for source, found in _check_rules(engine, args)]
    transitions, differing = (sum(row[key] for row in rows) for key in ("transitions", "differing"))
    if args.json:
        print_json({"engine": engine.name, "kitchens": rows, "transitions": transitions, "differing": differing})
    else:
        for row in rows:
            if row["differing"]:
                print(f"{row['layout']}, {row['cooking']}, {row['source']}: {row['differing']:,} transitions differ")
        counted = {source: sum(row["transitions"] for row in rows if row["source"] == source) for source in _SOURCES}
        told = ", ".join(f"{count:,} {source}" for source, count in counted.items())
        print(f"{engine.name}: {len(rows)} kitchens, transitions: {told}; {differing:,} differ")
    return ERROR if differing else OK


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
