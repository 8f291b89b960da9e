"""A comparison as charts."""

from __future__ import annotations

from pathlib import Path

from popgen.reports import paper_figures as paper
from popgen.reports.charts.chart_style import Pictures
from popgen.reports.charts.scaling_charts import KindPanel, Line, Panel, bands_by_members, kinds_by_members
from popgen.reports.comparison import Group, quality_band, step_band, time_band
from popgen.reports.comparison_report.comparison_contents import Comparison
from popgen.reports.frames import seeds_text
from popgen.reports.run_record import REAL
from popgen.types import Kind

EXTRAPOLATED = "extrapolated"


def draw_comparison(comparison: Comparison, folder: Path) -> dict[str, Path]:
    """steps, steps_by_kind, time and quality as PNG and SVG; gives the paths by name."""
    pictures = Pictures(folder)
    bands_by_members(_step_panels(comparison), pictures.add("steps"), hollow=EXTRAPOLATED)
    alone = short_name(comparison.environments[0]) if len(comparison.environments) == 1 else ""
    kinds_by_members(_kind_panels(comparison), pictures.add("steps_by_kind"), title=alone)
    times = _time_panels(comparison)
    if any(len(line.band.agents) for panel in times for line in panel.lines):
        bands_by_members(times, pictures.add("time"), hollow=EXTRAPOLATED)
    good = _quality_panels(comparison)
    if any(panel.lines for panel in good):
        bands_by_members(good, pictures.add("quality"), hollow="lower bound", bounds=True)
    return pictures.files


def short_name(environment: str) -> str:
    """As the paper calls it, else the variant alone."""
    return paper.LAYOUT_NAMES.get(environment, environment.rpartition("/")[2])


def _groups_on(comparison: Comparison, environment: str) -> list[Group]:
    return [group for group in comparison.groups if group.environment == environment]


def _name_with_seeds(group: Group) -> str:
    return f"{group.name}, {seeds_text([run.seed for run in group.runs])}"


def _step_panels(comparison: Comparison) -> list[Panel]:
    """Real steps on each environment, then simulated ones where there are any, on an axis of their own."""
    panels, simulated = [], []
    for name in comparison.environments:
        groups = _groups_on(comparison, name)
        lines = [Line(g.label, _name_with_seeds(g), step_band(g, comparison.agents)) for g in groups]
        panels.append(Panel(short_name(name), "real environment steps", lines))
        bands = [(g, step_band(g, comparison.agents, str(Kind.SIMULATED))) for g in groups]
        others = [Line(g.label, _name_with_seeds(g), band) for g, band in bands if band.mean.any()]
        simulated += [Panel(short_name(name), "simulated steps", others)] if others else []
    return panels + simulated


def _time_panels(comparison: Comparison) -> list[Panel]:
    panels = []
    for name in comparison.environments:
        groups = _groups_on(comparison, name)
        lines = [Line(g.label, _name_with_seeds(g), time_band(g, comparison.agents)) for g in groups]
        panels.append(Panel(short_name(name), "minutes of training", lines, scale=60.0))
    return panels


def _quality_panels(comparison: Comparison) -> list[Panel]:
    panels = []
    for name, limits in comparison.thresholds.items():
        groups = [g for g in _groups_on(comparison, name) if all(str(run.path) in comparison.held for run in g.runs)]
        lines = [Line(g.label, _name_with_seeds(g), quality_band(g, limits, comparison.held)) for g in groups]
        title = f"{short_name(name)}: SP ≥ {limits.sp:g}, XP ≤ {limits.xp:g}"
        panels.append(Panel(title, "real steps taken when agent M had passed", lines))
    return panels


def _kind_panels(comparison: Comparison) -> list[KindPanel]:
    panels = []
    for group in comparison.groups:
        title = _name_with_seeds(group)
        if len(comparison.environments) > 1:
            title += f"\n{short_name(group.environment)}"
        kinds = {str(kind): step_band(group, comparison.agents, str(kind)) for kind in REAL}
        panels.append(KindPanel(title, kinds, step_band(group, comparison.agents, str(Kind.SIMULATED))))
    return panels
