"""Charts of reproduced targets: bars with intervals, learning curves, growth with the number of agents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D

from popgen.reports.charts.chart_style import (
    COLOURS,
    PAGE,
    add_legend,
    add_panels,
    format_steps,
    legend_height,
    styled_figure,
)
from popgen.reports.reproduction.run_tables import TableRow, find_figure, list_environments, summarise_runs
from popgen.reports.reproduction.target_records import Record, Target

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

_POINTS = 41
_DASHES = ("-", "--", ":", "-.")
_AXES = {
    "costs.by_members": "real steps",
    "costs.minutes_by_members": "minutes",
    "curves.later": "own steps of a later agent",
    "first.curve": "steps of agent 1",
    "curves.later_simulated": "simulated steps of a later agent",
}


def draw_target(record: Record, target: Target, paths: Sequence[str | Path]) -> None:
    """The target's chart; nothing to draw gives empty panels."""
    CHARTS[target.chart](record, target, paths)


def draw_bars(record: Record, target: Target, paths: Sequence[str | Path]) -> None:
    """A panel for each environment and charted column: bars of our rows with their intervals, the paper's beside."""
    rows, environments = summarise_runs(record, target.columns), list_environments(record)
    panels = [(name, title) for name in environments for title in target.charted]
    most = max((sum(row.environment == name for row in rows) for name in environments), default=1)
    height = (0.5 + 0.17 * (most + len(target.paper(environments[0]) if environments else ()))) * len(environments)
    with styled_figure(paths, PAGE, max(1.6, height)) as figure:
        for axes, (name, title) in zip(add_panels(figure, len(panels), len(target.charted)), panels, strict=True):
            _draw_bar_panel(axes, [row for row in rows if row.environment == name], target, name, title)


def _draw_bar_panel(axes: Axes, rows: Sequence[TableRow], target: Target, environment: str, title: str) -> None:
    """Horizontal bars, the first row on top; the panels of an environment share the names at their left."""
    lines = [line for line in target.paper(environment) if not set(target.charted).isdisjoint(line.cells)]
    labels = [*(row.label for row in rows), *(f"{line.label} (paper)" for line in lines)]
    for place, row in enumerate(rows):
        cell = row.cells[title]
        if cell is not None:
            axes.barh(place, cell.mean, color=COLOURS[0], height=0.7)
            axes.plot([cell.low, cell.high], [place, place], color="black", linewidth=1.0)
    for place, line in enumerate(lines, start=len(rows)):
        if title in line.cells:
            axes.barh(place, line.cells[title], color="none", edgecolor="black", height=0.7, linewidth=0.8)
    axes.set_yticks(range(len(labels)), labels if title == target.charted[0] else [""] * len(labels))
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.set_title(f"{environment.partition('/')[2]}: {title}")
    axes.grid(alpha=0.25, linewidth=0.5, axis="x")


def draw_members(record: Record, target: Target, paths: Sequence[str | Path]) -> None:
    """Cumulative figures against the number of agents: mean and range over seeds."""
    figure_name = target.charted[0]

    def curve(run: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        values = np.array(find_figure(run, figure_name) or [], float)
        return np.arange(1, len(values) + 1), values

    _draw_panels(record, paths, curve, "agents", _AXES[figure_name], "y")


def draw_lines(record: Record, target: Target, paths: Sequence[str | Path]) -> None:
    """Self-play in training against steps: mean and range over seeds."""
    figure_name = target.charted[0]

    def curve(run: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        points = np.array(find_figure(run, figure_name) or np.zeros((0, 2)), float)
        return points[:, 0], points[:, 1]

    _draw_panels(record, paths, curve, _AXES[figure_name], "self-play score", "x")


def _draw_panels(
    record: Record,
    paths: Sequence[str | Path],
    curve: Callable[[Mapping[str, Any]], tuple[np.ndarray, np.ndarray]],
    across: str,
    up: str,
    steps: str,
) -> None:
    """A panel for each environment, a line for each row."""
    environments = list_environments(record)
    labels = list(dict.fromkeys(run["row"] for run in record["runs"]))
    handles: list[Artist] = [
        Line2D([], [], label=label, color=COLOURS[n % len(COLOURS)], linestyle=_DASHES[n % len(_DASHES)])
        for n, label in enumerate(labels)
    ]
    columns = min(2, max(1, len(environments)))
    height = 2.2 * -(-len(environments) // columns) + legend_height(handles, PAGE)
    with styled_figure(paths, PAGE, max(2.2, height)) as figure:
        for axes, name in zip(add_panels(figure, len(environments), columns), environments, strict=True):
            for n, label in enumerate(labels):
                runs = [run for run in record["runs"] if (run["environment"], run["row"]) == (name, label)]
                _draw_band(axes, [curve(run) for run in runs], n)
            axes.set_title(name)
            axes.set_xlabel(across)
            axes.set_ylabel(up)
            format_steps(axes, steps)
        add_legend(figure, handles)


def _draw_band(axes: Axes, curves: Sequence[tuple[np.ndarray, np.ndarray]], number: int) -> None:
    """Mean of curves on what they have in common, and their range."""
    known = [(x, y) for x, y in curves if len(x)]
    if not known:
        return
    start, end = max(x[0] for x, _ in known), min(x[-1] for x, _ in known)
    grid = np.linspace(start, max(start, end), _POINTS)
    values = np.stack([np.interp(grid, x, y) for x, y in known])
    colour, dash = COLOURS[number % len(COLOURS)], _DASHES[number % len(_DASHES)]
    axes.fill_between(grid, values.min(0), values.max(0), color=colour, alpha=0.2, linewidth=0)
    axes.plot(grid, values.mean(0), dash, color=colour, linewidth=1.4)


CHARTS: dict[str, Callable[[Record, Target, Sequence[str | Path]], None]] = {
    "draw_bars": draw_bars,
    "draw_members": draw_members,
    "draw_lines": draw_lines,
}
"""Name -> chart, as targets name them."""
