"""`popgen experiment WHICH`: an experiment of the paper."""

from __future__ import annotations

import argparse
from contextlib import closing
from typing import Any

from popgen.cli.arguments import Parser, add_command, add_config_dir, at_least, label_and_path, numbers
from popgen.cli.printing import OK, print_json, print_report
from popgen.cli.training import runs_to_start
from popgen.errors import UserError


def add(commands: Any) -> None:
    """`experiment self-sabotage` and `experiment shared-encoder`."""
    experiment = commands.add_parser(
        "experiment", help="an experiment of the paper", description="An experiment of the paper."
    )
    kinds = experiment.add_subparsers(title="experiments", metavar="WHICH", required=True, parser_class=Parser)
    _add_self_sabotage(kinds)
    _add_shared_encoder(kinds)


def _add_self_sabotage(kinds: Any) -> None:
    parser = add_command(
        kinds,
        "self-sabotage",
        self_sabotage,
        "who leaves the task in cross-play: self-play, XPM-Sim, LIPO and CoMeDi on rendezvous, beside the paper's "
        "first table",
        "Without --population every row is trained, 8 agents each, in DIR/runs (what is finished there is not trained "
        "again, what was interrupted goes on); overrides are those of `popgen run`. A row is a method, or one with one "
        "of its objectives: self-play, paper, or ours, which has the same further options in every method. Keys of "
        "--json: those of popgen/reports/sabotage_report.py (rows, means, paper, steps, ...) and files.",
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings of what is trained")
    parser.add_argument(
        "--population",
        type=label_and_path,
        action="append",
        default=[],
        metavar="METHOD=PATH",
        help="a finished population or run",
    )
    parser.add_argument(
        "--method",
        action="append",
        default=[],
        metavar="METHOD[:OBJECTIVE]",
        help="a row to train, such as xpm_sim:paper (every row)",
    )
    add_config_dir(parser)
    parser.add_argument(
        "--termination",
        choices=("penalty", "plain", "both"),
        default="penalty",
        help="what an exit costs in training: the worst reward for every step left, nothing, or both (%(default)s)",
    )
    parser.add_argument("--seeds", type=numbers, default=[1], metavar="1,2,...", help="of training (1)")
    parser.add_argument("--episodes", type=at_least(1), default=20, help="per ordered pair (%(default)s)")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the evaluation (%(default)s)")
    parser.add_argument("--out", default="self-sabotage", metavar="DIR", help="of the report (%(default)s)")


def _add_shared_encoder(kinds: Any) -> None:
    parser = add_command(
        kinds,
        "shared-encoder",
        shared_encoder,
        "learning curves of XPM-Sim's later members on rendezvous, with and without an encoder shared by all members",
        "Without --run both kinds are trained, 8 agents each, in DIR/runs (what is finished there is not trained "
        "again); overrides are those of `popgen run`. Keys of --json: those of popgen/reports/shared_encoder_report.py "
        "(curves, environment, unit, runs) and files.",
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings of what is trained")
    parser.add_argument("--run", action="append", default=[], metavar="DIR", help="a finished run of either kind")
    parser.add_argument("--seeds", type=numbers, default=[1], metavar="1,2,...", help="of training (1)")
    parser.add_argument("--out", default="shared-encoder", metavar="DIR", help="of the report (%(default)s)")
    add_config_dir(parser)


def self_sabotage(args: argparse.Namespace) -> int:
    """Train what is not given, and tell who leaves the task in cross-play."""
    from popgen.methods.registry import find_objective, list_objectives

    rows = args.method or ([] if args.population else list_objectives())
    objectives = {row: find_objective(row) for row in rows}
    if args.overrides and not rows:
        raise UserError("overrides", "have no use where nothing is trained", "name what to train with --method")
    from popgen.reports.sabotage_report import NOTES, TERMINATIONS, summary, to_sheets

    rules = list(TERMINATIONS) if args.termination == "both" else [args.termination]
    base = [*_rendezvous(args.overrides), "population.size=8", *args.overrides]
    penalties = [f"env.params.exit_penalty={TERMINATIONS[rule]['exit_penalty']}" for rule in rules]
    asked = [(row, penalty, seed) for penalty in penalties for seed in args.seeds for row in rows]
    overrides = []
    for row, penalty, seed in asked:
        changes = [f"{name}={'null' if value is None else value}" for name, value in objectives[row].items()]
        method = row.partition(":")[0]
        overrides.append([*base, f"method={method}", *changes, *args.overrides, penalty, f"seed={seed}"])
    configs = runs_to_start(overrides, args.out, args.overrides, args.config_dir, quiet=args.quiet)
    starts = [(row, config) for (row, *_), config in zip(asked, configs, strict=True)]
    from popgen.pipelines import experiments
    from popgen.progress import make_reporter

    with closing(make_reporter(quiet=args.quiet)) as reporter:
        report = experiments.self_sabotage(
            args.population, starts, args.out, episodes=args.episodes, seed=args.seed, reporter=reporter
        )
    if args.json:
        print_json(report)
        return OK
    print_report(to_sheets(report), [*NOTES, *summary(report)], args.out, report["files"])
    return OK


def shared_encoder(args: argparse.Namespace) -> int:
    """Train both kinds, unless runs are given, and draw their learning curves."""
    if args.overrides and args.run:
        raise UserError("overrides", "have no use where nothing is trained", "leave out --run")
    from popgen.methods.xpm_sim.config import XpmSimRun

    base = [*_rendezvous(args.overrides), XpmSimRun.method_override(), "population.size=8", *args.overrides]
    kinds = [] if args.run else ["none", "shared"]
    overrides = [[*base, f"xpm_sim.encoder={kind}", f"seed={seed}"] for seed in args.seeds for kind in kinds]
    configs = runs_to_start(overrides, args.out, args.overrides, args.config_dir, quiet=args.quiet)
    from popgen.pipelines.shared_encoder_experiment import shared_encoder as ablation
    from popgen.progress import make_reporter
    from popgen.reports.shared_encoder_report import summary

    with closing(make_reporter(quiet=args.quiet)) as reporter:
        report = ablation(args.run, configs, args.out, reporter=reporter)
    if args.json:
        print_json(report)
        return OK
    print_report([], summary(report), args.out, report["files"])
    return OK


def _rendezvous(overrides: list[str]) -> list[str]:
    """The paper's task, unless another is asked for."""
    return [] if any(word.startswith("env=") for word in overrides) else ["env=rendezvous/mppmr"]
