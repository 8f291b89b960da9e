"""A run's own figures: learning curves and environment steps by number of members, from its metrics and ledger."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path

from popgen.reports.charts.chart_style import Pictures
from popgen.reports.charts.curve_charts import learning_curves, score_limits, steps_by_members
from popgen.reports.training_curves import read_curves


def write_run_figures(run_dir: Path, folder: Path, steps: list[int], *, unit: str, title: str) -> dict[str, Path]:
    """Draw learning curves and steps by members as PNG and SVG.

    Args:
        run_dir: holds metrics.jsonl.
        folder: where the figures go; must exist.
        steps: real environment steps that each member's training took, in order.
        unit: of the scores, such as dishes.
        title: of all figures: environment, method and seed.

    Returns:
        Paths by name.
    """
    curves = read_curves(run_dir / "metrics.jsonl")
    # Member 1 takes an order of magnitude more steps than the others: one axis would hide them.
    parts = {
        "learning_first": {member: points for member, points in curves.items() if member == 1},
        "learning_later": {member: points for member, points in sorted(curves.items()) if member > 1},
    }
    pictures, limits = Pictures(folder), score_limits(curves)
    for name, part in parts.items():
        if part:
            learning_curves(part, pictures.add(name), unit=f"{unit} per episode", title=title, limits=limits)
    steps_by_members(list(accumulate(steps)), pictures.add("steps_by_members"), title=title)
    return pictures.files
