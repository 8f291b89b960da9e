"""A comparison as CSV, Markdown and tables for the terminal, all made from its JSON object."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from popgen.reports.comparison import KINDS
from popgen.reports.frames import UNKNOWN, Sheet, number_text, range_text, to_csv
from popgen.reports.method_titles import title_of
from popgen.reports.run_record import REAL

COST_FIELDS = (
    *("environment", "label", "method", "seed", "run", "agents", "measured", "rule"),
    *KINDS[:-1],
    *("real_steps", "simulated_steps", "seconds"),
)
"""Columns of costs.csv: cumulative environment steps and seconds after M agents."""

QUALITY_FIELDS = (
    *("environment", "label", "seed", "run", "member"),
    *("steps", "simulated", "spent", "known", "sp_at_least", "xp_at_most"),
)
"""Columns of quality.csv; `steps` is empty where a member never passed both thresholds."""

BUDGET_FIELDS = ("source", "method", "environment", "agents", "reading", "budget", "SP", "XP", "MP", "total", "ratio")
"""Columns of budgets.csv."""

_RUN = ("label", "environment", "seed")
"""Keys that tell the runs of a comparison apart."""


def costs_csv(report: Mapping[str, Any]) -> str:
    """costs.csv: one row per run and number of agents."""
    return to_csv(({**row, **row["steps"], "measured": int(row["measured"])} for row in report["costs"]), COST_FIELDS)


def quality_csv(report: Mapping[str, Any]) -> str:
    """quality.csv: one row per run and member."""
    rows = []
    for row in report["quality"]["members"]:
        limit = report["quality"]["thresholds"][row["environment"]]
        rows.append({**row, "known": int(row["known"]), "sp_at_least": limit["sp"], "xp_at_most": limit["xp"]})
    return to_csv(rows, QUALITY_FIELDS)


def budgets_csv(report: Mapping[str, Any]) -> str:
    """budgets.csv: one row per source, method and reading."""
    return to_csv(({**row, **row["steps"]} for row in report["budgets"]), BUDGET_FIELDS)


def to_markdown(report: Mapping[str, Any]) -> str:
    """All tables and the notes."""
    parts = [f"## {sheet.title}\n\n{sheet.to_markdown()}\n\n" for sheet in to_sheets(report)]
    return "".join(["# Comparison\n\n", *parts, *(f"- {note}\n" for note in report["notes"])])


def to_sheets(report: Mapping[str, Any]) -> Iterator[Sheet]:
    """Cost, scores, steps to equal quality, and both readings of the budget."""
    yield _make_cost_sheet(report)
    yield _make_score_sheet(report)
    if report["quality"]["members"]:
        yield _make_quality_sheet(report)
    if report["budgets"]:
        yield _make_budget_sheet(report)


def _start_row(run: Mapping[str, Any]) -> dict[str, str]:
    return {"environment": run["environment"], "method": title_of(run["label"]), "seed": str(run["seed"])}


def _select_run(rows: Sequence[Mapping[str, Any]], run: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [row for row in rows if all(row[key] == run[key] for key in _RUN)]


def _make_cost_sheet(report: Mapping[str, Any]) -> Sheet:
    kinds = [kind for kind in map(str, REAL) if any(row["steps"][kind] for row in report["costs"])]
    cells = []
    for run in report["runs"]:
        rows = _select_run(report["costs"], run)
        for row in rows:
            if row["agents"] not in (1, run["members"], rows[-1]["agents"]):
                continue
            mark = "" if row["measured"] else "*"
            steps = {kind: row["steps"][kind] for kind in kinds}
            steps |= {"real steps": row["real_steps"], "simulated": row["simulated_steps"]}
            minutes = UNKNOWN if row["seconds"] is None else f"{row['seconds'] / 60:.1f}{mark}"
            texts = {name: f"{count:,}{mark}" for name, count in steps.items()}
            cells.append(_start_row(run) | {"agents": f"{row['agents']}{mark}"} | texts | {"minutes": minutes})
    title = "environment steps and time by number of agents (* extrapolated)"
    return Sheet(title, pd.DataFrame(cells), labels=2)


def _make_score_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = [_score_cells(row) for row in report["scores"]]
    ours = {(run["environment"], run["method"]) for run in report["runs"]}
    nothing = {"mean": None, "low": None, "high": None}
    for environment, methods in report["paper"].items():
        for method, theirs in methods.items():
            if (environment, method) not in ours:
                unknown = dict.fromkeys(("sp", "xp"), nothing) | {"gap": None, "seeds": (), "paper": theirs}
                beside = {"beside": {"random": nothing, "idle": nothing}}
                cells.append(_score_cells({"environment": environment, "label": method} | unknown | beside))
    order = list(report["paper"])
    frame = pd.DataFrame(cells).sort_values("environment", key=lambda names: names.map(order.index), kind="stable")
    unit = ", ".join(dict.fromkeys(row["unit"] for row in report["scores"]))
    return Sheet(f"self-play and cross-play, {unit} per episode (range over seeds)", frame, labels=2)


def _score_cells(row: Mapping[str, Any]) -> dict[str, str]:
    theirs = row["paper"] or {"sp": None, "xp": None}
    return {
        "environment": row["environment"],
        "method": title_of(row["label"]),
        "seeds": str(len(row["seeds"])),
        "SP": range_text(row["sp"]),
        "XP": range_text(row["xp"]),
        "SP - XP": number_text(row["gap"]),
        "beside random": range_text(row["beside"]["random"]),
        "beside idle": range_text(row["beside"]["idle"]),
        "paper SP": number_text(theirs["sp"]),
        "paper XP": number_text(theirs["xp"]),
    }


def _make_quality_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = []
    for run in report["runs"]:
        members = _select_run(report["quality"]["members"], run)
        if not members:
            continue
        limit = report["quality"]["thresholds"][run["environment"]]
        total = _select_run(report["quality"]["agents"], run)[-1]
        bound = "> " if total["lower_bound"] else ""
        texts = {
            "thresholds": f"SP >= {limit['sp']:g}, XP <= {limit['xp']:g}",
            "real steps of each agent": "  ".join(_quality_text(member) for member in members),
            "sum": f"{bound}{total['steps']:,}",
            "simulated": f"{bound}{total['simulated']:,}" if total["simulated"] else "0",
            "took": f"{run['real_steps']:,}",
        }
        cells.append(_start_row(run) | texts)
    title = "real steps to equal quality (- never, ? no learning curve; took: in all)"
    return Sheet(title, pd.DataFrame(cells), labels=2)


def _quality_text(member: Mapping[str, Any]) -> str:
    return "?" if not member["known"] else UNKNOWN if member["steps"] is None else f"{member['steps']:,}"


def _make_budget_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = [
        {
            "environment": row["environment"],
            "method": title_of(row["method"]),
            "budget of": row["source"],
            "steps a type": f"{row['budget']:,}",
            "agents": str(row["agents"]),
            "reading": row["reading"],
            "total": f"{row['total']:,}",
            "over XPM-WM's": number_text(row["ratio"], 1),
        }
        for row in report["budgets"]
    ]
    title = 'baselines under both readings of "training steps (per partner)"'
    return Sheet(title, pd.DataFrame(cells), labels=2)
