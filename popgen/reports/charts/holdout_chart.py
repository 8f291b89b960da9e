"""Egos beside hold-out partners as a chart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.patches import Patch

from popgen.reports.charts.chart_style import COLOURS, PAGE, add_legend, styled_figure
from popgen.reports.method_titles import title_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist


def draw_standings(report: Mapping[str, Any], paths: Sequence[str | Path]) -> None:
    """Mean score with its interval for each ego (colour) beside each set of partners; a dash marks the worst pair.

    Args:
        report: of `popgen.reports.holdout_report`.
        paths: files to write.
    """
    egos = [one["label"] for one in report["egos"]]
    sets = list(dict.fromkeys(one["partners"] for one in report["standings"]))
    width = 0.8 / len(egos)
    with styled_figure(paths, PAGE, 2.8) as figure:
        axes = figure.add_subplot()
        handles: list[Artist] = []
        for number, ego in enumerate(egos):
            rows = {one["partners"]: one for one in report["standings"] if one["ego"] == ego}
            places = np.array([n for n, name in enumerate(sets) if name in rows]) + (number + 0.5) * width - 0.4
            chosen = [rows[name] for name in sets if name in rows]
            means = np.array([one["mean"] for one in chosen])
            reach = np.array([[one["interval"][end] for one in chosen] for end in ("low", "high")], float)
            colour = COLOURS[number % len(COLOURS)]
            axes.bar(places, means, width, color=colour)
            axes.errorbar(places, means, np.abs(reach - means), fmt="none", ecolor="black", elinewidth=0.8, capsize=2)
            worst = [one["worst"]["score"] for one in chosen]
            axes.scatter(places, worst, marker="_", color="black", s=30, zorder=3)
            handles.append(Patch(color=colour, label=ego))
        axes.set_xticks(range(len(sets)), [title_of(name) for name in sets], rotation=20, ha="right")
        axes.set_ylabel(f"{report['unit']} per episode")
        axes.set_title(f"{report['environment']['name']}: egos beside hold-outs (bars: 95 %; dash: worst pair)")
        axes.grid(axis="y", alpha=0.25, linewidth=0.5)
        axes.set_axisbelow(True)
        add_legend(figure, handles)
