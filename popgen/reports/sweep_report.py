"""What a sweep found: a row for each setting, with intervals over its seeds.

Keys of the JSON object (`sweep.json`); null stands for what is unknown:

    format, format_version   "popgen-sweep", 1
    varied                   the settings that the sweep varies, seeds aside
    runs                     one a run: id, path, method, environment, seed, settings (of `varied`), sp, xp, gap
                             (SP - XP), real_steps, simulated_steps, seconds, weak_members (a line for each that does
                             not play)
    groups                   one a setting: label, method, environment, unit, settings, seeds; sp, xp, gap (mean, low,
                             high); real_steps, simulated_steps, seconds (means)
    best                     environment -> label of the largest mean gap
    missing                  runs that did not finish: id and error

Intervals are of 95 % over seeds, by Student's t, which takes seeds as normal; null for one seed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from popgen.errors import UserError
from popgen.evaluation.estimates import measure_half_interval
from popgen.reports.charts.sweep_chart import draw_sweep
from popgen.reports.frames import Sheet, number_text, range_text, seeds_text, steps_text, to_csv
from popgen.reports.method_titles import title_of
from popgen.reports.run_record import RunRecord
from popgen.types import Kind

FIGURES = ("sp", "xp", "gap")
CSV_FIELDS = ("id", "method", "environment", "seed", *FIGURES, "real_steps", "simulated_steps", "seconds")
"""One row a run; the varied settings follow as further columns."""


@dataclass(frozen=True)
class SweptRun:
    """A finished run of a sweep, and the values of the settings that the sweep varies (seeds aside)."""

    record: RunRecord
    settings: Mapping[str, Any]


def build_report(runs: Sequence[SweptRun], varied: Sequence[str], missing: Mapping[str, str]) -> dict[str, Any]:
    """The JSON object of the module's docstring; `missing` holds the errors of runs that did not finish, by id."""
    rows = [_describe_run(run) for run in runs]
    keys = list(dict.fromkeys(_group_key(row) for row in rows))
    groups = [_average_group([row for row in rows if _group_key(row) == key], varied) for key in keys]
    units = {row.record.environment.name: str(row.record.scores["unit"]) for row in runs}
    for group in groups:
        group["unit"] = units[group["environment"]]
    return {
        "format": "popgen-sweep",
        "format_version": 1,
        "varied": list(varied),
        "runs": rows,
        "groups": groups,
        "best": _find_best(groups),
        "missing": [{"id": name, "error": error} for name, error in missing.items()],
    }


def _describe_run(run: SweptRun) -> dict[str, Any]:
    record, scores = run.record, run.record.scores
    sp, xp = (scores[name]["mean"] for name in ("sp", "xp"))
    times = [member.seconds for member in record.members]
    simulated = sum(member.steps.get(str(Kind.SIMULATED), 0) for member in record.members)
    return {
        "id": record.run_id,
        "path": str(record.path),
        "method": record.method,
        "environment": record.environment.name,
        "seed": record.seed,
        "settings": dict(run.settings),
        "sp": sp,
        "xp": xp,
        "gap": None if sp is None or xp is None else sp - xp,
        "real_steps": sum(member.real for member in record.members),
        "simulated_steps": simulated,
        "seconds": None if None in times else round(sum(time or 0.0 for time in times), 1),
        "weak_members": list(record.weak_members),
    }


def _group_key(row: Mapping[str, Any]) -> str:
    return json.dumps([row["method"], row["environment"], row["settings"]], sort_keys=True)


def _average_group(rows: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> dict[str, Any]:
    first = rows[0]
    told = [f"{name}={first['settings'][name]}" for name in varied if name in first["settings"]]
    return {
        "label": " ".join([title_of(first["method"]), *told]),
        "method": first["method"],
        "environment": first["environment"],
        "settings": first["settings"],
        "seeds": sorted(row["seed"] for row in rows),
        **{name: interval_of([row[name] for row in rows]) for name in FIGURES},
        **{name: _mean_of([row[name] for row in rows]) for name in ("real_steps", "simulated_steps", "seconds")},
    }


def interval_of(values: Sequence[float | None]) -> dict[str, float | None]:
    """Mean of what is known, with its 95 % interval where there are two values or more."""
    known = np.array([value for value in values if value is not None], np.float64)
    if len(known) < 2:
        return {"mean": _mean_of(values), "low": None, "high": None}
    mean, half = float(known.mean()), measure_half_interval(known)
    return {"mean": mean, "low": mean - half, "high": mean + half}


def _mean_of(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _find_best(groups: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    best: dict[str, Mapping[str, Any]] = {}
    for group in groups:
        name, gap = group["environment"], group["gap"]["mean"]
        if gap is not None and (name not in best or gap > best[name]["gap"]["mean"]):
            best[name] = group
    return {name: str(group["label"]) for name, group in best.items()}


def to_sheets(report: Mapping[str, Any]) -> list[Sheet]:
    """A table for each environment."""
    sheets = []
    for name in dict.fromkeys(group["environment"] for group in report["groups"]):
        groups = [group for group in report["groups"] if group["environment"] == name]
        simulated = any(group["simulated_steps"] for group in groups)
        rows = [
            {
                "": group["label"],
                "seeds": len(group["seeds"]),
                "SP": range_text(group["sp"]),
                "XP": range_text(group["xp"]),
                "SP - XP": range_text(group["gap"]),
                "steps": steps_text(group["real_steps"]),
                **({"simulated": steps_text(group["simulated_steps"])} if simulated else {}),
                "minutes": number_text(None if group["seconds"] is None else group["seconds"] / 60, 1),
            }
            for group in groups
        ]
        title = f"{name}, {groups[0]['unit']}: mean (95 % interval over seeds)"
        sheets.append(Sheet(title, pd.DataFrame(rows)))
    return sheets


def summary(report: Mapping[str, Any]) -> list[str]:
    """The best setting of each environment, who does not play, and what is missing."""
    lines = [f"{name}: the largest SP - XP is that of {label}" for name, label in report["best"].items()]
    seeds = sorted({run["seed"] for run in report["runs"]})
    lines += [f"{len(report['runs'])} runs, {seeds_text(seeds)}"] if seeds else []
    lines += [f"{run['id']}: {line}" for run in report["runs"] for line in run["weak_members"]]
    return lines + [f"missing: {run['id']} ({run['error']})" for run in report["missing"]]


def runs_csv(report: Mapping[str, Any]) -> str:
    """One row a run."""
    rows = [{**run, **run["settings"]} for run in report["runs"]]
    return to_csv(rows, [*CSV_FIELDS, *report["varied"]])


def write_report(report: Mapping[str, Any], folder: Path) -> dict[str, Path]:
    """Write sweep.json, .csv, .md and the figure; gives the paths by name.

    Raises:
        UserError: the folder cannot be written.
    """
    tables = [f"{sheet.title}\n\n{sheet.to_markdown()}\n" for sheet in to_sheets(report)]
    texts = {
        "sweep.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "sweep.csv": runs_csv(report),
        "sweep.md": "\n".join(["# Sweep\n", *tables, *(f"- {line}" for line in summary(report))]) + "\n",
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        pictures = {f"sweep.{suffix}": folder / f"sweep.{suffix}" for suffix in ("png", "svg")}
        draw_sweep(report["groups"], list(pictures.values()))
        return {name: folder / name for name in texts} | pictures
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
