"""The SP/XP matrix as a heat map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np

from popgen.evaluation.crossplay import PARTNERS
from popgen.reports.charts.chart_style import COLUMN, styled_figure
from popgen.reports.method_titles import title_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

    from popgen.evaluation.crossplay import CrossPlayResult


def crossplay_heat_map(result: CrossPlayResult, paths: Sequence[str | Path]) -> None:
    """The SP/XP matrix with numbers in its cells, set apart from the play beside random and idle partners.

    Rows are the player in seat 0, columns the player in seat 1; the colour is the mean score.
    """
    labels = (*result.labels, *PARTNERS)
    mean, error = result.to_frame("mean", labels).to_numpy(), result.to_frame("error", labels).to_numpy()
    size = len(labels)
    width = max(COLUMN, 0.62 * size + 1.3)
    with styled_figure(paths, width, 0.44 * size + 1.25) as figure:
        axes = figure.add_subplot()
        image = _draw_cells(axes, mean, error)
        figure.colorbar(image, ax=axes, label=result.environment.score_name, pad=0.02)
        axes.set_xticks(range(size), labels)
        axes.set_yticks(range(size), labels)
        axes.set_xlabel("player in seat 1")
        axes.set_ylabel("player in seat 0")
        title = f"{result.environment.name}, {title_of(result.method)}, seed {result.training_seed}"
        axes.set_title(f"{title}\nSP {result.sp.mean:.2f}, XP {result.xp.mean:.2f}")


def _draw_cells(axes: Axes, mean: np.ndarray, error: np.ndarray) -> ScalarMappable:
    colours = matplotlib.colormaps["cividis"]
    low = min(0.0, float(np.nanmin(mean)))
    high = float(np.nanmax(mean))
    high = high if high > low else low + 1.0
    axes.set_facecolor("white")  # shows where nothing was played
    image = axes.imshow(np.ma.masked_invalid(mean), cmap=colours, vmin=low, vmax=high, aspect="auto")
    for (row, column), value in np.ndenumerate(mean):
        if math.isnan(value):
            continue
        ink = "black" if (value - low) / (high - low) > 0.5 else "white"
        spread = "" if math.isnan(error[row, column]) else f"\n±{error[row, column]:.2f}"
        text = f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
        axes.text(column, row, text + spread, ha="center", va="center", color=ink, fontsize=6.5, linespacing=1.0)
    members = len(mean) - len(PARTNERS)
    for draw_line in (axes.axhline, axes.axvline):
        draw_line(members - 0.5, color="white", linewidth=3)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0)
    return image
