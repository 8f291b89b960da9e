"""SP and XP of a sweep's settings with their intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.lines import Line2D

from popgen.reports.charts.chart_style import GREY, PAGE, add_legend, add_panels, styled_figure
from popgen.reports.method_titles import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

APART = 0.13
"""Of SP and XP from the middle of their line, which overlapping intervals would hide."""

LOOKS: dict[str, dict[str, Any]] = {
    "sp": {"marker": "o", "markersize": 5},
    "xp": {"marker": "o", "markersize": 5, "markerfacecolor": "white"},
}


def draw_sweep(groups: Sequence[Mapping[str, Any]], paths: Sequence[Path]) -> None:
    """A panel for each environment, a line for each setting: SP filled, XP hollow, bars for the intervals."""
    names = list(dict.fromkeys(group["environment"] for group in groups))
    most = max((sum(group["environment"] == name for group in groups) for name in names), default=1)
    columns = min(2, max(1, len(names)))
    rows = -(-max(1, len(names)) // columns)
    with styled_figure(paths, PAGE, rows * (0.9 + 0.24 * most) + 0.3) as figure:
        for axes, name in zip(add_panels(figure, len(names), columns), names, strict=True):
            own = [group for group in groups if group["environment"] == name]
            _draw_groups(axes, own)
            axes.set_title(name)
            axes.set_xlabel(f"{own[0]['unit']} an episode")
        handles = [
            Line2D([], [], color=GREY, label=f"{which.upper()}, mean and 95 % interval over seeds", **LOOKS[which])
            for which in LOOKS
        ]
        add_legend(figure, handles)


def _draw_groups(axes: Axes, groups: Sequence[Mapping[str, Any]]) -> None:
    for height, group in enumerate(groups):
        colour = METHODS[group["method"]].colour if group["method"] in METHODS else GREY
        for (which, look), shift in zip(LOOKS.items(), (-APART, APART), strict=True):
            spread, place = group[which], height + shift
            if spread["mean"] is None:
                continue
            if spread["low"] is not None:
                axes.plot([spread["low"], spread["high"]], [place, place], color=colour, linewidth=1.2)
            axes.plot([spread["mean"]], [place], color=colour, linestyle="none", zorder=3, **look)
    axes.set_yticks(range(len(groups)), [str(group["label"]) for group in groups])
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.25, linewidth=0.5)
