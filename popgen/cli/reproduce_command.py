"""`popgen reproduce TARGET`: a table or figure of the paper, from the runs to the table beside the paper's."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any

from popgen.cli.arguments import add_command, add_config_dir, at_least, expand_home
from popgen.cli.compose import compose
from popgen.cli.output_places import check_report_folder, check_written_file
from popgen.cli.printing import OK, print_json, print_sheet
from popgen.cli.training import before_ray
from popgen.errors import UserError

if TYPE_CHECKING:
    from popgen.pipelines.reproduction_pieces import Pieces
    from popgen.reports.reproduction.target_records import Budget

DEFAULT_BUDGET = "laptop"


def add(commands: Any) -> None:
    """`reproduce`."""
    parser = add_command(
        commands,
        "reproduce",
        reproduce,
        "a table or figure of the paper: its runs, our table beside the paper's, CSV and a chart",
        "--list shows all targets; TARGET `all` makes them all. Runs and what is measured of them are pieces in DIR, "
        "shared by all targets; the same command goes on with what is missing. Settings (KEY=VALUE) are of all "
        "populations whose methods have them, or of all egos if only those have them. Exit code 2 if a piece failed; "
        "the others are made. Keys of --json: targets (name, runs, runs_done, measures, measures_done, seconds_left, "
        "files) and failures; with --list: targets.",
    )
    parser.add_argument("target", nargs="?", metavar="TARGET", help="see --list")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings of what is trained")
    parser.add_argument("--list", action="store_true", help="show all targets and budgets")
    parser.add_argument("--budget", default=DEFAULT_BUDGET, metavar="NAME", help="smoke, laptop or paper (%(default)s)")
    parser.add_argument(
        "--seeds", type=at_least(1), nargs="+", default=None, metavar="N", help="of training (the budget's)"
    )
    parser.add_argument(
        *("--layouts",), nargs="+", default=None, metavar="NAME", help="of targets with several layouts (the budget's)"
    )
    parser.add_argument("--out", default="reproduction", metavar="DIR", help="of all pieces (%(default)s)")
    parser.add_argument(
        *("--runs",), action="append", default=[], type=expand_home, metavar="DIR", help="take finished runs from here"
    )
    parser.add_argument(
        *("--records",),
        metavar="DIR",
        default=None,
        help="keep what earlier records in here tell of runs with the same settings",
    )
    parser.add_argument("--dry-run", action="store_true", help="show what is done and what is left, start nothing")
    parser.add_argument("--finished", action="store_true", help="train nothing: measure and tell what is finished")
    parser.add_argument("--publish", metavar="DIR", default=None, help="copy the targets' records to here")
    parser.add_argument(
        *("--results",), metavar="FILE", default=None, help="write the page of the records in FILE's folder `results`"
    )
    add_config_dir(parser)


def reproduce(args: argparse.Namespace) -> int:
    """List, render, or make what is missing and print where things stand."""
    if args.list:
        return _list_targets(args)
    check_written_file(args.results, "--results", ".md")
    if args.results is not None and args.target is None:
        return _write_page(Path(args.results))
    if args.target is None:
        raise UserError("TARGET", "is missing", "name one, see popgen reproduce --list")
    before_ray(1, True)
    from popgen.pipelines.reproduce import make_all
    from popgen.progress import make_reporter

    work = _plan_pieces(args)
    if args.dry_run:
        return _print_state(work, args)
    if not args.quiet:
        _print_screen(work, to_stderr=True)
    with closing(make_reporter(quiet=args.quiet)) as reporter:
        records = make_all(work, reporter)
    if args.publish is not None:
        _publish_records(records, Path(args.publish))
    if args.results is not None:
        _write_page(Path(args.results))
    code = _print_state(work, args)
    if failures := work.list_failures():
        problem = f"{len(failures)} pieces failed, {failures[0]}"
        raise UserError("reproduce", problem, "repair the cause; the same command goes on")
    return code


def _plan_pieces(args: argparse.Namespace) -> Pieces:
    from popgen.pipelines.reproduction_pieces import Pieces, Plan
    from popgen.reports.reproduction.results_page import read_records
    from popgen.reports.reproduction.target_registry import find_targets

    budget = find_budget(args.budget, args.layouts)
    targets, out = find_targets(args.target), Path(args.out)
    for folder in args.runs:
        if not Path(folder).is_dir():
            raise UserError("--runs", f"{folder} is no folder", "name one that holds finished runs")
    check_report_folder(out, 256 * 2**20, quiet=True)
    seeds = list(dict.fromkeys(args.seeds or budget.seeds))
    words = ["popgen", "reproduce", args.target, *args.overrides, "--budget", budget.name, "--seeds", *map(str, seeds)]
    words += ["--layouts", *args.layouts] if args.layouts else []
    plan = Plan(
        targets,
        budget,
        seeds,
        out,
        args.overrides,
        " ".join(map(shlex.quote, words)),
        _make_composer([*budget.settings, *budget.rendezvous, *args.overrides], args.config_dir),
        [Path(folder) for folder in args.runs],
        [] if args.records is None else read_records(Path(args.records)),
        trains=not args.finished,
        ego_settings=_read_ego_settings(budget, args.overrides, args.config_dir),
    )
    work = Pieces(plan)
    taken = {word.partition("=")[0] for job in work.jobs.values() for word in job.words}
    for word in args.overrides:
        if (key := word.partition("=")[0]) not in taken:
            raise UserError(key, f"no run of {args.target} has it", "leave it out, or set it for another target")
    return work


def find_budget(name: str, layouts: Sequence[str] | None = None) -> Budget:
    """A budget by name; with other layouts than its own, named with or without `overcooked/`.

    Raises:
        UserError: there is no such budget or layout.
    """
    from popgen.reports.reproduction.target_registry import BUDGETS

    if name not in BUDGETS:
        raise UserError("--budget", f"there is no budget {name!r}", f"choose one of {', '.join(BUDGETS)}")
    if not layouts:
        return BUDGETS[name]
    known = {environment.partition("/")[2]: environment for environment in BUDGETS["paper"].layouts}
    short = list(dict.fromkeys(layout.removeprefix("overcooked/") for layout in layouts))
    if unknown := [layout for layout in short if layout not in known]:
        raise UserError("--layouts", f"the paper has no layout {unknown[0]!r}", f"choose from {', '.join(known)}")
    return replace(BUDGETS[name], layouts=tuple(known[layout] for layout in short))


def _make_composer(shared: Sequence[str], config_dir: str | None) -> Any:
    """Overrides -> a run; a shared setting that only other methods have is left out."""
    from popgen.config.run_config import RunConfig, field_names
    from popgen.methods.registry import list_working
    from popgen.pipelines.reproduction_pieces import ComposedRun
    from popgen.runs.preflight import preflight

    fields = {name: set(field_names(method.config)) for name, method in list_working()}
    everywhere = set().union(*fields.values())

    def compose_run(words: Sequence[str]) -> ComposedRun:
        method = next(word.partition("=")[2] for word in words if word.startswith("method="))
        foreign = everywhere - fields[method]
        kept = [word for word in words if word not in shared or word.partition("=")[0] not in foreign]
        config = RunConfig.parse(compose(kept, config_dir))
        preflight(config)
        return ComposedRun(config, tuple(kept))

    return compose_run


def _read_ego_settings(budget: Budget, overrides: Sequence[str], config_dir: str | None) -> dict[str, Any]:
    """Dotted field -> value of the settings that only egos have.

    Raises:
        UserError: a value that does not fit.
    """
    from popgen.config.run_config import RunConfig, field_names
    from popgen.methods.registry import DEFAULT_EGO, METHODS, list_working
    from popgen.pipelines.ego_training import find_ego_method

    method = find_ego_method(DEFAULT_EGO)
    populations = (set(field_names(one.config)) for _, one in list_working() if not one.trains_ego)
    own = set(field_names(METHODS[method].config)).difference(*populations)
    words = [word for word in overrides if word.partition("=")[0] in own]
    if not words:
        return {}
    values = RunConfig.parse(compose([f"method={method}", f"scale={budget.scale}", *words], config_dir)).as_dict()
    return {key: reduce(getitem, key.split("."), values) for key in (word.partition("=")[0] for word in words)}


def _list_targets(args: argparse.Namespace) -> int:
    from popgen.reports.reproduction.target_registry import BUDGETS, TARGETS

    rows = [
        {"name": one.name, "title": one.title, "source": one.source, "columns": [c.title for c in one.columns]}
        for one in TARGETS.values()
    ]
    if args.json:
        print_json({"targets": rows, "budgets": {name: budget.summary for name, budget in BUDGETS.items()}})
        return OK
    for row in rows:
        print(f"{row['name']:18}{row['title']}\n{'':18}{row['source'] or 'not in the paper'}")
    print()
    for name, budget in BUDGETS.items():
        print(f"--budget {name:9}{budget.summary}")
    return OK


def _print_state(work: Pieces, args: argparse.Namespace) -> int:
    """What is done and what is left, and where the files are."""
    if not args.json:
        _print_screen(work, to_stderr=False)
        print(f"reports: {', '.join(str(work.plan.out / target.name) for target in work.plan.targets)}")
        return OK
    rows = []
    for target in work.plan.targets:
        folder = work.plan.out / target.name
        files = [str(path) for path in sorted(folder.glob("*"))] if folder.is_dir() else []
        left = round(work.estimate_seconds(target), 1)
        rows.append({"name": target.name, **work.count_pieces(target), "seconds_left": left, "files": files})
    print_json({"targets": rows, "failures": work.list_failures()})
    return OK


def _print_screen(work: Pieces, *, to_stderr: bool) -> None:
    import sys

    import pandas as pd

    from popgen.progress import whole_text
    from popgen.reports.frames import Sheet

    rows = []
    for target in work.plan.targets:
        counts, left = work.count_pieces(target), work.estimate_seconds(target)
        rows.append(
            {
                "target": target.name,
                "runs": f"{counts['runs_done']} of {counts['runs']}",
                "measures": f"{counts['measures_done']} of {counts['measures']}",
                "left": "done" if not left else f"about {whole_text(left)}",
            }
        )
    left = work.estimate_seconds()
    text = f"left in all, shared pieces once: {f'about {whole_text(left)}' if left else 'nothing'}"
    if to_stderr:
        lines = [f"{row['target']:18}runs {row['runs']:10}measures {row['measures']:10}{row['left']}" for row in rows]
        print("\n".join([*lines, text]), file=sys.stderr)
        return
    print_sheet(Sheet(f"budget {work.plan.budget.name}, in {work.plan.out}", pd.DataFrame(rows)))
    print(text)


def _publish_records(records: dict[str, Any], folder: Path) -> None:
    """Records with runs, as files of less than MOST_BYTES."""
    from popgen.durable_files import replace_file
    from popgen.reports.reproduction.results_page import MOST_BYTES, name_record, to_record_text

    folder.mkdir(parents=True, exist_ok=True)
    for name, record in records.items():
        data = to_record_text(record).encode()
        if len(data) > MOST_BYTES:
            raise UserError("--publish", f"the record of {name} has {len(data):,} bytes", "publish fewer seeds")
        if record["runs"]:
            replace_file(folder / f"{name_record(record)}.json", data)


def _write_page(path: Path) -> int:
    from popgen.durable_files import replace_file
    from popgen.reports.reproduction.results_page import read_records, to_page

    replace_file(path, to_page(read_records(path.parent / path.stem)).encode())
    return OK
