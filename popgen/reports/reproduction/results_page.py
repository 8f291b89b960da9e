"""Records as Markdown: one target's report, and the page of all that is published."""

from __future__ import annotations

import json
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.errors import UserError
from popgen.reports.reproduction.run_tables import LEVEL, find_figure, make_run_sheet, make_sheets
from popgen.reports.reproduction.target_records import Record
from popgen.reports.reproduction.target_registry import TARGETS

FORMAT, VERSION = "popgen-reproduction", 1
MOST_BYTES = 250_000
"""Of a record: all generators and their egos on five layouts."""

WIDTH = 100

_HEAD = f"""# Measured results

`popgen reproduce` wrote this page from the records in `docs/results/`; no number is typed by hand.
`popgen reproduce --results docs/results.md` writes it again. A cell is the mean over seeds ± half the
width of its {LEVEL} interval (Student's t), or the one seed's figure; "-" was not measured. Rows
marked (paper) are the paper's. Figures of earlier runs whose records were not kept are in
[earlier measurements](notes/measurements.md).
"""


def read_record(path: Path) -> Record:
    """A target's record.

    Raises:
        UserError: it cannot be read, or is none.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(str(path), f"cannot be read ({error})", "restore it from a copy") from None
    if not isinstance(values, dict) or values.get("format") != FORMAT or values.get("target") not in TARGETS:
        raise UserError(str(path), "is no record of popgen reproduce", "remove it from the folder")
    return values


def name_record(record: Record) -> str:
    """What its file is called: records of one target with other settings stand beside each other."""
    return "-".join([record["target"], record["budget"], *sorted(record["settings"])]).replace("/", "_")


def to_record_text(record: Record) -> str:
    """The JSON text of a record."""
    return json.dumps(record, indent=1, sort_keys=True, allow_nan=False) + "\n"


def read_records(folder: Path) -> list[Record]:
    """All records of a folder, in the registry's order.

    Raises:
        UserError: there are none, or one cannot be read.
    """
    records = [read_record(path) for path in sorted(folder.glob("*.json"))]
    if not records:
        raise UserError(str(folder), "holds no records", "make some with popgen reproduce TARGET --publish DIR")
    order = list(TARGETS)
    return sorted(records, key=lambda one: (order.index(one["target"]), one["budget"], one["command"]))


def to_page(records: Sequence[Record]) -> str:
    """The page of measured results."""
    counts = Counter(record["target"] for record in records)
    sections = (to_section(record, named=counts[record["target"]] > 1) for record in records)
    return "\n".join([_HEAD, *sections])


def to_section(record: Record, level: int = 2, *, named: bool = False) -> str:
    """A target's part of the page: the paper's claim, tables, what is missing, and where the figures come from.

    Args:
        record: of the target.
        level: of the heading.
        named: the heading says the settings, which tell this record from another of the same target.
    """
    target = TARGETS[record["target"]]
    settings = f", {', '.join(record['settings'])}" if named and record["settings"] else ""
    lines = [f"{'#' * level} {target.title}{settings}", ""]
    if target.source:
        lines += [_wrap_text(f"The paper's {target.source}: {target.claim}"), ""]
    lines += ["```sh", record["command"], "```", ""]
    for sheet in make_sheets(record, target):
        lines += [f"{sheet.title}:", "", sheet.to_markdown(), ""]
    lines += [_wrap_text(note, "- ") for note in (*target.notes, *_list_origins(record))]
    lines += [_wrap_text(text, "- ") for text in _list_missing(record)]
    lines += ["", make_run_sheet(record, target).to_markdown(), ""]
    return "\n".join(lines)


def _wrap_text(text: str, start: str = "") -> str:
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=start,
        subsequent_indent=" " * len(start),
        break_long_words=False,
        break_on_hyphens=False,
    )


OWN = {
    "scores": "SP, XP, play beside random and idle partners and mixed play",
    "curves": "final scores",
    "first": "final scores",
}
"""Measures whose figures are of a run's own evaluation, and what these are; its episodes may be others than the
record's, since runs that differ in them are taken over."""

