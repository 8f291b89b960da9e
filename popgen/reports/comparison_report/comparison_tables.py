"""A comparison as CSV, Markdown and tables for the terminal, all made from its JSON object."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd

from popgen.reports.comparison import KINDS
from popgen.reports.frames import UNKNOWN, Sheet, estimate_text, number_text, range_text, to_csv
from popgen.reports.method_titles import title_of
from popgen.reports.run_record import REAL

COST_FIELDS = (
    *("environment", "label", "method", "seed", "run", "agents", "measured", "rule"),
    *KINDS[:-1],
    *("real_steps", "simulated_steps", "seconds"),
)
"""Columns of costs.csv: cumulative environment steps and seconds after M agents."""

QUALITY_FIELDS = (
    *("environment", "label", "seed", "run", "member", "passed", "sp", "sp_error", "xp", "xp_error", "episodes"),
    *("taken", "simulated", "spent", "window", "sp_at_least", "xp_at_most"),
)
"""Columns of quality.csv; `passed`, `sp` and `xp` are empty without a held evaluation, `window` where no window of
training passed both thresholds."""

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
        run = next(one for one in report["runs"] if all(one[key] == row[key] for key in _RUN))
        figures: dict[str, Any] = {}
        for name in ("sp", "xp"):
            figure = row[name] or {"mean": None, "standard_error": None}
            figures |= {name: figure["mean"], f"{name}_error": figure["standard_error"]}
        passed = None if row["passed"] is None else int(row["passed"])
        limits = {"sp_at_least": limit["sp"], "xp_at_most": limit["xp"], "episodes": run["held_episodes"]}
        rows.append({**row, **figures, **limits, "passed": passed})
    return to_csv(rows, QUALITY_FIELDS)


def budgets_csv(report: Mapping[str, Any]) -> str:
    """budgets.csv: one row per source, method and reading."""
    return to_csv(({**row, **row["steps"]} for row in report["budgets"]), BUDGET_FIELDS)


def to_markdown(report: Mapping[str, Any]) -> str:
    """All tables and the notes."""
    parts = [f"## {sheet.title}\n\n{sheet.to_markdown()}\n\n" for sheet in to_sheets(report)]
    return "".join(["# Comparison\n\n", *parts, *(f"- {note}\n" for note in report["notes"])])


def to_sheets(report: Mapping[str, Any]) -> Iterator[Sheet]:
    """Headline, cost, scores, quality by agent, options, and both readings of the budget."""
    if report["headline"]:
        yield _make_headline_sheet(report)
    yield _make_cost_sheet(report)
    yield _make_score_sheet(report)
    if report["quality"]["members"]:
        yield _make_quality_sheet(report)
    yield _make_option_sheet(report)
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


def _make_headline_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = []
    for row in report["headline"]:
        bound = "" if row["passed"] == row["runs"] else "> "
        cells.append(
            {
                "environment": row["environment"],
                "method": title_of(row["label"]),
                "agents": str(row["agents"]),
                "passed": f"{row['passed']} of {row['runs']} runs",
                "steps taken by then": f"{bound}{_steps_text(row['steps'])}",
                "simulated": _steps_text(row["simulated"]),
                "times the least": bound + number_text(row["ratio"], 1) if row["ratio"] is not None else UNKNOWN,
            }
        )
    title = "real steps taken in all when agent M had passed, all that it builds on included (range over seeds)"
    return Sheet(title, pd.DataFrame(cells), labels=2)


def _steps_text(spread: Mapping[str, float | None]) -> str:
    mean, low, high = (spread[key] for key in ("mean", "low", "high"))
    if mean is None or low is None or high is None:
        return UNKNOWN
    return f"{mean:,.0f}" if low == high else f"{mean:,.0f} ({low:,.0f} to {high:,.0f})"


def _make_quality_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = []
    for run in report["runs"]:
        limit = report["quality"]["thresholds"][run["environment"]]
        for one in _select_run(report["quality"]["members"], run):
            passed = {None: "?", True: "yes", False: "no"}[one["passed"]]
            texts = {
                "agent": str(one["member"]),
                "thresholds": f"SP >= {limit['sp']:g}, XP <= {limit['xp']:g}",
                "SP": UNKNOWN if one["sp"] is None else estimate_text(one["sp"]),
                "XP": UNKNOWN if one["xp"] is None else estimate_text(one["xp"]),
                "passed": passed,
                "taken by then": f"{one['taken']:,}",
                "simulated": f"{one['simulated']:,}",
                "own": f"{one['spent']:,}",
                "a window of training": UNKNOWN if one["window"] is None else f"{one['window']:,}",
            }
            cells.append(_start_row(run) | texts)
    title = "held evaluation of each agent; real steps taken in all (a window of training is no evidence)"
    return Sheet(title, pd.DataFrame(cells), labels=2)


def _make_option_sheet(report: Mapping[str, Any]) -> Sheet:
    cells = [
        {
            "environment": row["environment"],
            "method": title_of(row["label"]),
            "not its recipe's": _options_text(row["given"]),
            "of its recipe, on cross-play": _options_text(row["cross_play"]),
        }
        for row in report["options"]
    ]
    return Sheet("what each method was given", pd.DataFrame(cells), labels=2)


def _options_text(options: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in options.items()) or UNKNOWN


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
