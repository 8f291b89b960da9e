"""A run's own figures: learning curves and environment steps by number of members, from its metrics and ledger."""

from __future__ import annotations

import json
from itertools import accumulate
from pathlib import Path

from popgen.reports.plots import learning_curves, steps_by_members


def training_curves(metrics: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Real self-play and strongest cross-play over each member's own steps: name -> (steps, scores).

    Steps only grow: of points that a resumed run gave again, the last ones count.
    """
    curves: dict[str, tuple[list[float], list[float]]] = {}
    names = {"real_sp": "SP", "real_xp_max": "strongest XP", "real_xp": "strongest XP"}
    for line in metrics.read_text().splitlines():
        row = json.loads(line)
        for field, label in names.items():
            if row.get(field) is not None:
                steps, scores = curves.setdefault(f"member {row['member']}, {label}", ([], []))
                while steps and steps[-1] >= row["step"]:
                    steps.pop()
                    scores.pop()
                steps.append(row["step"])
                scores.append(row[field])
    return curves


def write_run_figures(run_dir: Path, folder: Path, steps: list[int], *, unit: str, title: str) -> dict[str, Path]:
    """Draw both figures as PNG and SVG.

    Args:
        run_dir: holds metrics.jsonl.
        folder: where the figures go; must exist.
        steps: environment steps that each member's training took, in order.
        unit: of the scores, such as dishes.
        title: of both figures.

    Returns:
        Paths by name.
    """
    curves = training_curves(run_dir / "metrics.jsonl")
    first = {name: curve for name, curve in curves.items() if name.startswith("member 1,")}
    later = {name: curve for name, curve in curves.items() if name not in first}
    paths: dict[str, Path] = {}

    def two(name: str) -> list[Path]:
        paths.update({f"{name}.{suffix}": folder / f"{name}.{suffix}" for suffix in ("png", "svg")})
        return [paths[f"{name}.png"], paths[f"{name}.svg"]]

    # Member 1 takes an order of magnitude more steps than the others: one axis would hide them.
    for name, part in (("learning_first", first), ("learning_later", later)):
        if part:
            learning_curves(part, two(name), unit=f"{unit} per episode", title=title)
    steps_by_members({"this run": list(accumulate(steps))}, two("steps_by_members"), title=title)
    return paths
