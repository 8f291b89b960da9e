"""`popgen evaluate`, `show` and `runs`: what is there already."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import Any

from popgen.cli.arguments import add_command, at_least, numbers, pair
from popgen.cli.printing import OK, print_json, print_report, print_table, short
from popgen.cli.training import bound_threads


def add(commands: Any) -> None:
    """`evaluate`, `show` and `runs`."""
    parser = add_command(
        commands,
        "evaluate",
        evaluate,
        "SP/XP matrix of a population, beside random and idle partners",
        "Keys of --json: those of popgen/reports/crossplay_report.py (sp, xp, matrix, beside, obstruction, pairs, ...) "
        "and files.",
    )
    parser.add_argument("population", metavar="POPULATION", help="folder that holds manifest.json")
    parser.add_argument("--episodes", type=at_least(1), default=20, help="per ordered pair (%(default)s)")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the evaluation (%(default)s)")
    parser.add_argument("--members", type=numbers, default=None, metavar="1,2,...", help="all by default")
    parser.add_argument("--out", metavar="DIR", help="of the report (POPULATION/evaluation)")
    parser.add_argument("--env", metavar="NAME", help="refuse a population that was trained in another environment")
    parser.add_argument(
        "--param", type=pair, action="append", default=[], metavar="KEY=VALUE", help="the same for a parameter of it"
    )
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


def evaluate(args: argparse.Namespace) -> int:
    """Play all pairs of members and write the report."""
    bound_threads(1)
    from popgen.population import check_compatible, load_population
    from popgen.progress import make_reporter
    from popgen.runs.preflight import check_root

    population = load_population(args.population)
    if args.env or args.param:
        from popgen.envs import make_env

        info = population.env_info
        name = args.env or info.name
        params = {**(info.params if name == info.name else {}), **dict(args.param)}
        check_compatible(population, make_env(name, 1, **params).spec)
    out = Path(args.out) if args.out else Path(args.population) / "evaluation"
    check_root(out, 16 * 2**20, "--out")
    from popgen.evaluation.crossplay import evaluate_population
    from popgen.reports.crossplay_report import matrix_sheet, summary, to_dict, write_report

    with closing(make_reporter(quiet=args.quiet)) as reporter:
        reporter.phase("evaluation", 1)
        result = evaluate_population(
            population,
            args.episodes,
            args.seed,
            args.members,
            progress=lambda done, total: reporter.update(done / total, episodes=done),
        )
    files, report = write_report(result, out), to_dict(result)
    if args.json:
        print_json({**report, "files": {suffix: str(path) for suffix, path in files.items()}})
        return OK
    table = matrix_sheet(report, narrow=True).to_rich()
    print_report([table], summary(report), str(out), [path.name for path in files.values()])
    return OK


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
