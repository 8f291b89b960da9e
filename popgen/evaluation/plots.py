"""Figures at the width of a paper's column, as PNG and SVG, in colours that the colour-blind can tell apart."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from popgen.evaluation.crossplay import IDLE, RANDOM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from popgen.evaluation.crossplay import CrossPlayResult

COLUMN = 3.4
"""Width of a figure in inches: one column of a two-column page."""

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, yellow left out (too pale for lines)."""

_LINES = ("-", "--", "-.", ":")
_STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "popgen",  # the same figure gives the same file
}


@contextmanager
def _figure(paths: Sequence[str | Path], width: float, height: float) -> Iterator[Figure]:
    """A styled figure that is saved to `paths` (by suffix) on leaving; needs no display."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        for path in paths:
            dateless = {"Date": None} if Path(path).suffix == ".svg" else {}
            figure.savefig(path, dpi=300, metadata=dateless)


def crossplay_heat_map(result: CrossPlayResult, paths: Sequence[str | Path]) -> None:
    """The SP/XP matrix with numbers in its cells, set apart from the play beside random and idle partners.

    Rows are the player in seat 0, columns the player in seat 1; the colour is the mean score.
    """
    labels = (*result.labels, RANDOM, IDLE)
    mean, error = result.table(labels)
    size = len(labels)
    width = max(COLUMN, 0.62 * size + 1.3)
    with _figure(paths, width, 0.44 * size + 1.25) as figure:
        axes = figure.add_subplot()
        image = _heat(axes, mean, error)
        figure.colorbar(image, ax=axes, label=result.environment.score_name, pad=0.02)
        axes.set_xticks(range(size), labels)
        axes.set_yticks(range(size), labels)
        axes.set_xlabel("player in seat 1")
        axes.set_ylabel("player in seat 0")
        axes.set_title(f"{result.environment.name}\nSP {result.sp.mean:.2f}, XP {result.xp.mean:.2f}")


def _heat(axes: Axes, mean: np.ndarray, error: np.ndarray) -> matplotlib.cm.ScalarMappable:
    colours = matplotlib.colormaps["cividis"]
    low = min(0.0, float(np.nanmin(mean)))
    high = max(float(np.nanmax(mean)), low + 1e-9)
    axes.set_facecolor("white")  # shows where nothing was played
    image = axes.imshow(np.ma.masked_invalid(mean), cmap=colours, vmin=low, vmax=high, aspect="auto")
    for (row, column), value in np.ndenumerate(mean):
        if math.isnan(value):
            continue
        ink = "black" if (value - low) / (high - low) > 0.5 else "white"
        spread = "" if math.isnan(error[row, column]) else f"\n±{error[row, column]:.2f}"
        text = f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
        axes.text(column, row, text + spread, ha="center", va="center", color=ink, fontsize=6.5, linespacing=1.0)
    members = len(mean) - 2
    for at in (axes.axhline, axes.axvline):
        at(members - 0.5, color="white", linewidth=3)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0)
    return image


def _thousands(value: float, _: int | None = None) -> str:
    """Steps as text: 250k, 1.5M."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{unit}"
    return f"{value:.3g}"


def learning_curves(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    paths: Sequence[str | Path],
    *,
    unit: str = "score",
    title: str = "",
) -> None:
    """Score over environment steps, one line per curve: name -> (steps, scores), told apart by colour and dashes."""
    with _figure(paths, COLUMN, 2.3) as figure:
        axes = figure.add_subplot()
        for number, (name, (steps, scores)) in enumerate(curves.items()):
            style = _LINES[number // len(COLOURS) % len(_LINES)] if len(curves) > len(_LINES) else _LINES[number]
            axes.plot(steps, scores, style, color=COLOURS[number % len(COLOURS)], label=name, linewidth=1.3)
        axes.set_xlabel("environment steps")
        axes.set_ylabel(unit)
        axes.set_title(title)
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(_thousands)
        axes.grid(alpha=0.25, linewidth=0.5)
        if curves:
            figure.legend(loc="outside lower center", ncols=min(3, len(curves)), frameon=False)


def steps_by_members(
    steps: Mapping[str, Sequence[float]], paths: Sequence[str | Path], *, title: str = "", log: bool = False
) -> None:
    """Environment steps in all after 1, 2, ..., M members, one line per method or run: name -> M cumulative sums."""
    with _figure(paths, COLUMN, 2.3) as figure:
        axes = figure.add_subplot()
        markers = "osD^vPX"
        for number, (name, totals) in enumerate(steps.items()):
            colour, marker = COLOURS[number % len(COLOURS)], markers[number % len(markers)]
            at = range(1, len(totals) + 1)
            axes.plot(at, totals, color=colour, marker=marker, markersize=4, linewidth=1.3, label=name)
        largest = max((len(totals) for totals in steps.values()), default=1)
        axes.set_xticks(range(1, largest + 1, max(1, largest // 10)))
        axes.set_xlabel("members")
        axes.set_ylabel("environment steps in all")
        axes.set_title(title)
        if log:
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        axes.yaxis.set_major_formatter(_thousands)
        axes.grid(alpha=0.25, linewidth=0.5)
        if steps:
            figure.legend(loc="outside lower center", ncols=min(3, len(steps)), frameon=False)
