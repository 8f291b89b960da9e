"""The paper's ablation "Effect of World Model as a Dynamics Model": XPM-Sim with and without a shared encoder.

Self-play of members 2..M in training, averaged, against the steps that each was trained on in the exact simulator. If
a shared encoder explained what a world model saves, the curve with it would rise faster.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D

from popgen.errors import UserError
from popgen.reports.charts.chart_style import (
    COLOURS,
    COLUMN,
    Pictures,
    add_legend,
    format_steps,
    legend_height,
    styled_figure,
)
from popgen.reports.frames import seeds_text, steps_text, to_csv
from popgen.reports.method_titles import name_of
from popgen.reports.paper_figures import SIMULATOR_METHOD
from popgen.reports.run_record import RunRecord, differences

if TYPE_CHECKING:
    from matplotlib.artist import Artist

FORMAT, VERSION = "popgen-shared-encoder", 1
NAMES = {"none": "separate agents", "shared": "shared encoder"}
"""Value of the encoder setting -> name on the chart."""

METHOD = name_of(SIMULATOR_METHOD)
ENCODER = f"{METHOD}.encoder"
_OWN = (ENCODER, f"{METHOD}.latent")
_GRID = 41


@dataclass(frozen=True)
class Curve:
    """Real self-play of later members in training, over all runs of one kind.

    steps (N,) simulated steps of the member so far; mean and deviation (N,) over members and seeds of its score;
    final: mean of the finished members in the runs' evaluations; members, seeds: how many.
    reached: for each share of the better final score, the simulated steps at which the mean curve passes it, or None.
    """

    name: str
    steps: tuple[float, ...]
    mean: tuple[float, ...]
    deviation: tuple[float, ...]
    final: float
    members: int
    seeds: tuple[int, ...]
    reached: Mapping[str, float | None]


def check_comparable(records: Sequence[RunRecord]) -> None:
    """Both kinds must be there, alike but for the encoder and the seed.

    Raises:
        UserError: another method, fewer than two members, other settings or environments, or only one kind.
    """
    for record in records:
        if record.method != METHOD:
            raise UserError(str(record.path), f"is of {record.method}", f"give runs of {METHOD}")
        if len(record.members) < 2:
            raise UserError(str(record.path), "has no later members", "train at least two")
        if record.environment.fingerprint != records[0].environment.fingerprint:
            raise UserError(str(record.path), "is of another environment than the first run", "give runs of one")
        if other := [name for name in differences(records[0], record) if not name.startswith(_OWN)]:
            raise UserError(str(record.path), f"differs from the first run in {other[0]}", "give runs alike")
    if missing := sorted(set(NAMES) - {kind_of(record) for record in records}):
        raise UserError("runs", f"none has {ENCODER}={missing[0]}", "give one of each kind")


def kind_of(record: RunRecord) -> str:
    """`none` or `shared`."""
    return str(record.settings.get(ENCODER, "none"))


def build_report(records: Sequence[RunRecord]) -> dict[str, Any]:
    """Curves of both kinds; JSON-able. Keys: format, version, environment, unit, curves, runs."""
    check_comparable(records)
    groups = {kind: [record for record in records if kind_of(record) == kind] for kind in NAMES}
    finals = {kind: _final_score(found) for kind, found in groups.items()}
    curves = [_average_curve(kind, found, finals[kind], max(finals.values())) for kind, found in groups.items()]
    return {
        "format": FORMAT,
        "version": VERSION,
        "environment": records[0].environment.name,
        "unit": records[0].environment.score_name,
        "curves": [asdict(curve) for curve in curves],
        "runs": [str(record.path) for record in records],
    }


def _average_curve(kind: str, records: Sequence[RunRecord], final: float, best: float) -> Curve:
    members = [member for record in records for member in record.members[1:]]
    found = [[(p.simulated, p.sp) for p in member.curve] for member in members]
    if any(len(points) < 2 for points in found):
        raise UserError(str(records[0].path), "kept no learning curves", "restore its metrics.jsonl")
    steps = np.linspace(0.0, min(points[-1][0] for points in found), _GRID)
    scores = np.array([np.interp(steps, *np.array(points, float).T) for points in found])
    mean = scores.mean(0)
    reached = {}
    for share in (0.5, 0.8, 0.9):
        above = np.flatnonzero(mean >= share * best)
        reached[f"{share:.0%}"] = float(steps[above[0]]) if len(above) else None
    spread = tuple(scores.std(0).tolist())
    seeds = tuple(sorted(record.seed for record in records))
    return Curve(NAMES[kind], tuple(steps.tolist()), tuple(mean.tolist()), spread, final, len(members), seeds, reached)


def _final_score(records: Sequence[RunRecord]) -> float:
    """Mean self-play of the later members in the evaluations of their runs."""
    scores = []
    for record in records:
        table = record.scores["matrix"]["mean"]
        scores += [table[row][row] for row in range(1, len(record.members))]
    return float(np.mean(scores))


def curves_csv(report: Mapping[str, Any]) -> str:
    """A row per curve and grid point: curve, simulated_steps, mean, deviation."""
    columns: tuple[str, ...] = ("curve", "simulated_steps", "mean", "deviation")
    rows: list[dict[str, Any]] = [
        dict(zip(columns, (curve["name"], round(step), mean, spread), strict=True))
        for curve in report["curves"]
        for step, mean, spread in zip(curve["steps"], curve["mean"], curve["deviation"], strict=True)
    ]
    return to_csv(rows, columns)


def summary(report: Mapping[str, Any]) -> list[str]:
    """A line for each curve."""
    lines = []
    for curve in report["curves"]:
        reached = [
            f"{share} at {steps_text(at) if at is not None else 'never'}" for share, at in curve["reached"].items()
        ]
        lines.append(
            f"{curve['name']}: final SP {curve['final']:.2f} {report['unit']} ({curve['members']} later members, seeds "
            f"{', '.join(map(str, curve['seeds']))}); of the better final SP: {', '.join(reached)} simulated steps"
        )
    return lines


def write_report(report: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """JSON, CSV and the figure as PNG and SVG; paths by name."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: folder / name for name in ("shared_encoder.json", "shared_encoder.csv")}
    files["shared_encoder.json"].write_text(json.dumps(report, indent=1), encoding="utf-8")
    files["shared_encoder.csv"].write_text(curves_csv(report), encoding="utf-8")
    pictures = Pictures(folder)
    draw_curves(report, pictures.add("shared_encoder"))
    return files | pictures.files


