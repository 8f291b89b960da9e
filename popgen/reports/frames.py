"""Figures as text, and pandas frames as CSV, Markdown and tables for the terminal. Every report uses these."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd
from rich.table import Table
from rich.text import Text

UNKNOWN = "-"
"""Text of a figure that is not known."""

Spread = dict[str, float | None]
"""Mean, least and largest of a figure over several runs: keys mean, low, high."""


def number_text(value: float | None, digits: int = 2) -> str:
    """A number with `digits` digits after the point."""
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def estimate_text(figure: Mapping[str, float | None], digits: int = 2) -> str:
    """`mean ± standard error` of a figure of a JSON report."""
    mean, error = figure["mean"], figure["standard_error"]
    if mean is None or error is None:
        return number_text(mean, digits)
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def range_text(spread: Mapping[str, float | None], digits: int = 2) -> str:
    """`mean (low to high)`, the mean alone where all values are equal."""
    low, high = spread["low"], spread["high"]
    if low is None or high is None or low == high:
        return number_text(spread["mean"], digits)
    return f"{number_text(spread['mean'], digits)} ({low:.{digits}f} to {high:.{digits}f})"


def steps_text(value: float, _: int | None = None) -> str:
    """Steps in short: 250k, 1.5M. The second argument is matplotlib's, which formats ticks with this."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def seeds_text(seeds: Sequence[int]) -> str:
    """`seed 1` or `seeds 1, 2, 3`."""
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"


def spread_of(values: Iterable[float | None]) -> Spread:
    """Mean, least and largest of the values that are known; all None where none is."""
    known = pd.Series(list(values), dtype=float).dropna()
    if known.empty:
        return {"mean": None, "low": None, "high": None}
    return {"mean": float(known.mean()), "low": float(known.min()), "high": float(known.max())}


def to_csv(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """CSV with these columns. Missing values and None stay empty, other keys are left out."""
    frame = pd.DataFrame(list(rows), columns=list(columns), dtype=object)  # of objects: None makes no float of an int
    return frame.to_csv(index=False, lineterminator="\n")


WHOLE = 24
"""Characters of the longest cell that is a figure, with its error or interval."""


@dataclass(frozen=True)
class Sheet:
    """A table for people.

    Attributes:
        title: of the table.
        frame: cells as text, in the order of rows and columns; its index is not shown.
        labels: columns from the left that hold labels; the others hold figures and stand to the right.
        dim: numbers of the rows that are given for comparison.
        bold: (row, column) of the cells that stand out.
    """

    title: str
    frame: pd.DataFrame
    labels: int = 1
    dim: frozenset[int] = frozenset()
    bold: frozenset[tuple[int, int]] = frozenset()

    def to_markdown(self) -> str:
        """The table alone, without its title; cells are not padded, which would make long lines of short rows."""
        sides = [":--" if number < self.labels else "--:" for number in range(self.frame.shape[1])]
        cells = [[str(cell).replace("|", "\\|") for cell in row] for row in self.frame.to_numpy()]
        rows = [[str(column) for column in self.frame.columns], sides, *cells]
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)

    def split(self, width: int) -> list[Sheet]:
        """Sheets to be shown below each other in the place of one whose cells would be cut at so many characters: each
        has the labels and as many of the figures as fit, at least one."""
        needed = [self._measure_column(column) + len("|  ") for column in range(self.frame.shape[1])]
        used = 1 + sum(needed[: self.labels])
        parts: list[list[int]] = []
        room = 0
        for column in range(self.labels, len(needed)):
            if needed[column] > room:
                parts.append([])
                room = width - used
            parts[-1].append(column)
            room -= needed[column]
        if len(parts) < 2:
            return [self]
        return [self._take_columns(columns, first=columns is parts[0]) for columns in parts]

    def _measure_column(self, column: int) -> int:
        """Characters that it takes at least: figures stay whole; sentences, and headers of figures, break at words."""
        header = str(self.frame.columns[column])
        texts = [header] if column < self.labels else header.split()
        for cell in self.frame.iloc[:, column].astype(str):
            texts += [cell] if column < self.labels or len(cell) <= WHOLE else cell.split()
        return max(map(len, texts), default=0)

    def _take_columns(self, columns: Sequence[int], *, first: bool) -> Sheet:
        kept = [*range(self.labels), *columns]
        bold = frozenset((row, kept.index(column)) for row, column in self.bold if column in kept)
        title = self.title if first else f"{self.title} (continued)"
        return replace(self, title=title, frame=self.frame.iloc[:, kept], bold=bold)

    def to_rich(self, width: int | None = None) -> Table:
        """For the terminal; where it is tight at so many characters, columns without sentences are no wider than they
        must be, which rich does not find by itself."""
        table = Table(title=Text(self.title))
        longest = [
            max([len(str(label)), *self.frame.iloc[:, number].astype(str).map(len)])
            for number, label in enumerate(self.frame.columns)
        ]
        is_tight = width is not None and 1 + sum(size + len("|  ") for size in longest) > width
        for number, label in enumerate(self.frame.columns):
            is_label, least = number < self.labels, self._measure_column(number)
            sides = {"justify": "left" if is_label else "right", "no_wrap": is_label}
            has_sentences = self.frame.iloc[:, number].astype(str).map(len).max() > least
            fixed = least if is_tight and not has_sentences else None
            table.add_column(Text(str(label)), min_width=least, width=fixed, **sides)
        for row, cells in enumerate(self.frame.to_numpy()):
            texts = [Text(str(cell), "bold" if (row, column) in self.bold else "") for column, cell in enumerate(cells)]
            table.add_row(*texts, style="dim" if row in self.dim else None)
        return table
