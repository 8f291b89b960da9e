"""Charts and the coloured matrix of a report, as text that stands in its page."""

from __future__ import annotations

import base64
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

from popgen.pages.report_source import ReportSource
from popgen.reports.charts.curve_charts import learning_curves, score_limits, series_chart
from popgen.reports.charts.scaling_charts import KindPanel, kinds_by_members
from popgen.reports.comparison import Group, step_band
from popgen.reports.frames import number_text
from popgen.reports.method_titles import title_of
from popgen.reports.run_record import REAL, RunRecord
from popgen.reports.training_series import IMAGINED, WORLD_MODEL, SeriesPanel, read_panels
from popgen.types import Kind


@dataclass(frozen=True)
class Chart:
    """A picture in a page.

    Attributes:
        url: a `data:` URL.
        caption: what it shows, in a sentence; also for those who do not see it.
    """

    url: str
    caption: str


def draw_chart(draw: Callable[[Sequence[Path]], None], caption: str) -> Chart:
    """Have `draw` write one SVG file, and take it in."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chart.svg"
        draw([path])
        held = base64.b64encode(path.read_bytes()).decode()
    return Chart(f"data:image/svg+xml;base64,{held}", caption)


def title_run(run: RunRecord) -> str:
    """Environment, method and seed."""
    return f"{run.environment.name}, {title_of(run.method)}, seed {run.seed}"


def draw_curves(run: RunRecord) -> list[Chart]:
    """Real self-play and strongest cross-play in training: the first member's, and the later ones' with their scale."""
    curves = {member.member: member.curve for member in run.members if member.curve}
    limits, unit = score_limits(curves), f"{run.environment.score_name} per episode"
    parts = [("of member 1", [m for m in curves if m == 1]), ("of the later members", [m for m in curves if m > 1])]
    return [
        draw_chart(
            lambda paths, some=some: learning_curves(
                {m: curves[m] for m in some}, paths, unit=unit, title=title_run(run), limits=limits
            ),
            f"Real play {who} in training: self-play and cross-play with the strongest partner.",
        )
        for who, some in parts
        if some
    ]


def draw_steps(run: RunRecord) -> list[Chart]:
    """Environment steps by kind against the number of agents."""
    size = len(run.members)
    if not any(member.real for member in run.members):
        return []
    group = Group(run.label, run.method, run.environment.name, (run,))
    kinds = {str(kind): step_band(group, size, str(kind)) for kind in REAL}
    panel = KindPanel(title_run(run), kinds, step_band(group, size, str(Kind.SIMULATED)))
    return [
        draw_chart(
            lambda paths: kinds_by_members([panel], paths),
            "Environment steps by kind after 1, 2, ... members; simulated steps have an axis of their own.",
        )
    ]


def draw_diagnostics(source: ReportSource) -> dict[str, list[Chart]]:
    """`world_model` and `imagined` (beside real return); empty where the run has no such figures."""
    wanted = {"world_model": WORLD_MODEL, "imagined": IMAGINED}
    if source.folder is None:
        return {name: [] for name in wanted}
    title, found = title_run(source.run), {}
    for name, panels in wanted.items():
        read = read_panels(source.folder / "metrics.jsonl", panels)
        limits = _share_limits(read) if name == "imagined" else None
        found[name] = [
            draw_chart(
                lambda paths, panel=panel, limits=limits: series_chart(panel, paths, title=title, limits=limits),
                f"{panel.title[0].upper()}{panel.title[1:]}, over the time of the run.",
            )
            for panel in read
        ]
    return found


def _share_limits(panels: Sequence[SeriesPanel]) -> tuple[float, float] | None:
    """One vertical scale for all of them."""
    values = [value for panel in panels for value in panel.values]
    if not values:
        return None
    low, high = min(0.0, *values), max(0.0, *values)
    margin = 0.06 * (high - low) or 1.0
    return (low - margin if low < 0 else 0.0), high + margin


@dataclass(frozen=True)
class Cell:
    """A figure of the matrix with its colours."""

    text: str
    error: str
    ground: str
    ink: str


def colour_matrix(scores: dict[str, Any]) -> list[tuple[str, list[Cell]]]:
    """Rows of the SP/XP matrix, members and then the random and the idle partner, with the label of seat 0."""
    by_seats = {(pair["seat_0"], pair["seat_1"]): pair["score"] for pair in scores["pairs"]}
    labels = [*map(str, scores["members"]), "random", "idle"]
    means = [figure["mean"] for figure in by_seats.values() if figure["mean"] is not None]
    low, high = min(0.0, *means), max(means)
    return [
        (row, [_colour_cell(by_seats.get((row, column)), low, high) for column in labels])
        for row in labels
        if any((row, column) in by_seats for column in labels)
    ]


def _colour_cell(figure: dict[str, float | None] | None, low: float, high: float) -> Cell:
    mean = None if figure is None else figure["mean"]
    if mean is None or figure is None:
        return Cell("", "", "transparent", "inherit")
    place = (mean - low) / (high - low) if high > low else 0.0
    red, green, blue, _ = matplotlib.colormaps["cividis"](place)
    ground = f"rgb({red * 255:.0f} {green * 255:.0f} {blue * 255:.0f})"
    ink = "#000000" if _luminance(red, green, blue) > 0.18 else "#ffffff"
    error = figure["standard_error"]
    digits = 1 if abs(mean) >= 10 else 2
    return Cell(number_text(mean, digits), "" if error is None else f"± {error:.2f}", ground, ink)


def _luminance(*channels: float) -> float:
    """Relative luminance of sRGB channels in [0, 1] (WCAG 2)."""
    linear = [c / 12.92 if c <= 0.04045 else math.pow((c + 0.055) / 1.055, 2.4) for c in channels]
    return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