def draw_curves(report: Mapping[str, Any], paths: Sequence[str | Path]) -> None:
    """Both mean curves with bands of one standard deviation over members and seeds."""
    handles: list[Artist] = [
        Line2D([], [], color=colour, linestyle=style, label=curve["name"], linewidth=1.4)
        for curve, colour, style in zip(report["curves"], COLOURS, ("-", "--"), strict=False)
    ]
    seeds = sorted({seed for curve in report["curves"] for seed in curve["seeds"]})
    with styled_figure(paths, COLUMN, 2.2 + legend_height(handles, COLUMN)) as figure:
        axes = figure.add_subplot()
        for curve, colour, style in zip(report["curves"], COLOURS, ("-", "--"), strict=False):
            steps, mean, spread = (np.array(curve[name]) for name in ("steps", "mean", "deviation"))
            axes.fill_between(steps, mean - spread, mean + spread, color=colour, alpha=0.2, linewidth=0)
            axes.plot(steps, mean, style, color=colour, linewidth=1.4, clip_on=False)
        axes.set_xlabel("simulated steps of a member")
        axes.set_ylabel(f"self-play {report['unit']} in training")
        axes.set_title(f"{report['environment']}, {SIMULATOR_METHOD}, {seeds_text(seeds)}\nmembers 2 and later")
        axes.set_xlim(left=0)
        format_steps(axes, "x")
        add_legend(figure, handles)
