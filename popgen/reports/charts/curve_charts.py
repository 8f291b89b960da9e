"""A run's own charts: scores and other figures in training, and environment steps after each member."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.lines import Line2D

from popgen.reports.charts.chart_style import (
    COLOURS,
    COLUMN,
    GREY,
    MARKERS,
    add_legend,
    format_steps,
    legend_height,
    styled_figure,
)
from popgen.reports.training_series import SHARE

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from popgen.reports.training_curves import Point
    from popgen.reports.training_series import SeriesPanel

DASHES = {"SP": "-", "strongest XP": (0, (3, 1.2))}
"""Line of each score; a member's two lines have one colour."""

Curves = Mapping[int, Sequence["Point"]]
"""Member -> its real play in training."""


def learning_curves(
    curves: Curves,
    paths: Sequence[str | Path],
    *,
    unit: str = "score",
    title: str = "",
    limits: tuple[float, float] | None = None,
) -> None:
    """Real self-play and strongest cross-play over the members' own real steps, a colour a member.

    Args:
        curves: of the members to draw.
        paths: files to write.
        unit: of the scores.
        title: of the figure.
        limits: of the vertical axis, where several figures are to have one scale.
    """
    looks = {member: _member_look(member - 1) for member in curves}
    has_partners = any(point.xp is not None for points in curves.values() for point in points)
    handles: list[Artist] = [Line2D([], [], label=f"member {m}", linewidth=1.3, **look) for m, look in looks.items()]
    for score, dashes in DASHES.items() if has_partners else ():
        handles.append(Line2D([], [], color=GREY, linestyle=dashes, linewidth=1.3, label=score))
    with styled_figure(paths, COLUMN, 2.05 + legend_height(handles, COLUMN)) as figure:
        axes = figure.add_subplot()
        for member, points in curves.items():
            style = {"linewidth": 1.2, "markevery": max(1, len(points) // 6), "clip_on": False, **looks[member]}
            axes.plot([p.step for p in points], [p.sp for p in points], linestyle=DASHES["SP"], **style)
            versus = [(p.step, p.xp) for p in points if p.xp is not None]
            axes.plot(*zip(*versus, strict=True), linestyle=DASHES["strongest XP"], **style) if versus else None
        axes.set_xlabel("real environment steps of the member")
        axes.set_ylabel(unit)
        axes.set_title(title)
        axes.set_xlim(left=0)
        axes.set_ylim(limits)
        format_steps(axes, "x")
        add_legend(figure, handles)


def score_limits(curves: Curves) -> tuple[float, float] | None:
    """A vertical axis that has room for all curves."""
    scores = [score for points in curves.values() for p in points for score in (p.sp, p.xp) if score is not None]
    if not scores:
        return None
    low, high = min(0.0, *scores), max(0.0, *scores)
    margin = 0.05 * (high - low) or 1.0
    return (low - margin if low < 0 else 0.0), high + margin


def _member_look(number: int) -> dict[str, Any]:
    """The member's colour, the same in all charts; beyond as many members as there are colours a marker too."""
    marker = ("", *MARKERS)[number // len(COLOURS) % (len(MARKERS) + 1)]
    return {"color": COLOURS[number % len(COLOURS)], "marker": marker, "markersize": 3.5}


def steps_by_members(totals: Sequence[float], paths: Sequence[str | Path], *, title: str = "") -> None:
    """Real environment steps in all after 1, 2, ..., M members."""
    with styled_figure(paths, COLUMN, 2.2) as figure:
        axes = figure.add_subplot()
        size = len(totals)
        style: dict[str, Any] = {"color": COLOURS[0], "marker": "o", "markersize": 4, "linewidth": 1.3}
        axes.plot(range(1, size + 1), totals, clip_on=False, **style)
        axes.set_xticks(range(1, size + 1, max(1, size // 10)))
        axes.set_xlabel("number of agents M")
        axes.set_ylabel("real environment steps in all")
        axes.set_title(title)
        axes.set_ylim(0, 1.06 * max(totals, default=1.0) or 1.0)
        format_steps(axes, "y")


SERIES_DASHES: tuple[Any, ...] = ("-", (0, (3, 1.2)), (0, (1, 1)))
"""Lines of a panel's figures, in their order."""


def series_chart(
    panel: SeriesPanel,
    paths: Sequence[str | Path],
    *,
    title: str = "",
    limits: tuple[float, float] | None = None,
) -> None:
    """Figures over the run's time: a colour a member, a dash a figure.

    Args:
        panel: to draw.
        paths: files to write.
        title: of the figure.
        limits: of the vertical axis, where several figures are to have one scale.
    """
    looks = {member: _member_look(member - 1) for member in panel.members}
    handles: list[Artist] = [Line2D([], [], label=f"member {m}", linewidth=1.3, **look) for m, look in looks.items()]
    with styled_figure(paths, COLUMN, 2.15 + legend_height(handles, COLUMN)) as figure:
        axes = figure.add_subplot()
        _draw_series(axes, panel, looks)
        axes.set_xlabel("minutes since the run began")
        axes.set_title(f"{title}\n{panel.title}" if title else panel.title)
        if limits is not None:
            axes.set_ylim(limits)
        add_legend(figure, handles)


def _draw_series(axes: Axes, panel: SeriesPanel, looks: Mapping[int, Mapping[str, Any]]) -> None:
    for dashes, series in zip(SERIES_DASHES, panel.lines.values(), strict=False):
        for member, points in series.items():
            style: dict[str, Any] = {"linewidth": 1.1, "markevery": max(1, len(points) // 6), **looks[member]}
            style["marker"] = style["marker"] or ("." if len(points) == 1 else "")
            axes.plot(*zip(*points, strict=True), linestyle=dashes, clip_on=False, **style)
    dashed = zip(SERIES_DASHES, panel.lines, strict=False)
    keys = [Line2D([], [], color=GREY, linestyle=dashes, linewidth=1.1, label=name) for dashes, name in dashed]
    axes.legend(handles=keys, fontsize=6, framealpha=0.7, edgecolor="none", handlelength=2.4)
    axes.set_ylabel(panel.unit)
    axes.set_xlim(left=0)
    if min(panel.values) >= 0:
        axes.set_ylim(0, 1.03 if panel.unit == SHARE else 1.06 * max(panel.values) or 1.0)
    axes.grid(alpha=0.25, linewidth=0.5)