_UNPLAYED = ("costs",)
"""Measures that nothing is played for."""


def _list_origins(record: Record) -> list[str]:
    """Sentences: evaluation, machines, runs made before, members that do not play."""
    runs = record["runs"]
    told = [f"Budget {record['budget']}, written {record['written']}.", *_list_episodes(record)]
    machines = Counter(run["machine"] or "a machine that is not known" for run in runs)
    told.append("Runs: " + "; ".join(f"{count} on {name}" for name, count in machines.items()) + ".")
    if before := sum(run["taken_over"] for run in runs):
        told.append(
            f"{before} of {len(runs)} runs were not made by this command but taken over: method, environment, seed, "
            "size and all settings that decide the result are the same."
        )
    told += [
        f"{run['row']} in {run['environment']}, seed {run['seed']}: {line}."
        for run in runs
        for line in run.get("weak_members", [])
    ]
    if any(run["changed"] for run in runs):
        told.append("A commit with + had changes that were not committed.")
    return told


def _list_episodes(record: Record) -> list[str]:
    """How much was played for which figures; no number of what is not known."""
    measures = list(dict.fromkeys(name for run in record["runs"] for name in run["figures"]))
    told = []
    if own := [name for name in measures if name in OWN]:
        kept = [
            run["figures"][name].get("episodes") for run in record["runs"] for name in own if name in run["figures"]
        ]
        known = sorted({episodes for episodes in kept if episodes is not None})
        text = " and ".join(dict.fromkeys(OWN[name] for name in own))
        text = f"{text[0].upper()}{text[1:]} are of the runs' own evaluations"
        if known:
            most = f"{known[0]} to {known[-1]}" if len(known) > 1 else str(known[0])
            text += f", with {most} episodes for each pair{', where that is known' if None in kept else ''}"
        told.append(f"{text}.")
    if any(name not in (*OWN, *_UNPLAYED) for name in measures):
        what = "Other figures of play" if own else "Figures of play"
        told.append(f"{what} are of evaluations made for this table, with {record['episodes']} episodes each.")
    return [*told, *_list_sizes(record)]


def _list_sizes(record: Record) -> list[str]:
    """Of how many members diversity is, and of whom too few are there."""
    told, runs = [], record["runs"]
    sizes = sorted({size for run in runs if (size := find_figure(run, "diversity.of")) is not None})
    if sizes:
        most = f"{sizes[0]} to {sizes[-1]}" if len(sizes) > 1 else str(sizes[0])
        told.append(
            f"BR-Div is of {most} members, as many as the smallest population here has: of larger ones the mean over "
            "all sets of so many."
        )
    few = {run["row"]: f"{run['row']} ({find_figure(run, 'acting.finals')})" for run in runs if _lacks_finals(run)}
    if few:
        needed = max(find_figure(run, "acting.needed") for run in runs if _lacks_finals(run))
        told.append(
            f"Entropy and divergence are of members that were trained to the end, and left out where there are fewer "
            f"than {needed} of them: {', '.join(few.values())}."
        )
    return told


def _lacks_finals(run: Mapping[str, Any]) -> bool:
    return find_figure(run, "acting.finals") is not None


def _list_missing(record: Record) -> list[str]:
    counts: dict[tuple[str, str], list[int]] = {}
    for one in record["missing"]:
        counts.setdefault((one["row"], one["environment"]), []).append(one["seed"])
    if not counts:
        return []
    parts = [
        f"{row} in {name}, seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))}"
        for (row, name), seeds in counts.items()
    ]
    return [f"Not run: {'; '.join(parts)}."]


def to_report(record: Record) -> str:
    """A target's own report: its section, and the exact command of every run."""
    commands = [run["command"] for run in record["runs"]]
    return "\n".join([to_section(record, 1), "## Commands", "", "```sh", *dict.fromkeys(commands), "```", ""])
