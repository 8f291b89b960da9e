"""A comparison as charts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from popgen.reports import paper_figures as paper
from popgen.reports.comparison import Group, Thresholds, quality_band, step_band, time_band
from popgen.reports.comparison_report.contents import Comparison
from popgen.reports.plots import Line, bands_by_members, kinds_by_members
from popgen.reports.run_record import REAL
from popgen.types import Kind

EXTRAPOLATED = "extrapolated"


def draw(comparison: Comparison, folder: Path) -> dict[str, Path]:
    """steps, steps_by_kind, time and quality as PNG and SVG; gives the paths by name."""
    found: dict[str, Path] = {}

    def two(name: str) -> list[Path]:
        paths = {f"{name}.{suffix}": folder / f"{name}.{suffix}" for suffix in ("png", "svg")}
        found.update(paths)
        return [*paths.values()]

    steps = {short_name(name): _step_lines(comparison, name) for name in comparison.environments}
    bands_by_members(
        *(steps, two("steps")),
        axis="real environment steps",
        hollow=EXTRAPOLATED,
        dotted="simulated steps",
    )
    alone = short_name(comparison.environments[0]) if len(comparison.environments) == 1 else ""
    kinds_by_members(_kind_panels(comparison), two("steps_by_kind"), title=alone)
    times = {short_name(name): _time_lines(comparison, name) for name in comparison.environments}
    if any(len(line.band.agents) for lines in times.values() for line in lines):
        bands_by_members(times, two("time"), axis="minutes of training", hollow=EXTRAPOLATED, scale=60.0)
    good = {_limits(name, limit): _quality_lines(comparison, name) for name, limit in comparison.thresholds.items()}
    if any(good.values()):
        bands_by_members(good, two("quality"), axis="real steps to equal quality", hollow="lower bound", bounds=True)
    return found


def _limits(name: str, limit: Thresholds) -> str:
    return f"{short_name(name)}: SP ≥ {limit.sp:g}, XP ≤ {limit.xp:g}"


def short_name(environment: str) -> str:
    """As the paper calls it, else the variant alone."""
    return paper.LAYOUT_NAMES.get(environment, environment.rpartition("/")[2])


def _of(comparison: Comparison, name: str) -> list[Group]:
    return [group for group in comparison.groups if group.environment == name]


def _step_lines(comparison: Comparison, name: str) -> list[Line]:
    lines = [Line(g.label, g.name, step_band(g, comparison.agents)) for g in _of(comparison, name)]
    simulated = [
        Line(g.label, g.name, band, dotted=True)
        for g in _of(comparison, name)
        if (band := step_band(g, comparison.agents, str(Kind.SIMULATED))).mean.any()
    ]
    return lines + simulated


def _time_lines(comparison: Comparison, name: str) -> list[Line]:
    return [Line(g.label, g.name, time_band(g, comparison.agents)) for g in _of(comparison, name)]


def _quality_lines(comparison: Comparison, name: str) -> list[Line]:
    limits = comparison.thresholds[name]
    groups = [g for g in _of(comparison, name) if any(m.curve for run in g.runs for m in run.members)]
    return [Line(g.label, g.name, quality_band(g, limits)) for g in groups]


def _kind_panels(comparison: Comparison) -> dict[str, Any]:
    panels = {}
    for group in comparison.groups:
        title = group.name
        if len(comparison.environments) > 1:
            title += f"\n{short_name(group.environment)}"
        kinds = {str(kind): step_band(group, comparison.agents, str(kind)) for kind in REAL}
        panels[title] = (kinds, step_band(group, comparison.agents, str(Kind.SIMULATED)))
    return panels
