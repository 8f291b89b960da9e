"""`popgen show` and `runs`: what is there already."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command
from popgen.cli.printing import OK, print_json, print_table, short


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
    parser.add_argument("population", metavar="POPULATION", help="folder that holds manifest.json")
    parser = add_command(
        commands,
        "runs",
        runs,
        "the runs in a folder: state, member, environment steps, last error",
        "States: running, finished, failed, interrupted (`popgen run` with the same run.id goes on), damaged. Keys of "
        "--json: root, and runs, each with id, state, method, scale, environment, member (that is trained) of size, "
        "steps (by kind), total_steps, seconds (of all attempts), attempt, began (seconds since 1970), error.",
    )
    parser.add_argument("root", metavar="ROOT", nargs="?", default="runs", help="folder of the runs (%(default)s)")


def show(args: argparse.Namespace) -> int:
    """Tell what a population holds."""
    from popgen.population import load_population
    from popgen.reports.population_report import describe_population, render_population

    population = load_population(args.population)
    if args.json:
        print_json(describe_population(population))
        return OK
    print_table(render_population(population))
    print(f"population: {population.path}")
    return OK


def runs(args: argparse.Namespace) -> int:
    """List the runs in a folder."""
    from popgen.runs.directory import list_runs

    found = list_runs(Path(args.root))
    if args.json:
        print_json({"root": args.root, "runs": found})
        return OK
    from rich.markup import escape
    from rich.table import Table

    names = ("run", "state", "method", "environment", "member", "environment steps", "minutes", "last error")
    table = Table(*names, title=f"runs in {args.root}", title_justify="left")
    for run in found:
        member = "-" if run["size"] is None else f"{run['member']} of {run['size']}"
        steps = ", ".join(f"{kind} {count:,}" for kind, count in run["steps"].items())
        cells = (run["id"], run["state"], run["method"], run["environment"], member, steps)
        error = short(" ".join((run["error"] or "").split()))
        table.add_row(*(escape(str(cell or "-")) for cell in cells), f"{run['seconds'] / 60:.1f}", escape(error))
    print_table(table)
    return OK
