"""`popgen compare`."""

from __future__ import annotations

import argparse
from contextlib import closing
from typing import Any

from popgen.cli.arguments import add_command, add_config_dir, at_least, finite, named_path, words
from popgen.cli.printing import OK, print_json, print_report
from popgen.cli.training import runs_to_start


def add(commands: Any) -> None:
    """`compare`."""
    parser = add_command(
        commands,
        "compare",
        compare,
        "environment steps, time, SP/XP and steps to equal quality of finished runs, against the number of agents",
        "Runs of one method and environment are its seeds. Keys of --json: those of "
        "popgen/reports/comparison_report (runs, costs, scores, quality, budgets, notes), files and tracking (command, "
        "address).",
    )
    parser.add_argument(
        "runs", nargs="*", type=named_path, metavar="[NAME=]RUN", help="a run's folder, called NAME and not its method"
    )
    parser.add_argument(
        *("--start", "-s"),
        action="append",
        type=words,
        default=[],
        metavar="'KEY=VALUE ...'",
        help="run this first (as `popgen run`), in DIR/runs, unless it is finished there; label=NAME calls it NAME",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="for every --start whose method has it"
    )
    parser.add_argument("--agents", type=at_least(1), default=None, help="extrapolate costs that grow to this many")
    told = "of the held evaluation, for each member and for each pair and seating (%(default)s)"
    parser.add_argument("--episodes", type=at_least(1), default=20, help=told)
    for name, which in (("--sp", "SP of at least"), ("--xp", "XP of at most")):
        told = f"equal quality: {which} this (0.8 and 0.2 of the SP of the paper's XPM-WM on the layout)"
        parser.add_argument(name, type=finite, default=None, metavar="SCORE", help=told)
    parser.add_argument("--out", default="comparison", metavar="DIR", help="of the report (%(default)s)")
    parser.add_argument("--tracking-uri", default=None, metavar="URI", help="of MLflow (sqlite in DIR)")
    parser.add_argument("--no-tracking", action="store_true", help="no MLflow")
    add_config_dir(parser)


def compare(args: argparse.Namespace) -> int:
    """Start what is asked for, and compare all runs."""
    labels = [next((w.partition("=")[2] for w in words if w.startswith("label=")), None) for words in args.start]
    overrides = [[*(word for word in words if not word.startswith("label=")), *args.set] for words in args.start]
    configs = runs_to_start(overrides, args.out, args.set, args.config_dir, quiet=args.quiet)
    from popgen.config.sections import TrackingConfig
    from popgen.pipelines.compare import EXPERIMENT, compare_runs
    from popgen.progress import make_reporter
    from popgen.reports.comparison_report import to_sheets
    from popgen.runs.tracking_address import check_uri

    tracking = TrackingConfig(enabled=not args.no_tracking, uri=args.tracking_uri, experiment=EXPERIMENT)
    check_uri(tracking.uri)
    with closing(make_reporter(quiet=args.quiet)) as reporter:
        report = compare_runs(
            *(args.runs, list(zip(labels, configs, strict=True)), args.out),
            agents=args.agents,
            episodes=args.episodes,
            sp=args.sp,
            xp=args.xp,
            tracking=tracking,
            reporter=reporter,
        )
    if args.json:
        print_json(report)
        return OK
    print_report(to_sheets(report), report["notes"], args.out, report["files"])
    if shown := report["tracking"]:
        print("mlflow: " + "\n        ".join(line for line in (shown["command"], shown["address"]) if line))
    return OK
