"""A target's record as rows with intervals over seeds, as tables and as CSV: pure functions of the record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from popgen.evaluation.estimates import measure_half_interval
from popgen.reports.frames import UNKNOWN, Sheet, to_csv
from popgen.reports.reproduction.measure_definitions import is_outdated
from popgen.reports.reproduction.target_records import Column, PaperLine, Record, Target

LEVEL = "95 %"


@dataclass(frozen=True)
class Interval:
    """A figure over seeds.

    Attributes:
        mean: of them.
        half: width of the mean's interval at LEVEL to either side, by Student's t, which takes seeds as normal; 0 for
            one seed.
        seeds: how many have the figure.
    """

    mean: float
    half: float
    seeds: int

    @property
    def low(self) -> float:
        """End of the interval."""
        return self.mean - self.half

    @property
    def high(self) -> float:
        """The other end."""
        return self.mean + self.half

    def to_text(self, digits: int) -> str:
        """`mean ± half`, the mean alone for one seed."""
        mean = f"{self.mean:,.{digits}f}"
        return mean if self.seeds < 2 else f"{mean} ± {self.half:,.{digits}f}"


@dataclass(frozen=True)
class TableRow:
    """A row of a target's table.

    Attributes:
        label, environment: of its runs.
        seeds: of its runs, ascending.
        cells: column title -> figure; None where no run has it.
    """

    label: str
    environment: str
    seeds: tuple[int, ...]
    cells: Mapping[str, Interval | None]


def take_interval(values: Sequence[float]) -> Interval | None:
    """Of a figure's values, one a seed; None without any."""
    if not len(values):
        return None
    count = len(values)
    return Interval(float(np.mean(values)), measure_half_interval(values) if count > 1 else 0.0, count)


def find_figure(run: Mapping[str, Any], figure: str) -> Any:
    """`measure.name` of a run of a record; None where it is not there, or means something else today."""
    measure, _, name = figure.partition(".")
    if is_outdated(run, measure):
        return None
    return run["figures"].get(measure, {}).get(name)


def list_environments(record: Record) -> list[str]:
    """Of its runs, in order."""
    return list(dict.fromkeys(run["environment"] for run in record["runs"]))


def summarise_runs(record: Record, columns: Sequence[Column]) -> list[TableRow]:
    """One row for each row of runs and environment."""
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run in record["runs"]:
        groups.setdefault((run["environment"], run["row"]), []).append(run)
    order = list_environments(record)
    rows = []
    for (environment, label), runs in sorted(groups.items(), key=lambda item: order.index(item[0][0])):
        cells = {}
        for column in columns:
            found = [find_figure(run, column.figure) for run in runs]
            cells[column.title] = take_interval([float(value) for value in found if value is not None])
        rows.append(TableRow(label, environment, tuple(sorted({run["seed"] for run in runs})), cells))
    return rows


def make_sheets(record: Record, target: Target) -> list[Sheet]:
    """A table for each environment, the paper's rows below ours; columns that nobody fills are left out."""
    rows = summarise_runs(record, target.columns)
    return [
        _make_sheet(target, name, [row for row in rows if row.environment == name])
        for name in list_environments(record)
    ]


def _make_sheet(target: Target, environment: str, rows: Sequence[TableRow]) -> Sheet:
    lines = target.paper(environment)
    used = [
        column
        for column in target.columns
        if any(row.cells[column.title] for row in rows) or any(column.title in line.cells for line in lines)
    ]
    cells = [_our_cells(row, used) for row in rows] + [_paper_cells(line, used) for line in lines]
    dim = frozenset(range(len(rows), len(cells)))
    return Sheet(f"{target.title}: {environment}", pd.DataFrame(cells), dim=dim)


def _our_cells(row: TableRow, columns: Sequence[Column]) -> dict[str, str]:
    texts = {}
    for column in columns:
        cell = row.cells[column.title]
        texts[column.title] = UNKNOWN if cell is None else cell.to_text(column.digits)
        if cell is not None and cell.seeds < len(row.seeds):
            texts[column.title] += f" ({cell.seeds} of {len(row.seeds)})"
    return {"": row.label, "seeds": ", ".join(map(str, row.seeds)), **texts}


def _paper_cells(line: PaperLine, columns: Sequence[Column]) -> dict[str, str]:
    """Numbers as the paper prints them."""
    found = {column.title: line.cells.get(column.title) for column in columns}
    texts = {name: UNKNOWN if value is None else f"{value:,g}" for name, value in found.items()}
    return {"": f"{line.label} (paper)", "seeds": UNKNOWN, **texts}


def make_run_sheet(record: Record, target: Target) -> Sheet:
    """A row for each run: what it gave, which code made it, and how long it took."""
    runs = record["runs"]
    columns = [c for c in target.columns if any(find_figure(run, c.figure) is not None for run in runs)]
    cells = []
    for run in runs:
        head = {"run": run["row"], "layout": run["environment"].partition("/")[2], "seed": str(run["seed"])}
        values = {column.title: find_figure(run, column.figure) for column in columns}
        texts = {c.title: UNKNOWN if values[c.title] is None else f"{values[c.title]:,.{c.digits}f}" for c in columns}
        commit = (run["commit"] or "unknown")[:7] + (" +" if run["changed"] else "")
        cells.append({**head, **texts, "commit": commit})
    return Sheet("by run", pd.DataFrame(cells), labels=2)


def to_rows_csv(record: Record, target: Target) -> str:
    """Our rows and the paper's: source, row, environment, seeds, and mean, low and high of each column; one seed's
    figure has no interval."""
    names = [f"{column.title}{end}" for column in target.columns for end in ("", " low", " high")]
    found: list[dict[str, Any]] = []
    for row in summarise_runs(record, target.columns):
        line: dict[str, Any] = {"source": "popgen", "row": row.label, "environment": row.environment}
        line["seeds"] = " ".join(map(str, row.seeds))
        for title, cell in row.cells.items():
            if cell is not None:
                line[title] = cell.mean
                line |= {f"{title} low": cell.low, f"{title} high": cell.high} if cell.seeds > 1 else {}
        found.append(line)
    for name in list_environments(record):
        found += [
            {"source": "paper", "row": line.label, "environment": name, **line.cells} for line in target.paper(name)
        ]
    return to_csv(found, ["source", "row", "environment", "seeds", *names])
