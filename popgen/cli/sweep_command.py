"""`popgen sweep`: many runs in one command, and one table of all."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popgen.cli.arguments import add_command, add_config_dir, at_least
from popgen.cli.compose import SweepAxis, parse_axis
from popgen.cli.printing import OK, print_json, print_report, tell_notes
from popgen.cli.training import leave_out_foreign, runs_to_start
from popgen.errors import UserError

if TYPE_CHECKING:
    from popgen.config.run_config import RunConfig

SEED = "run.seed"
MOST_RUNS = 10_000


def add(commands: Any) -> None:
    """`sweep`."""
    parser = add_command(
        commands,
        "sweep",
        sweep,
        "many runs on Ray Tune: seeds, grids and searches over any setting, methods and layouts",
        "A setting with several values makes a grid: seed=1,2,3, seed=range(1,6), method=xpm_wm,lipo. One with a range "
        "is searched: agent.lambda_xp=interval(0.1,0.5), 'agent.actor_lr=tag(log,interval(1e-4,1e-2))', "
        "'agent.horizon=int(interval(5,20))'; --samples points are drawn for each point of the grid. A setting that a "
        "method lacks is left out for it. As many runs as find room go on at a time. The same command goes on where a "
        "sweep ended: finished runs stay, interrupted ones continue from their last checkpoints. Exit code 2 if a run "
        "failed; the others are in the table. Keys of --json: those of popgen/reports/sweep_report.py (varied, runs, "
        "groups, best, missing) and files.",
    )
    parser.add_argument("overrides", nargs="+", metavar="KEY=VALUES", help="settings, as for `popgen run`")
    parser.add_argument("--out", default="sweep", metavar="DIR", help="of the runs and the report (%(default)s)")
    parser.add_argument(
        "--samples", type=at_least(1), default=8, metavar="N", help="points drawn from ranges (%(default)s)"
    )
    parser.add_argument("--draw-seed", type=at_least(0), default=0, metavar="N", help="of these draws (%(default)s)")
    parser.add_argument(
        "--concurrent", type=at_least(1), default=None, metavar="N", help="runs at a time at most (as find room)"
    )
    add_config_dir(parser)


def sweep(args: argparse.Namespace) -> int:
    """Plan all runs, check them, run what is not finished, and print the table."""
    axes = [axis for axis in map(parse_axis, args.overrides) if axis is not None]
    fixed = [word for word in args.overrides if parse_axis(word) is None]
    words = list_runs(fixed, axes, args.samples, args.draw_seed)
    notes: dict[str, None] = {}
    shared = list(dict.fromkeys(word for own in words for word in own))
    kept = leave_out_foreign(words, shared, args.config_dir, notes)
    unique = [list(own) for own in dict.fromkeys(map(tuple, kept))]  # an axis that a method lacks
    if not args.quiet:
        tell_notes(_first_of_each_key(notes))
    configs = runs_to_start(unique, args.out, (), args.config_dir, quiet=args.quiet)
    varied = [axis.key for axis in axes if axis.key not in ("method", "env", SEED)]
    report = _run_trials(args, [(config, own) for config, own in zip(configs, unique, strict=True)], varied)
    if args.json:
        print_json(report)
    elif report["runs"]:
        from popgen.reports.sweep_report import summary, to_sheets

        print_report(to_sheets(report), summary(report), args.out, report["files"])
    if report["missing"]:
        first = report["missing"][0]
        problem = f"{len(report['missing'])} of {len(configs)} runs did not finish, {first['id']}: {first['error']}"
        raise UserError("sweep", problem, "repair the cause; the same command goes on")
    return OK


def _run_trials(
    args: argparse.Namespace, planned: Sequence[tuple[RunConfig, list[str]]], varied: list[str]
) -> dict[str, Any]:
    from popgen.pipelines.sweep import SweepRun, run_sweep
    from popgen.progress import make_reporter

    runs = [SweepRun(config, tuple(own), read_settings(config, varied)) for config, own in planned]
    with closing(make_reporter(quiet=args.quiet)) as reporter:
        return run_sweep(
            *(runs, varied, Path(args.out)),
            concurrent=args.concurrent or 0,
            config_dir=args.config_dir,
            reporter=reporter,
        )


def list_runs(fixed: Sequence[str], axes: Sequence[SweepAxis], samples: int, seed: int) -> list[list[str]]:
    """Overrides of all runs: every point of the grid, with every point drawn from the ranges.

    Raises:
        UserError: more runs than anybody wants.
    """
    listed = [axis for axis in axes if axis.values]
    ranges = [axis for axis in axes if not axis.values]
    points = draw_points(ranges, samples, seed)
    count = len(points)
    for axis in listed:
        count *= len(axis.values)
    if count > MOST_RUNS:
        raise UserError("overrides", f"make {count:,} runs", f"keep them to {MOST_RUNS:,}")
    grid = itertools.product(*([f"{axis.key}={value}" for value in axis.values] for axis in listed))
    return [[*fixed, *words, *point] for words, point in itertools.product(grid, points)]


def draw_points(ranges: Sequence[SweepAxis], samples: int, seed: int) -> list[list[str]]:
    """`samples` independent points of all ranges, the same for the same seed; one empty point without ranges."""
    import numpy as np

    if not ranges:
        return [[]]
    rng = np.random.default_rng(seed)
    return [[f"{axis.key}={axis.draw_value(rng)}" for axis in ranges] for _ in range(samples)]


def read_settings(config: RunConfig, names: Sequence[str]) -> dict[str, Any]:
    """Values of the settings that the run's method has."""
    found: dict[str, Any] = {}
    for name in names:
        value: Any = config.as_dict()
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if value is not None:
            found[name] = value
    return found


def _first_of_each_key(notes: Mapping[str, None]) -> list[str]:
    """One note for each setting and method: a grid leaves out every value of an axis."""
    found: dict[tuple[str, str], str] = {}
    for note in notes:
        word, _, rest = note.partition(" ")
        found.setdefault((word.partition("=")[0], rest), f"{word.partition('=')[0]} {rest}")
    return list(found.values())
