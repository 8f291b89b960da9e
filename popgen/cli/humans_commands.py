"""`popgen humans fit` and `show`."""

from __future__ import annotations

import argparse
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from popgen.cli.arguments import Parser, add_command, at_least
from popgen.cli.output_places import check_report_folder
from popgen.cli.printing import OK, print_json
from popgen.cli.training import bound_threads


def add(commands: Any) -> None:
    """`humans fit` and `humans show`."""
    humans = commands.add_parser("humans", help="clones of recorded people", description="Clones of recorded people.")
    kinds = humans.add_subparsers(title="what to do", metavar="WHAT", required=True, parser_class=Parser)
    fit = add_command(
        kinds,
        "fit",
        fit_humans,
        "clone the people whose games overcooked-ai brings, a population for each layout and half",
        "Half A (train games) is for training with, half B (test games) is held out. Keys of --json: out, seconds, "
        "populations (layout, half, path, dishes, within, cells, likelihood).",
    )
    fit.add_argument("--half", choices=("A", "B"), action="append", help="both by default")
    fit.add_argument("--seed", type=at_least(0), default=0, help="of the first member (%(default)s)")
    fit.add_argument("--members", type=at_least(1), default=1, help="of each population (%(default)s)")
    show = add_command(
        kinds,
        "show",
        show_humans,
        "what people did, and their clones beside them",
        "Keys of --json: layouts, each with layout, games, joint_steps, people (mean, deviation), clones (by half: "
        "mean, within, dishes, likelihood) and published_dishes (by half).",
    )
    for parser in (fit, show):
        parser.add_argument("--layout", action="append", metavar="NAME", help="may be repeated; all five by default")
        parser.add_argument("--out", default="humans", metavar="DIR", help="of the populations (%(default)s)")


def fit_humans(args: argparse.Namespace) -> int:
    """Fit and write all that is asked for."""
    bound_threads(1)
    from popgen.humans.behaviour import MEASURES, team_dishes
    from popgen.humans.humans_report import population_folder
    from popgen.humans.proxies import HALVES, fit_population
    from popgen.humans.recordings import LAYOUTS, load_games, make_human_env
    from popgen.progress import make_reporter

    layouts, halves = args.layout or list(LAYOUTS), args.half or list(HALVES)
    for layout in layouts:
        make_human_env(layout)
    check_report_folder(Path(args.out), quiet=True)
    began, written = time.perf_counter(), []
    games = load_games([HALVES[half] for half in halves], layouts)
    with closing(make_reporter(quiet=args.quiet)) as reporter:
        for layout, half in [(layout, half) for layout in layouts for half in halves]:
            reporter.phase(f"{layout} {half}", 1)
            path = population_folder(args.out, layout, half)
            own = [game for game in games if game.layout == layout and game.half == HALVES[half]]
            proxies = fit_population(
                path, layout, half, seed=args.seed, members=args.members, games=own, tell=reporter.update
            )
            figures = {"dishes": team_dishes(proxies[0].clone), "within": proxies[0].agreement.within}
            figures |= {"cells": len(MEASURES), "likelihood": proxies[0].likelihood}
            written.append({"layout": layout, "half": half, "path": str(path), **figures})
            if not args.json:
                print(
                    f"{path}: {figures['dishes']:.2f} dishes, {figures['within']} of {figures['cells']} "
                    f"within 1 SD of half {half}'s people",
                    flush=True,
                )
    seconds = time.perf_counter() - began
    if args.json:
        print_json({"out": args.out, "seconds": seconds, "populations": written})
    else:
        print(f"{len(written)} populations in {seconds:.0f} s")
    return OK


def show_humans(args: argparse.Namespace) -> int:
    """Print people's rates and their clones'."""
    from rich.console import Console

    from popgen.humans.humans_report import report_layouts, to_lines, to_tables
    from popgen.humans.recordings import LAYOUTS

    reports = report_layouts(args.out, args.layout or list(LAYOUTS))
    if args.json:
        print_json({"layouts": [report.as_dict() for report in reports]})
        return OK
    console = Console(width=80)
    for table in to_tables(reports):
        console.print(table)
    for line in to_lines(reports):
        console.print(line, highlight=False)
    return OK
