"""Where players on a plane went: both ways of an episode, for all pairs or for chosen ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from popgen.reports.charts.chart_style import (
    COLOURS,
    COLUMN,
    PAGE,
    add_legend,
    add_panels,
    legend_height,
    styled_figure,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from popgen.evaluation.sabotage import Paths

SEAT_COLOURS = (COLOURS[0], COLOURS[4])
"""Of the players in seat 0 and 1 where paths are drawn."""

_DRAWN = 8
"""Members of a grid of paths; more would be too small to see."""


def path_grid(paths: Paths, files: Sequence[str | Path], *, title: str) -> None:
    """Where both players went, a panel for each ordered pair of members; the diagonal is self-play.

    Panels in which somebody left the bounds are shaded.
    """
    size = min(len(paths.positions), _DRAWN)
    side = max(COLUMN, min(PAGE, 0.85 * size + 0.2))
    with styled_figure(files, side, side + 0.3 + legend_height(_path_handles(), side), dense=True) as figure:
        grid = figure.subplots(size, size, squeeze=False)
        for (row, column), axes in np.ndenumerate(grid):
            _draw_paths(axes, paths, row, column, small=True)
            if row == size - 1:
                axes.set_xlabel(f"{column + 1}", labelpad=2)
            if column == 0:
                axes.set_ylabel(f"{row + 1}", rotation=0, labelpad=5, va="center")
        figure.suptitle(f"{title}\nrows: agent in seat 0; columns: agent in seat 1", fontsize=8)
        add_legend(figure, _path_handles())


@dataclass(frozen=True)
class PathSample:
    """One episode to show.

    Attributes:
        title: above it.
        paths: of the population.
        seats: the members (from 1) in seat 0 and 1.
    """

    title: str
    paths: Paths
    seats: tuple[int, int]


def path_samples(samples: Sequence[PathSample], files: Sequence[str | Path]) -> None:
    """Episodes of several populations side by side."""
    columns = min(3, len(samples))
    rows = -(-len(samples) // max(1, columns))
    with styled_figure(files, COLUMN, 1.42 * rows + 0.05 + legend_height(_path_handles(), COLUMN)) as figure:
        for axes, sample in zip(add_panels(figure, len(samples), columns), samples, strict=True):
            first, second = sample.seats
            _draw_paths(axes, sample.paths, first - 1, second - 1, small=False)
            axes.set_title(sample.title, fontsize=7)
        add_legend(figure, _path_handles())


def _draw_paths(axes: Axes, paths: Paths, row: int, column: int, *, small: bool) -> None:
    """Bounds (shaded where one left), landmarks, both ways from their starts (dots); a cross where one left."""
    edge, size = paths.bounds, 1.0 if small else 2.0
    look: dict[str, Any] = {
        "facecolor": "#EEEEEE" if paths.left[row, column].any() else "white",
        "edgecolor": "#888888",
    }
    axes.add_patch(Rectangle((-edge, -edge), 2 * edge, 2 * edge, linewidth=0.6, zorder=0, **look))
    axes.plot(*paths.landmarks.T, "s", color="#999999", markersize=2.2 * size, markeredgewidth=0)
    for seat, (colour, line) in enumerate(zip(SEAT_COLOURS, ("-", (0, (3, 1))), strict=True)):
        way = paths.positions[row, column, :, seat]
        way = way[np.isfinite(way).all(axis=-1)]
        axes.plot(*way.T, linestyle=line, color=colour, linewidth=0.45 * size + 0.3)
        axes.plot(*way[0], "o", color=colour, markersize=1.5 * size)
        if paths.left[row, column, seat]:
            axes.plot(*way[-1], "x", color=colour, markersize=1.5 + 1.7 * size, markeredgewidth=0.5 + 0.5 * size)
    axes.set_xlim(-1.2 * edge, 1.2 * edge)
    axes.set_ylim(-1.2 * edge, 1.2 * edge)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _path_handles() -> list[Artist]:
    style: dict[str, Any] = {"markersize": 4, "linewidth": 1.2}
    seats: list[Artist] = [
        Line2D([], [], color=colour, linestyle=line, label=f"seat {seat}", **style)
        for seat, (colour, line) in enumerate(zip(SEAT_COLOURS, ("-", "--"), strict=True))
    ]
    marks = [
        Line2D([], [], color="#999999", marker="s", linestyle="none", label="landmark", **style),
        Line2D([], [], color="black", marker="o", linestyle="none", markersize=3, label="start"),
        Line2D([], [], color="black", marker="x", linestyle="none", markersize=4, label="left bounds"),
    ]
    return [*seats, *marks]
