"""Charts against the number of agents: steps, time and quality of methods beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from popgen.reports.charts.chart_style import (
    COLOURS,
    COLUMN,
    GREY,
    MARKERS,
    PAGE,
    add_legend,
    add_panels,
    format_steps,
    legend_height,
    styled_figure,
)
from popgen.reports.method_titles import METHODS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from popgen.reports.comparison import Band

KIND_COLOURS = {"random": "#BBBBBB", "SP": COLOURS[0], "XP": COLOURS[1], "MP": COLOURS[3]}
"""Colour of each kind of real environment steps."""

_LOG_FROM = 20
"""Ratio of the largest to the smallest last point from which the vertical axis is logarithmic."""


@dataclass(frozen=True)
class Look:
    """How a line is drawn."""

    colour: str
    marker: str


@dataclass(frozen=True)
class Line:
    """One line of `bands_by_members`.

    Attributes:
        label: decides colour and marker (`choose_looks`).
        name: in the legend.
        band: what is drawn.
    """

    label: str
    name: str
    band: Band


@dataclass(frozen=True)
class Panel:
    """One panel of `bands_by_members`; panels with the same text on the axis have the same scale.

    Attributes:
        title: above it.
        axis: what is on the vertical axis, with its unit.
        lines: of the panel.
        scale: the bands' figures are divided by this.
    """

    title: str
    axis: str
    lines: Sequence[Line]
    scale: float = 1.0


def choose_looks(labels: Sequence[str]) -> dict[str, Look]:
    """Label -> colour and marker: a method's own; other labels get those that no method here has."""
    labels = list(dict.fromkeys(labels))
    own = {label: Look(METHODS[label].colour, METHODS[label].marker) for label in labels if label in METHODS}
    colours = [c for c in COLOURS if c not in {look.colour for look in own.values()}] or list(COLOURS)
    markers = [m for m in MARKERS if m not in {look.marker for look in own.values()}]
    others = [label for label in labels if label not in own]
    free = {label: Look(colours[n % len(colours)], markers[n % len(markers)]) for n, label in enumerate(others)}
    return own | free


