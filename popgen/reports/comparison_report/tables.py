"""A comparison as CSV, Markdown and tables for the terminal, all made from its JSON object."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.table import Table

from popgen.reports import paper_figures as paper
from popgen.reports.comparison import KINDS
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

Sheet = tuple[str, list[str], list[list[str]]]
"""Title, head and rows."""


def costs_csv(report: Mapping[str, Any]) -> str:
    """costs.csv: one row per run and number of agents."""
    rows = []
    for row in report["costs"]:
        rows.append({**row, **row["steps"], "measured": int(row["measured"])})
    return _csv(COST_FIELDS, rows)


def quality_csv(report: Mapping[str, Any]) -> str:
    """quality.csv: one row per run and member."""
    limits = report["quality"]["thresholds"]
    rows = []
    for row in report["quality"]["members"]:
        limit = limits[row["environment"]]
        rows.append({**row, "known": int(row["known"]), "sp_at_least": limit["sp"], "xp_at_most": limit["xp"]})
    return _csv(QUALITY_FIELDS, rows)


def budgets_csv(report: Mapping[str, Any]) -> str:
    """budgets.csv: one row per source, method and reading."""
    return _csv(BUDGET_FIELDS, [{**row, **row["steps"]} for row in report["budgets"]])


def _csv(fields: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, fields, lineterminator="\n", extrasaction="ignore", restval="")
    writer.writeheader()
    writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
    return text.getvalue()


def to_tables(report: Mapping[str, Any]) -> list[Table]:
    """For the terminal: cost, scores, steps to equal quality, and both readings of the budget."""
    tables = []
    for title, head, rows in _sheets(report):
        table = Table(title=title)
        for number, label in enumerate(head):
            table.add_column(label, justify="left" if number < 2 else "right", no_wrap=number < 2)
        for row in rows:
            table.add_row(*row)
        tables.append(table)
    return tables


def to_markdown(report: Mapping[str, Any]) -> str:
    """The same tables and the notes."""
    parts = ["# Comparison", ""]
    for title, head, rows in _sheets(report):
        parts += [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
        parts += ["| " + " | ".join(row) + " |" for row in rows] + [""]
    return "\n".join([*parts, *(f"- {note}" for note in report["notes"])]) + "\n"


def _sheets(report: Mapping[str, Any]) -> Iterable[Sheet]:
    yield _cost_sheet(report)
    yield _score_sheet(report)
    if report["quality"]["members"]:
        yield _quality_sheet(report)
    if report["budgets"]:
        yield _budget_sheet(report)


def _cost_sheet(report: Mapping[str, Any]) -> Sheet:
    kinds = [kind for kind in map(str, REAL) if any(row["steps"][kind] for row in report["costs"])]
    head = ["environment", "method", "seed", "agents", *kinds, "real steps", "simulated", "minutes"]
    rows = []
    for run in report["runs"]:
        who = {"label": run["label"], "environment": run["environment"], "seed": run["seed"]}
        found = [row for row in report["costs"] if all(row[key] == value for key, value in who.items())]
        for row in found:
            if row["agents"] in (1, run["members"], found[-1]["agents"]):
                mark = "" if row["measured"] else "*"
                minutes = "-" if row["seconds"] is None else f"{row['seconds'] / 60:.1f}{mark}"
                cells = [*(row["steps"][kind] for kind in kinds), row["real_steps"], row["simulated_steps"]]
                start = [run["environment"], _name(run["label"]), str(run["seed"]), f"{row['agents']}{mark}"]
                rows.append([*start, *(f"{cell:,}{mark}" for cell in cells), minutes])
    return "environment steps and time by number of agents (* extrapolated)", head, rows


def _score_sheet(report: Mapping[str, Any]) -> Sheet:
    head = [
        "environment",
        "method",
        "seeds",
        "SP",
        "XP",
        "SP - XP",
        "beside random",
        "beside idle",
        "paper SP",
        "paper XP",
    ]
    rows = []
    for row in report["scores"]:
        theirs = row["paper"] or {"sp": None, "xp": None}
        figures = [_range(row["sp"]), _range(row["xp"]), _figure(row["gap"])]
        figures += [_range(row["beside"][who]) for who in ("random", "idle")]
        figures += [_figure(theirs["sp"]), _figure(theirs["xp"])]
        rows.append([row["environment"], _name(row["label"]), str(len(row["seeds"])), *figures])
    shown = {(run["environment"], run["method"]) for run in report["runs"]}
    for environment, methods in report["paper"].items():
        for method, theirs in methods.items():
            if (environment, method) not in shown:
                rows.append([environment, _name(method), "0", *"-----", _figure(theirs["sp"]), _figure(theirs["xp"])])
    rows.sort(key=lambda row: list(report["paper"]).index(row[0]))
    unit = ", ".join(dict.fromkeys(row["unit"] for row in report["scores"]))
    return f"self-play and cross-play, {unit} per episode (range over seeds)", head, rows


def _quality_sheet(report: Mapping[str, Any]) -> Sheet:
    limits = report["quality"]["thresholds"]
    head = ["environment", "method", "seed", "thresholds", "real steps of each agent", "sum", "simulated", "took"]
    rows = []
    for run in report["runs"]:
        found = _same_run(report["quality"]["members"], run)
        if not found:
            continue
        limit, total = limits[run["environment"]], _same_run(report["quality"]["agents"], run)[-1]
        each = "  ".join(_steps(one) for one in found)
        start = [
            run["environment"],
            _name(run["label"]),
            str(run["seed"]),
            f"SP >= {limit['sp']:g}, XP <= {limit['xp']:g}",
        ]
        bound = "> " if total["lower_bound"] else ""
        simulated = f"{bound}{total['simulated']:,}" if total["simulated"] else "0"
        sums = [f"{bound}{total['steps']:,}", simulated, f"{run['real_steps']:,}"]
        rows.append([*start, each, *sums])
    return "real steps to equal quality (- never, ? no learning curve; took: in all)", head, rows


def _same_run(rows: Sequence[Mapping[str, Any]], run: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [row for row in rows if all(row[key] == run[key] for key in ("label", "environment", "seed"))]


def _steps(one: Mapping[str, Any]) -> str:
    return "?" if not one["known"] else "-" if one["steps"] is None else f"{one['steps']:,}"


def _budget_sheet(report: Mapping[str, Any]) -> Sheet:
    head = ["environment", "method", "budget of", "steps a type", "agents", "reading", "total", "over XPM-WM's"]
    rows = []
    for row in report["budgets"]:
        start = [row["environment"], paper.METHOD_NAMES[row["method"]], row["source"], f"{row['budget']:,}"]
        ratio = "-" if row["ratio"] is None else f"{row['ratio']:.1f}"
        rows.append([*start, str(row["agents"]), row["reading"], f"{row['total']:,}", ratio])
    return 'baselines under both readings of "training steps (per partner)"', head, rows


def _name(label: str) -> str:
    return paper.METHOD_NAMES.get(label, label)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _range(spread: Mapping[str, float | None]) -> str:
    if spread["mean"] is None or spread["low"] == spread["high"]:
        return _figure(spread["mean"])
    return f"{spread['mean']:.2f} ({spread['low']:.2f} to {spread['high']:.2f})"
