"""The paper's ablation "Effect of World Model as a Dynamics Model": XPM-Sim with and without a shared encoder.

Self-play of members 2..M in training, averaged, against the steps that each was trained on in the exact simulator. If
a shared encoder explained what a world model saves, the curve with it would rise faster.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from popgen.errors import UserError
from popgen.reports.plots import COLOURS, COLUMN, _figure, _thousands
from popgen.reports.run_record import RunRecord, differences

FORMAT, VERSION = "popgen-shared-encoder", 1
NAMES = {"none": "separate agents", "shared": "shared encoder"}
"""Value of `xpm_sim.encoder` -> name on the chart."""

_OWN = ("xpm_sim.encoder", "xpm_sim.latent")
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
        if record.method != "xpm_sim":
            raise UserError(str(record.path), f"is of {record.method}", "give runs of xpm_sim")
        if len(record.members) < 2:
            raise UserError(str(record.path), "has no later members", "train at least two")
        if record.environment.fingerprint != records[0].environment.fingerprint:
            raise UserError(str(record.path), "is of another environment than the first run", "give runs of one")
        if other := [name for name in differences(records[0], record) if not name.startswith(_OWN)]:
            raise UserError(str(record.path), f"differs from the first run in {other[0]}", "give runs alike")
    if missing := sorted(set(NAMES) - {kind_of(record) for record in records}):
        raise UserError("runs", f"none has xpm_sim.encoder={missing[0]}", "give one of each kind")


def kind_of(record: RunRecord) -> str:
    """`none` or `shared`."""
    return str(record.settings.get("xpm_sim.encoder", "none"))


def build_report(records: Sequence[RunRecord]) -> dict[str, Any]:
    """Curves of both kinds; JSON-able. Keys: format, version, environment, unit, curves, runs."""
    check_comparable(records)
    groups = {kind: [record for record in records if kind_of(record) == kind] for kind in NAMES}
    finals = {kind: _final(found) for kind, found in groups.items()}
    curves = [_curve(kind, found, finals[kind], max(finals.values())) for kind, found in groups.items()]
    return {
        "format": FORMAT,
        "version": VERSION,
        "environment": records[0].environment.name,
        "unit": records[0].environment.score_name,
        "curves": [asdict(curve) for curve in curves],
        "runs": [str(record.path) for record in records],
    }


def _curve(kind: str, records: Sequence[RunRecord], final: float, best: float) -> Curve:
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


def _final(records: Sequence[RunRecord]) -> float:
    """Mean self-play of the later members in the evaluations of their runs."""
    scores = []
    for record in records:
        table = record.scores["matrix"]["mean"]
        scores += [table[row][row] for row in range(1, len(record.members))]
    return float(np.mean(scores))


def to_csv(report: Mapping[str, Any]) -> str:
    """A row per curve and grid point: curve, simulated_steps, mean, deviation."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(["curve", "simulated_steps", "mean", "deviation"])
    for curve in report["curves"]:
        rows = zip(curve["steps"], curve["mean"], curve["deviation"], strict=True)
        writer.writerows([curve["name"], round(step), mean, spread] for step, mean, spread in rows)
    return out.getvalue()


def summary(report: Mapping[str, Any]) -> list[str]:
    """A line for each curve."""
    lines = []
    for curve in report["curves"]:
        told = [f"{share} at {_thousands(at) if at is not None else 'never'}" for share, at in curve["reached"].items()]
        lines.append(
            f"{curve['name']}: final SP {curve['final']:.2f} {report['unit']} ({curve['members']} later members, seeds "
            f"{', '.join(map(str, curve['seeds']))}); of the better final SP: {', '.join(told)} simulated steps"
        )
    return lines


def write_report(report: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """JSON, CSV and the figure as PNG and SVG; paths by name."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {name: folder / name for name in ("shared_encoder.json", "shared_encoder.csv")}
    files["shared_encoder.json"].write_text(json.dumps(report, indent=1), encoding="utf-8")
    files["shared_encoder.csv"].write_text(to_csv(report), encoding="utf-8")
    figures = {name: folder / name for name in ("shared_encoder.png", "shared_encoder.svg")}
    draw(report, list(figures.values()))
    return files | figures


def draw(report: Mapping[str, Any], paths: Sequence[str | Path]) -> None:
    """Both mean curves with bands of one standard deviation over members and seeds."""
    with _figure(paths, COLUMN, 2.4) as figure:
        axes = figure.add_subplot()
        for curve, colour, style in zip(report["curves"], COLOURS, ("-", "--"), strict=False):
            steps, mean, spread = (np.array(curve[name]) for name in ("steps", "mean", "deviation"))
            axes.fill_between(steps, mean - spread, mean + spread, color=colour, alpha=0.2, linewidth=0)
            axes.plot(steps, mean, style, color=colour, label=curve["name"], linewidth=1.4)
        axes.set_xlabel("simulated steps of a member")
        axes.set_ylabel(f"self-play {report['unit']} in training")
        axes.set_title(f"{report['environment']}, members 2 and later")
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(_thousands)
        axes.grid(alpha=0.25, linewidth=0.5)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