def bands_by_members(
    panels: Sequence[Panel], paths: Sequence[str | Path], *, hollow: str, bounds: bool = False
) -> None:
    """A figure against the number of agents: panels of lines, each with the range over its seeds.

    Args:
        panels: to draw.
        paths: files to write.
        hollow: what a hollow marker with a dashed line means; its points are those not measured.
        bounds: hollow points are lower bounds; an arrow says so.
    """
    lines = [line for panel in panels for line in panel.lines]
    looks = choose_looks([line.label for line in lines])
    handles = _band_handles(lines, looks, hollow)
    columns = min(2, len(panels))
    width = COLUMN if columns < 2 else PAGE
    rows = -(-len(panels) // max(1, columns))
    with styled_figure(paths, width, 2.1 * rows + legend_height(handles, width)) as figure:
        for axes, panel in zip(add_panels(figure, len(panels), columns), panels, strict=True):
            for line in panel.lines:
                _draw_band(axes, line.band, looks[line.label], panel.scale)
                if bounds:
                    _draw_arrows(axes, line.band, looks[line.label].colour, panel.scale)
            axes.set_title(panel.title)
            axes.set_ylabel(panel.axis)
            _set_agents_axis(axes, max((int(line.band.agents.max(initial=1)) for line in panel.lines), default=1), 8)
            _set_scale(axes, [other for other in panels if other.axis == panel.axis], 1.2 if bounds else 1.06)
        add_legend(figure, handles)


def _draw_band(axes: Axes, band: Band, look: Look, scale: float) -> None:
    """Measured points filled with a solid line, the others hollow with a dashed one, the range over seeds shaded."""
    mean, last = band.mean / scale, int(band.measured.sum())  # measured points come first
    style: dict[str, Any] = {"color": look.colour, "marker": look.marker, "markersize": 3.5, "clip_on": False}
    if (band.high > band.low).any():
        low, high = band.low / scale, band.high / scale
        axes.fill_between(band.agents, low, high, color=look.colour, alpha=0.2, linewidth=0)
    rest = slice(max(0, last - 1), None)  # the dashed line begins at the last measured point
    axes.plot(band.agents[rest], mean[rest], "--", color=look.colour, linewidth=0.9)
    if last:  # an empty line that is not clipped would count in the layout
        axes.plot(band.agents[:last], mean[:last], "-", linewidth=1.4, **style)
    if last < len(mean):
        axes.plot(band.agents[last:], mean[last:], linestyle="none", markerfacecolor="white", zorder=3, **style)


def _draw_arrows(axes: Axes, band: Band, colour: str, scale: float) -> None:
    """Upwards from each point that is not measured."""
    for agents, value in zip(band.agents[~band.measured], band.mean[~band.measured] / scale, strict=True):
        # The head is at the end of the (empty) text, above the point.
        look = {"arrowstyle": "<-", "color": colour, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 3}
        axes.annotate("", (agents, value), (0, 14), textcoords="offset points", arrowprops=look)


def _set_agents_axis(axes: Axes, largest: int, ticks: int) -> None:
    axes.set_xticks(range(1, largest + 1, max(1, largest // ticks)))
    axes.set_xlim(0.6, largest + 0.4)
    axes.set_xlabel("number of agents M")


def _set_scale(axes: Axes, alike: Sequence[Panel], room: float) -> None:
    """One scale for all panels of one axis, logarithmic where last points are far apart."""
    bands = [(line.band, panel.scale) for panel in alike for line in panel.lines if len(line.band.mean)]
    ends = [float(band.mean[-1]) / scale for band, scale in bands if band.mean[-1] > 0]
    top = max((float(band.high.max()) / scale for band, scale in bands), default=0.0) or 1.0
    if ends and max(ends) > _LOG_FROM * min(ends):
        positive = [float(band.low[band.low > 0].min()) / scale for band, scale in bands if (band.low > 0).any()]
        axes.set_yscale("log")
        axes.set_ylim(min(positive) / 1.5, top * 1.5)
    else:
        axes.set_ylim(0, room * top)
    format_steps(axes, "y")


def _band_handles(lines: Sequence[Line], looks: Mapping[str, Look], hollow: str) -> list[Artist]:
    style: dict[str, Any] = {"markersize": 4, "linewidth": 1.3}
    names = {line.label: line.name for line in lines}
    handles: list[Artist] = [
        Line2D([], [], color=looks[label].colour, marker=looks[label].marker, label=name, **style)
        for label, name in names.items()
    ]
    if any(not line.band.measured.all() for line in lines):
        handles.append(Line2D([], [], color=GREY, linestyle="--", marker="o", mfc="white", label=hollow, **style))
    if any((line.band.high > line.band.low).any() for line in lines):
        handles.append(Patch(color=GREY, alpha=0.2, linewidth=0, label="range over seeds"))
    return handles


@dataclass(frozen=True)
class KindPanel:
    """One panel of `kinds_by_members`.

    Attributes:
        title: above it.
        kinds: kind -> band of real steps.
        simulated: steps of an exact simulator used as dynamics model.
    """

    title: str
    kinds: Mapping[str, Band]
    simulated: Band

    @property
    def tallest(self) -> float:
        """Real steps of all kinds where they are most."""
        return float(sum(band.mean for band in self.kinds.values()).max(initial=0.0))  # type: ignore[union-attr]


def kinds_by_members(panels: Sequence[KindPanel], paths: Sequence[str | Path], *, title: str = "") -> None:
    """Real environment steps by kind against the number of agents: a panel of stacked bars for each method.

    All panels have one scale. Simulated steps are no real ones: they are crosses on an axis of their own, to the right.
    """
    handles = _kind_handles(panels)
    columns = min(2 if len(panels) <= 4 else 4, len(panels))
    rows = -(-len(panels) // max(1, columns))
    width = COLUMN if columns < 2 else PAGE
    top = max((panel.tallest for panel in panels), default=0.0) or 1.0
    right_top = max((float(panel.simulated.mean.max(initial=0.0)) for panel in panels), default=0.0)
    with styled_figure(paths, width, 1.6 * rows + 0.2 + legend_height(handles, width)) as figure:
        for number, (axes, panel) in enumerate(zip(add_panels(figure, len(panels), columns), panels, strict=True)):
            _draw_stack(axes, panel)
            axes.set_ylim(0, 1.06 * top)
            axes.set_title(panel.title)
            _set_agents_axis(axes, int(panel.simulated.agents.max(initial=1)), 8)
            if number < len(panels) - columns:
                axes.set_xlabel("")
            if (panel.simulated.mean > 0).any():
                _draw_simulated(axes, panel.simulated, right_top)
        figure.supylabel("real environment steps", fontsize=8)
        if title:
            figure.suptitle(title, fontsize=8)
        add_legend(figure, handles)


def _draw_stack(axes: Axes, panel: KindPanel) -> None:
    """Bars of the means, extrapolated ones pale and hatched."""
    below = np.zeros(len(panel.simulated.agents))
    for kind, band in panel.kinds.items():
        style: dict[str, Any] = {"color": KIND_COLOURS[kind], "edgecolor": "white", "linewidth": 0.3}
        for rows, look in ((band.measured, {}), (~band.measured, {"alpha": 0.45, "hatch": "////"})):
            axes.bar(band.agents[rows], band.mean[rows], 0.75, bottom=below[rows], **style, **look)
        below = below + band.mean
    format_steps(axes, "y")
    axes.grid(axis="x", visible=False)


def _draw_simulated(axes: Axes, band: Band, top: float) -> None:
    right = axes.twinx()
    right.plot(band.agents, band.mean, "x", color="black", markersize=3.5, clip_on=False)
    right.set_ylim(0, 1.06 * top)
    right.set_ylabel("simulated steps", fontsize=7)
    right.spines["right"].set_visible(True)
    format_steps(right, "y")
    right.grid(visible=False)


def _kind_handles(panels: Sequence[KindPanel]) -> list[Artist]:
    bands = [pair for panel in panels for pair in panel.kinds.items()]
    used = [kind for kind in KIND_COLOURS if any(name == kind and (band.mean > 0).any() for name, band in bands)]
    handles: list[Artist] = [Patch(color=KIND_COLOURS[kind], label=kind) for kind in used]
    if any(not band.measured.all() for _, band in bands):
        handles.append(Patch(facecolor="#BBBBBB", edgecolor="white", hatch="////", alpha=0.6, label="extrapolated"))
    if any((panel.simulated.mean > 0).any() for panel in panels):
        style: dict[str, Any] = {"color": "black", "marker": "x", "linestyle": "none", "markersize": 4}
        handles.append(Line2D([], [], label="simulated, right axis", **style))
    return handles
