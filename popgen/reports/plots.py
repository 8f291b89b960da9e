"""Figures at the width of a paper's column, as PNG and SVG, in colours that the colour-blind can tell apart."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from popgen.evaluation.crossplay import IDLE, RANDOM

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from popgen.evaluation.crossplay import CrossPlayResult
    from popgen.evaluation.sabotage import Paths
    from popgen.reports.comparison import Band

COLUMN = 3.4
"""Width of a figure in inches: one column of a two-column page."""

PAGE = 6.9
"""Width in inches of a figure over both columns."""

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, yellow left out (too pale for lines)."""

METHOD_COLOURS = {
    "xpm_wm": COLOURS[0],
    "lipo": COLOURS[1],
    "xpm_sim": COLOURS[2],
    "comedi": COLOURS[3],
    "mappo": COLOURS[4],
}
"""Colour of each method on every chart; runs under other names take what is left."""

METHOD_MARKERS = {"xpm_wm": "o", "lipo": "s", "xpm_sim": "D", "comedi": "^", "mappo": "v"}

KIND_COLOURS = {"random": "#BBBBBB", "SP": COLOURS[0], "XP": COLOURS[1], "MP": COLOURS[3]}
"""Colour of each kind of real environment steps."""

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


def method_styles(labels: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Label -> (colour, marker): a method's own, for other labels those that no method here has."""
    labels = list(dict.fromkeys(labels))
    known = {label: (METHOD_COLOURS[label], METHOD_MARKERS[label]) for label in labels if label in METHOD_COLOURS}
    taken = [*known.values()]
    colours = [c for c in COLOURS if c not in {colour for colour, _ in taken}] or list(COLOURS)
    markers = [m for m in "<>hpdosD^v" if m not in {marker for _, marker in taken}]
    others = [label for label in labels if label not in known]
    free = {label: (colours[n % len(colours)], markers[n % len(markers)]) for n, label in enumerate(others)}
    return known | free


@dataclass(frozen=True)
class Line:
    """One line of `bands_by_members`.

    Attributes:
        label: decides colour and marker (`method_styles`).
        name: in the legend.
        band: what is drawn.
        dotted: a figure of another sort than the others of the panel, such as simulated steps.
    """

    label: str
    name: str
    band: Band
    dotted: bool = False


def bands_by_members(
    panels: Mapping[str, Sequence[Line]],
    paths: Sequence[str | Path],
    *,
    axis: str,
    hollow: str,
    dotted: str = "",
    bounds: bool = False,
    scale: float = 1.0,
) -> None:
    """A figure against the number of agents, a panel for each environment, a line with its band for each label.

    Args:
        panels: title -> lines.
        paths: files to write.
        axis: what is on the vertical axis, with its unit.
        hollow: what a hollow marker with a dashed line means; its points are those not measured.
        dotted: what a dotted line means.
        bounds: hollow points are lower bounds; an arrow says so.
        scale: the band's figures are divided by this.
    """
    styles = method_styles([line.label for lines in panels.values() for line in lines])
    handles = _band_handles([line for lines in panels.values() for line in lines], styles, hollow, dotted)
    columns = min(2, len(panels))
    rows = -(-len(panels) // max(1, columns))
    width = COLUMN if columns < 2 else PAGE
    with _figure(paths, width, 2.1 * rows + _legend_height(handles, width)) as figure:
        grid = np.atleast_1d(figure.subplots(rows, columns, squeeze=False).ravel())
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        for axes, (title, lines) in zip(grid, panels.items(), strict=False):
            for line in lines:
                _band(axes, line, *styles[line.label], scale)
                if bounds:
                    _arrows(axes, line, styles[line.label][0], scale)
            _members_axis(axes, [line.band for line in lines], title, axis, scale)
            if bounds:  # room for arrows
                low, high = axes.get_ylim()
                axes.set_ylim(low, 1.12 * high)
        _legend(figure, handles)


def _band(axes: Axes, line: Line, colour: str, marker: str, scale: float) -> None:
    """Measured points filled with a solid line, the others hollow with a dashed one, the range over seeds shaded."""
    band = line.band
    mean, known = band.mean / scale, band.measured
    last = int(known.sum())  # measured points come first
    if line.dotted:
        axes.plot(band.agents[:last], mean[:last], ":", color=colour, linewidth=1.3)
        axes.plot(band.agents[max(0, last - 1) :], mean[max(0, last - 1) :], ":", color=colour, linewidth=0.7)
        return
    style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 3.5}
    axes.plot(band.agents[:last], mean[:last], "-", linewidth=1.4, **style)
    rest = slice(max(0, last - 1), None)  # the dashed line begins at the last measured point
    axes.plot(band.agents[rest], mean[rest], "--", color=colour, linewidth=0.9)
    axes.plot(band.agents[last:], mean[last:], linestyle="none", markerfacecolor="white", **style)
    if (band.high > band.low).any():
        axes.fill_between(band.agents, band.low / scale, band.high / scale, color=colour, alpha=0.2, linewidth=0)


def _arrows(axes: Axes, line: Line, colour: str, scale: float) -> None:
    """Upwards from each point that is not measured."""
    band = line.band
    for agents, value in zip(band.agents[~band.measured], band.mean[~band.measured] / scale, strict=True):
        # The head is at the end of the (empty) text, above the point.
        look = {"arrowstyle": "<-", "color": colour, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 3}
        axes.annotate("", (agents, value), (0, 14), textcoords="offset points", arrowprops=look)


def _members_axis(axes: Axes, bands: Sequence[Band], title: str, label: str, scale: float) -> None:
    largest = max((int(band.agents.max()) for band in bands if len(band.agents)), default=1)
    axes.set_xticks(range(1, largest + 1, max(1, largest // 8)))
    axes.set_xlabel("number of agents M")
    axes.set_ylabel(label)
    axes.set_title(title)
    ends = [float(band.mean[-1]) for band in bands if len(band.mean) and band.mean[-1] > 0]
    if ends and max(ends) > 20 * min(ends):
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, 1.06 * max((float(band.high.max()) / scale for band in bands if len(band.high)), default=1.0))
    axes.yaxis.set_major_formatter(_thousands)
    axes.grid(alpha=0.25, linewidth=0.5)


def _band_handles(
    lines: Sequence[Line], styles: Mapping[str, tuple[str, str]], hollow: str, dotted: str
) -> list[Artist]:
    named = {line.label: line.name for line in lines if not line.dotted}
    style: dict[str, Any] = {"markersize": 4, "linewidth": 1.3}
    handles: list[Artist] = [
        Line2D([], [], color=styles[label][0], marker=styles[label][1], label=name, **style)
        for label, name in named.items()
    ]
    if any(not line.band.measured.all() for line in lines if not line.dotted):
        handles.append(Line2D([], [], color="#444444", linestyle="--", marker="o", mfc="white", label=hollow, **style))
    if any(line.dotted for line in lines):
        handles.append(Line2D([], [], color="#444444", linestyle=":", label=dotted, linewidth=1.3))
    if any((line.band.high > line.band.low).any() for line in lines):
        handles.append(Patch(color="#444444", alpha=0.2, linewidth=0, label="range over seeds"))
    return handles


def _legend_columns(handles: Sequence[Artist], width: float) -> int:
    """As many as fit into `width` inches."""
    longest = max((len(str(handle.get_label())) for handle in handles), default=1)
    return max(1, min(len(handles), int(width / (0.052 * longest + 0.48))))


def _legend_height(handles: Sequence[Artist], width: float) -> float:
    """Inches that the legend takes."""
    return 0.15 + 0.15 * -(-len(handles) // _legend_columns(handles, width)) if handles else 0.0


def _legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Below everything else."""
    columns = _legend_columns(handles, figure.get_figwidth())
    if handles:
        place = {"loc": "outside lower center", "ncols": columns, "handlelength": 2.6, "columnspacing": 1.2}
        figure.legend(handles=list(handles), frameon=False, **place)


def kinds_by_members(
    panels: Mapping[str, tuple[Mapping[str, Band], Band]], paths: Sequence[str | Path], *, title: str = ""
) -> None:
    """Environment steps by kind against the number of agents: a panel of stacked bars for each method.

    Every panel has its own scale: what is compared here are the kinds.

    Args:
        panels: title -> (kind -> band of real steps, band of simulated steps). The latter, where there are any, are
            drawn as crosses on an axis of their own, for they are no real steps.
        paths: files to write.
        title: of all panels.
    """
    handles = _kind_handles(panels)
    columns = min(2 if len(panels) <= 4 else 4, len(panels))
    rows = -(-len(panels) // max(1, columns))
    width = COLUMN if columns <= 2 else PAGE
    with _figure(paths, width, 1.5 * rows + 0.2 + _legend_height(handles, width)) as figure:
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        for number, (axes, (name, (kinds, simulated))) in enumerate(zip(grid, panels.items(), strict=False)):
            _stack(axes, kinds, simulated)
            axes.set_title(name)
            if number >= len(panels) - columns:
                axes.set_xlabel("number of agents M")
        figure.supylabel("environment steps", fontsize=8)
        if title:
            figure.suptitle(title, fontsize=8)
        _legend(figure, handles)


def _stack(axes: Axes, kinds: Mapping[str, Band], simulated: Band) -> None:
    """Bars of the means, extrapolated ones pale and hatched."""
    below = np.zeros(len(simulated.agents))
    for kind, band in kinds.items():
        for known, look in ((band.measured, {}), (~band.measured, {"alpha": 0.45, "hatch": "////"})):
            axes.bar(
                *(band.agents[known], band.mean[known], 0.75),
                bottom=below[known],
                color=KIND_COLOURS[kind],
                edgecolor="white",
                linewidth=0.3,
                **look,
            )
        below = below + band.mean
    axes.set_ylim(0, 1.06 * max(float(below.max(initial=0.0)), 1.0))
    axes.yaxis.set_major_formatter(_thousands)
    axes.grid(axis="y", alpha=0.25, linewidth=0.5)
    axes.set_axisbelow(True)
    if (simulated.mean > 0).any():
        right = axes.twinx()
        right.plot(simulated.agents, simulated.mean, "x", color="black", markersize=3.5)
        right.set_ylim(0, 1.06 * float(simulated.mean.max()))
        right.spines["right"].set_visible(True)
        right.yaxis.set_major_formatter(_thousands)
    largest = int(simulated.agents.max()) if len(simulated.agents) else 1
    axes.set_xticks(range(1, largest + 1, max(1, largest // 4)))


def _kind_handles(panels: Mapping[str, tuple[Mapping[str, Band], Band]]) -> list[Artist]:
    bands = [pair for kinds, _ in panels.values() for pair in kinds.items()]
    used = [kind for kind in KIND_COLOURS if any(name == kind and (band.mean > 0).any() for name, band in bands)]
    handles: list[Artist] = [Patch(color=KIND_COLOURS[kind], label=kind) for kind in used]
    if any(not band.measured.all() for _, band in bands):
        handles.append(Patch(facecolor="#BBBBBB", edgecolor="white", hatch="////", alpha=0.6, label="extrapolated"))
    if any((simulated.mean > 0).any() for _, simulated in panels.values()):
        style: dict[str, Any] = {"color": "black", "marker": "x", "linestyle": "none", "markersize": 4}
        handles.append(Line2D([], [], label="simulated, right axis", **style))
    return handles


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
    with _figure(files, side, side + 0.3 + _legend_height(_path_handles(), side)) as figure:
        figure.get_layout_engine().set(w_pad=0.015, h_pad=0.015, wspace=0.0, hspace=0.0)
        grid = figure.subplots(size, size, squeeze=False)
        for (row, column), axes in np.ndenumerate(grid):
            _draw_paths(axes, paths, row, column, small=True)
            if row == size - 1:
                axes.set_xlabel(f"{column + 1}", labelpad=2)
            if column == 0:
                axes.set_ylabel(f"{row + 1}", rotation=0, labelpad=5, va="center")
        figure.suptitle(f"{title}\nrows: agent in seat 0; columns: agent in seat 1", fontsize=8)
        _legend(figure, _path_handles())


def path_samples(
    samples: Sequence[tuple[str, Paths, tuple[int, int]]], files: Sequence[str | Path], *, title: str = ""
) -> None:
    """One pair of members each: (title, paths, members in seat 0 and 1), side by side."""
    columns = min(3, len(samples))
    rows = -(-len(samples) // max(1, columns))
    with _figure(files, COLUMN, 1.42 * rows + 0.05 + _legend_height(_path_handles(), COLUMN)) as figure:
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid[len(samples) :]:
            axes.set_visible(False)
        for axes, (name, paths, (first, second)) in zip(grid, samples, strict=False):
            _draw_paths(axes, paths, first - 1, second - 1, small=False)
            axes.set_title(name, fontsize=7)
        if title:
            figure.suptitle(title, fontsize=8)
        _legend(figure, _path_handles())


def _draw_paths(axes: Axes, paths: Paths, row: int, column: int, *, small: bool) -> None:
    """Bounds (shaded where one left), landmarks, both ways from their starts (dots); a cross where one left."""
    edge, size = paths.bounds, 1.0 if small else 2.0
    look = {"facecolor": "#EEEEEE" if paths.left[row, column].any() else "white", "edgecolor": "#888888"}
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
