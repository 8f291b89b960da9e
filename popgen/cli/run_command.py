"""`popgen run`."""

from __future__ import annotations

import argparse
import json
import textwrap
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popgen.cli.arguments import add_command, add_config_dir
from popgen.cli.compose import compose, compose_record, to_yaml
from popgen.cli.printing import OK, WEAK, WIDTH, print_json, print_sheet, tell_notes, wrap_line
from popgen.cli.standard_streams import keep_native_lines
from popgen.cli.training import before_ray
from popgen.durable_files import read_regular
from popgen.errors import UserError

if TYPE_CHECKING:
    from popgen.config.run_config import RunConfig


def add(commands: Any) -> None:
    """`run`."""
    parser = add_command(
        commands,
        "run",
        run,
        "generate a population",
        "Overrides are Hydra's: a group as in env=overcooked/cramped_room, method=xpm_wm, scale=laptop, "
        "cluster=gpu_node or tracking=off, a field as in population.size=3 or agent.lambda_xp=0.1; seed=1 stands for "
        "run.seed=1. `popgen config METHOD` lists the fields. The same run.id goes on where an interrupted run was. "
        "Exit codes: 0, 2 for an error told in one line, 3 for a population with a member that does not play, which "
        "the last lines name (evaluation.weak_share), 130 when interrupted. Keys of --json: run_id, run_dir, "
        "population (paths), members (how many), matrix (mean and standard_error, row = seat 0, column = seat 1), "
        "ledger (environment steps by member and kind), evaluation (as `evaluate --json`), weak_members (a line for "
        "each that does not play), files (the report's), "
        "tracking (writer, command, address), seconds; with --dry-run the whole configuration.",
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings on top of conf/config.yaml")
    parser.add_argument(
        "--dry-run", action="store_true", help="check everything, print the configuration, start nothing"
    )
    add_config_dir(parser)
    parser.add_argument(
        "--from", dest="record", default=None, metavar="RUN", help="repeat that run's settings, with the overrides"
    )


def run(args: argparse.Namespace) -> int:
    """Train a population and evaluate it, or say what would be done."""
    from popgen.config.run_config import RunConfig

    if args.record is None:
        values = compose(args.overrides, args.config_dir)
    else:
        values = compose_record(read_record(args.record), args.overrides)
    return execute(RunConfig.parse(values), args)


def execute(config: RunConfig, args: argparse.Namespace) -> int:
    """Do what a configuration says, in a process of its own where this is one; print the result.

    Args:
        config: checked by its schema.
        args: own_process, dry_run, quiet, json.
    """
    from popgen.progress import make_reporter
    from popgen.runs.directory import named, run_folder
    from popgen.runs.interruption import end_on_sigterm
    from popgen.runs.preflight import preflight
    from popgen.runs.supervisor import guarded

    if args.own_process and not args.dry_run:
        config = named(config)
        if (code := guarded(run_folder(config), config.cluster.retries)) is not None:
            return code
        end_on_sigterm()
    spec = preflight(config)
    if not args.quiet:
        tell_notes(spec.notes)
    if args.dry_run:
        return _print_config(config.as_dict(), args.json)
    if args.own_process:
        keep_native_lines(native_lines(run_folder(config)))
    before_ray(config.cluster.threads, config.cluster.address is None)
    with closing(make_reporter(quiet=args.quiet)) as reporter:
        reporter.phase("loading libraries", 0)
        from popgen.pipelines.population import run_population

        result = run_population(config, reporter=reporter)
    if args.json:
        print_json(result)
    else:
        _print_run(result)
    return WEAK if result["weak_members"] else OK


def read_record(run: str) -> dict[str, Any]:
    """`config.json` of a run's folder.

    Raises:
        UserError: there is none that can be read.
    """
    path = Path(run) / "config.json"
    try:
        values = json.loads(read_regular(path))
    except (OSError, ValueError, RecursionError) as error:
        problem = f"cannot read {path} ({getattr(error, 'strerror', None) or 'it is no JSON'})"
        raise UserError("--from", problem, "give a run's folder") from None
    if not isinstance(values, dict):
        raise UserError("--from", f"{path} holds no settings", "give a run's folder")
    return _keep_kitchen(values, Path(run))


def _keep_kitchen(values: dict[str, Any], run: Path) -> dict[str, Any]:
    """The settings, with the grid that the run's population was trained in for the path of a layout file.

    The file may have been edited or moved since. A run that has no manifest yet keeps the path.
    """
    env = values.get("env")
    if not (isinstance(env, dict) and str(env.get("name")).endswith(".layout")):
        return values
    try:
        trained = json.loads(read_regular(run / "population" / "manifest.json"))["environment"]
        return {**values, "env": {"name": trained["name"], "params": trained["params"]}}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return values


def native_lines(folder: Path) -> Path:
    """Where Ray's C++ lines go: beside the run's folder, which a copy from a storage may still have to take the place
    of."""
    return folder.with_name(f".{folder.name}.ray.log")


def _print_config(values: dict[str, Any], as_json: bool) -> int:
    if as_json:
        print_json(values)
    else:
        print(to_yaml(values), end="")
    return OK


WHOSE = {"total": "all", "population": "of the population"}


def _print_run(result: Mapping[str, Any]) -> None:
    """The last screen: the matrix, what it means, what it took, and how to go on; 80 columns."""
    from popgen.reports.crossplay_report import matrix_sheet, summary
    from popgen.reports.run_findings import next_commands

    evaluation = result["evaluation"]
    print_sheet(matrix_sheet(evaluation, narrow=True))
    print("\n".join(part for line in summary(evaluation) for part in wrap_line(line)))
    if findings := result.get("findings"):
        print("\nwhat it means")
        for finding in findings:
            mark = {True: "+", False: "!", None: "."}[finding["good"]]
            print(textwrap.fill(finding["text"], WIDTH, initial_indent=f"  {mark} ", subsequent_indent="    "))
    print()
    for who, row in result["ledger"].items():
        kinds = ", ".join(f"{kind} {steps:,}" for kind, steps in row.items() if steps and kind != "total")
        print(f"environment steps, {WHOSE.get(who, f'member {who}')}: {kinds}")
    print(f"time: {result['seconds'] / 60:.1f} minutes")
    files = result.get("files", {})
    if "report" in files:
        print(f"\npage:     {files['report']} (open it in a browser)")
        print(f"pictures: {', '.join(sorted(name for name in map(_name_file, files.values()) if '.png' in name))}")
    if shown := result.get("tracking"):
        told = [line for line in (shown["command"], shown["address"]) if line]
        print(f"{shown['writer'] + ':':<9} " + "\n          ".join(told))
    print("\nnext")
    for command, what in next_commands(result["run_dir"], result["members"]):
        print(f"  {command}\n      {what}")
    print(f"\npopulation: {result['population']}\nledger, checkpoints and reports: {result['run_dir']}")
    for line in result["weak_members"]:
        print(textwrap.fill(line, WIDTH))


def _name_file(path: str) -> str:
    return path.rpartition("/")[2]
