"""`popgen show` and `runs`: what is there already."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command
from popgen.cli.printing import OK, print_json, print_sheet, print_table, tell_unfinished


def add(commands: Any) -> None:
    """`show` and `runs`."""
    parser = add_command(
        commands,
        "show",
        show,
        "what a population holds",
        "Keys of --json: path, manifest, bytes (of all members' files), steps (by kind), total_steps, members "
        "(member.json with total_steps, bytes and parameters).",
    )
    parser.add_argument("population", metavar="POPULATION", help="folder of a population, or of its run")
    parser = add_command(
        commands,
        "runs",
        runs,
        "the runs in a folder: state, member, environment steps, last error",
        "States: running, finished, failed, interrupted (`popgen run` with the same run.id goes on), damaged. Keys of "
        "--json: root, and runs, each with id, state, method, scale, environment, member (that is trained) of size, "
        "steps (by kind), total_steps (of training), seconds (of all attempts), attempt, began (seconds since "
        "1970), error.",
    )
    parser.add_argument("root", metavar="ROOT", nargs="?", default="runs", help="folder of the runs (%(default)s)")


def show(args: argparse.Namespace) -> int:
    """Tell what a population holds."""
    from popgen.population import load_population
    from popgen.reports.population_report import describe_population, make_members_sheet, render_population

    tell_unfinished([args.population])
    population = load_population(args.population)
    report = describe_population(population)
    if args.json:
        print_json(report)
        return OK
    print_table(render_population(report, population))
    print()
    print_sheet(make_members_sheet(report, population))
    print(f"population: {population.path}")
    return OK


def runs(args: argparse.Namespace) -> int:
    """List the runs in a folder."""
    from popgen.runs.directory import list_runs

    found = list_runs(Path(args.root))
    if args.json:
        print_json({"root": args.root, "runs": found})
        return OK
    print_table(_list_as_table(args.root, found))
    for run in found:
        if run["error"]:
            print(f"{run['id']}: {run['error']}")
    return OK


def _list_as_table(root: str, found: Sequence[Mapping[str, Any]]) -> Any:
    """At most 80 columns wide where the terminal is: an id is folded over lines, never cut."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(f"runs in {root}"), title_justify="left", show_lines=True)
    for name in ("run", "state", "member", "environment steps", "minutes"):
        table.add_column(name, overflow="fold")
    for run in found:
        member = "-" if run["size"] is None else f"{run['member']} of {run['size']}"
        steps = "\n".join(f"{kind} {count:,}" for kind, count in run["steps"].items())
        about = f"{run['id']}\n{run['method'] or '-'}, {run['environment'] or '-'}"
        cells = (about, run["state"], member, steps or "-", f"{run['seconds'] / 60:.1f}")
        table.add_row(*(Text(cell) for cell in cells))
    return table
