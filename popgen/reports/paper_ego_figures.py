"""The paper's tables of egos beside hold-out populations, to stand beside ours.

Its caption calls what stands behind "±" a standard error; by its size it is a standard deviation over episodes. One ego
for each cell, of one seed.
"""

from __future__ import annotations

from dataclasses import dataclass

from popgen.reports.paper_figures import ASYMMETRIC, CIRCUIT, CRAMPED, FORCED, RING

EGOS = ("LIPO", "CoMeDi", "XPM-WM")
"""Titles of the methods whose populations trained the paper's egos, and of its hold-out populations."""


@dataclass(frozen=True)
class PaperCell:
    """Dishes of an ego beside a hold-out population.

    Attributes:
        holdout, ego: titles of the methods of the hold-out population and of the ego's training population.
        mean, spread: as printed, mean ± spread.
    """

    holdout: str
    ego: str
    mean: float
    spread: float


_Row = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]

_TABLES: dict[str, tuple[_Row, _Row, _Row]] = {
    CRAMPED: (
        ((7.04, 3.25), (6.75, 3.14), (5.36, 3.14)),
        ((7.96, 3.19), (7.43, 3.44), (7.44, 2.89)),
        ((7.04, 3.55), (7.34, 3.07), (8.75, 2.13)),
    ),
    ASYMMETRIC: (
        ((13.07, 4.42), (7.75, 5.23), (7.61, 5.05)),
        ((12.82, 3.94), (10.09, 6.05), (10.00, 4.65)),
        ((10.21, 6.29), (4.68, 5.81), (10.33, 6.71)),
    ),
    RING: (
        ((3.52, 2.17), (2.44, 2.69), (2.64, 1.90)),
        ((4.65, 2.38), (3.52, 2.81), (3.80, 2.18)),
        ((3.13, 1.98), (0.81, 1.99), (3.85, 3.58)),
    ),
    FORCED: (
        ((3.38, 3.70), (7.12, 3.17), (3.95, 2.76)),
        ((1.27, 2.16), (5.70, 2.92), (4.47, 2.85)),
        ((1.53, 1.88), (3.54, 3.22), (4.91, 3.69)),
    ),
    CIRCUIT: (
        ((2.30, 2.21), (2.55, 2.80), (3.21, 2.93)),
        ((4.47, 3.11), (3.29, 2.90), (6.07, 2.35)),
        ((1.48, 2.41), (1.15, 2.43), (4.70, 2.35)),
    ),
}
"""Layout -> rows by hold-out population, columns by ego, both in the order of EGOS."""

AVERAGES: dict[str, tuple[float, float, float]] = {
    CRAMPED: (7.35, 7.17, 7.18),
    ASYMMETRIC: (12.03, 7.51, 9.31),
    RING: (3.77, 2.26, 3.43),
    FORCED: (2.06, 5.45, 4.44),
    CIRCUIT: (2.75, 2.33, 4.66),
}
"""Layout -> the row "Average" as printed, by ego."""


def list_cells(environment: str) -> list[PaperCell]:
    """The paper's table of a layout, row by row; empty for another environment."""
    rows = _TABLES.get(environment, ())
    return [
        PaperCell(holdout, ego, *cell)
        for holdout, row in zip(EGOS, rows, strict=False)
        for ego, cell in zip(EGOS, row, strict=True)
    ]


def average_by_method(environment: str, ego: str) -> dict[str, float] | None:
    """Means over hold-out populations of the ego's own method and of the others, from the paper's cells."""
    cells = [cell for cell in list_cells(environment) if cell.ego == ego]
    if not cells:
        return None
    others = [cell.mean for cell in cells if cell.holdout != ego]
    own = [cell.mean for cell in cells if cell.holdout == ego]
    return {"own": own[0], "others": sum(others) / len(others)}
