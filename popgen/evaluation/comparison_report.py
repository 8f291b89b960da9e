"""A comparison of runs as JSON, CSV, Markdown, tables for the terminal and charts.

Keys of the JSON object (`comparison.json`); null stands for what is unknown:

    format, format_version   "popgen-comparison", 1
    agents                   M up to which costs are extrapolated
    runs                     label, method, environment, cooking, fingerprint, seed, scale, path, members, adopted,
                             attempts, steps (by kind), real_steps, simulated_steps, evaluation_steps, lost_steps,
                             seconds
    costs                    one per run and M: label, environment, seed, agents, measured, rule, steps (by kind,
                             cumulative), real_steps, simulated_steps, seconds
    scores                   one per label and environment: seeds, sp and xp (mean, low, high over seeds), gap, beside
                             (random, idle), paper (sp, xp or null)
    quality                  thresholds (environment -> sp, xp or null), members (label, environment, seed, member,
                             steps or null, simulated, spent, known), agents (label, environment, seed, agents,
                             steps, simulated, reached, lower_bound)
    paper                    environment -> method -> sp, xp: all that the paper has on these environments
    budgets                  both readings of the baselines' budget: source (`paper` or a run), method, environment,
                             agents, reading, budget, steps (by kind), total, ratio (over the paper's XPM-WM)
    notes                    what a reader must know, in sentences
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from popgen.errors import UserError
from popgen.evaluation import paper
from popgen.evaluation.comparison import (
    KINDS,
    Budget,
    Group,
    Thresholds,
    budgets,
    costs,
    default_thresholds,
    quality,
    quality_band,
    quality_costs,
    step_band,
    time_band,
)
from popgen.evaluation.plots import Line, bands_by_members, kinds_by_members
from popgen.evaluation.runs import REAL, RunRecord
from popgen.types import Kind

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

EXTRAPOLATED = "extrapolated"


@dataclass(frozen=True)
class Comparison:
    """What is compared, and how.

    Attributes:
        groups: from `group_runs`.
        agents: costs are carried on to this many.
        thresholds: of equal quality by environment; an environment without is left out of it.
    """

    groups: tuple[Group, ...]
    agents: int
    thresholds: Mapping[str, Thresholds]

    @property
    def environments(self) -> list[str]:
        """Names, in order."""
        return list(dict.fromkeys(group.environment for group in self.groups))


def chosen_thresholds(groups: Sequence[Group], sp: float | None, xp: float | None) -> dict[str, Thresholds]:
    """Thresholds by environment: those given, else the defaults where there are any.

    Raises:
        UserError: only one of the two was given for an environment that has no defaults.
    """
    found: dict[str, Thresholds] = {}
    for name in dict.fromkeys(group.environment for group in groups):
        base = default_thresholds(name)
        if base is None and (sp is None) != (xp is None):
            missing = "--sp" if sp is None else "--xp"
            raise UserError(missing, f"the paper has no dishes for {name} to take it from", "give both --sp and --xp")
        if base is None and (sp is None or xp is None):
            continue
        first = sp if sp is not None else base.sp if base else 0.0
        second = xp if xp is not None else base.xp if base else 0.0
        found[name] = Thresholds(first, second)
    return found


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """The JSON object of the module's docstring."""
    return {
        "format": "popgen-comparison",
        "format_version": 1,
        "agents": comparison.agents,
        "runs": [_run(group, run) for group in comparison.groups for run in group.runs],
        "costs": [row for group in comparison.groups for row in _costs(group, comparison.agents)],
        "scores": [_scores(group) for group in comparison.groups],
        "quality": _quality(comparison),
        "paper": {
            name: {method: {"sp": row.sp, "xp": row.xp} for method, row in paper.SCORES.get(name, {}).items()}
            for name in comparison.environments
        },
        "budgets": [_budget(budget) for budget in budgets(comparison.groups, comparison.agents)],
        "notes": _notes(comparison),
    }


def _run(group: Group, run: RunRecord) -> dict[str, Any]:
    steps = {kind: sum(m.steps.get(kind, 0) for m in run.members) for kind in KINDS}
    times = [m.seconds for m in run.members]
    return {
        "label": group.label,
        "method": group.method,
        "environment": group.environment,
        "cooking": run.environment.cooking,
        "fingerprint": run.environment.fingerprint,
        "seed": run.seed,
        "scale": run.scale,
        "path": str(run.path),
        "members": len(run.members),
        "adopted": sum(m.adopted for m in run.members),
        "attempts": run.attempts,
        "steps": steps,
        "real_steps": sum(steps[str(kind)] for kind in REAL),
        "simulated_steps": steps[str(Kind.SIMULATED)],
        "evaluation_steps": run.evaluation_steps,
        "lost_steps": run.lost_steps,
        "seconds": None if None in times else round(sum(times), 1),
    }


def _costs(group: Group, agents: int) -> Iterable[dict[str, Any]]:
    for run in group.runs:
        for cost in costs(run, agents):
            yield {
                "label": group.label,
                "environment": group.environment,
                "method": group.method,
                "seed": run.seed,
                "run": run.run_id,
                "agents": cost.agents,
                "measured": cost.measured,
                "rule": cost.rule,
                "steps": {str(kind): round(cost.steps[str(kind)]) for kind in REAL},
                "real_steps": round(cost.real),
                "simulated_steps": round(cost.simulated),
                "seconds": None if cost.seconds is None else round(cost.seconds, 1),
            }


def _scores(group: Group) -> dict[str, Any]:
    """Means over seeds of each run's own SP/XP report."""
    reports = [run.scores for run in group.runs]
    sp, xp = (_spread([report[name]["mean"] for report in reports]) for name in ("sp", "xp"))
    theirs = paper.scores(group.environment, group.method)
    apart = None if sp["mean"] is None or xp["mean"] is None else sp["mean"] - xp["mean"]
    return {
        "label": group.label,
        "environment": group.environment,
        "unit": reports[0]["unit"],
        "seeds": [run.seed for run in group.runs],
        "members": [len(run.members) for run in group.runs],
        "sp": sp,
        "xp": xp,
        "gap": apart,
        "beside": {
            who: _spread([report["beside"][who]["both"]["mean"] for report in reports]) for who in ("random", "idle")
        },
        "paper": None if theirs is None else {"sp": theirs.sp, "xp": theirs.xp},
    }


def _spread(values: Sequence[float | None]) -> dict[str, float | None]:
    known = [value for value in values if value is not None]
    if not known:
        return {"mean": None, "low": None, "high": None}
    return {"mean": float(np.mean(known)), "low": min(known), "high": max(known)}


def _quality(comparison: Comparison) -> dict[str, Any]:
    members, agents = [], []
    for group in comparison.groups:
        limits = comparison.thresholds.get(group.environment)
        for run in group.runs if limits else ():
            head = {"label": group.label, "environment": group.environment, "seed": run.seed, "run": run.run_id}
            for one in (quality(member, limits) for member in run.members):
                members.append(head | asdict(one))
            for many in quality_costs(run, limits):
                agents.append(head | asdict(many) | {"lower_bound": many.bound})
    limits = {name: comparison.thresholds.get(name) for name in comparison.environments}
    told = {name: None if limit is None else {"sp": limit.sp, "xp": limit.xp} for name, limit in limits.items()}
    return {"thresholds": told, "members": members, "agents": agents}


def _budget(budget: Budget) -> dict[str, Any]:
    names = ("source", "method", "environment", "agents", "reading", "budget", "total", "ratio")
    return {name: getattr(budget, name) for name in names} | {"steps": dict(budget.steps)}


def _notes(comparison: Comparison) -> list[str]:
    """Sentences about what the figures do not say by themselves."""
    notes = ["Simulated steps (of an exact simulator used as dynamics model) are counted apart and in no total."]
    runs = [run for group in comparison.groups for run in group.runs]
    if any(len(run.members) < comparison.agents for run in runs):
        notes.append("Points with more agents than a run has are extrapolated: a line through members 2 and up.")
    for name in comparison.environments:
        if (steps := paper.xpm_wm_budget(name, comparison.agents)) is not None:
            notes.append(f"The paper's XPM-WM took {steps:,} steps for {comparison.agents} agents on {name}.")
    for run in runs:
        if len(run.members) == 1:
            notes.append(f"{run.run_id} has one agent, from which nothing is extrapolated.")
        if run.settings.get("diversity.order") == "concurrent":
            notes.append(f"{run.run_id} trained its agents together: for fewer agents it is these agents' share.")
        if adopted := sum(m.adopted for m in run.members):
            notes.append(f"{run.run_id} took over {adopted} agents of another run, with the steps of that run.")
        if run.attempts > 1:
            notes.append(
                f"{run.run_id} was started {run.attempts} times: {run.lost_steps:,} steps were done again and are in "
                "no total; seconds are those of each agent's last start."
            )
    if len({run.scale for run in runs}) > 1:
        notes.append(f"Scales differ: {', '.join(sorted({run.scale for run in runs}))}.")
    for name in comparison.environments:
        if name not in comparison.thresholds:
            notes.append(f"No thresholds of equal quality for {name}: give --sp and --xp.")
    return notes


# --- files


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


Sheet = tuple[str, list[str], list[list[str]]]


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
    return f"environment steps and time by number of agents (* {EXTRAPOLATED})", head, rows


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


# --- charts


def draw(comparison: Comparison, folder: Path) -> dict[str, Path]:
    """steps, steps_by_kind, time and quality as PNG and SVG; gives the paths by name."""
    found: dict[str, Path] = {}

    def two(name: str) -> list[Path]:
        paths = {f"{name}.{suffix}": folder / f"{name}.{suffix}" for suffix in ("png", "svg")}
        found.update(paths)
        return [*paths.values()]

    steps = {short_name(name): _step_lines(comparison, name) for name in comparison.environments}
    bands_by_members(
        *(steps, two("steps")),
        axis="real environment steps",
        hollow=EXTRAPOLATED,
        dotted="simulated steps",
    )
    alone = short_name(comparison.environments[0]) if len(comparison.environments) == 1 else ""
    kinds_by_members(_kind_panels(comparison), two("steps_by_kind"), title=alone)
    times = {short_name(name): _time_lines(comparison, name) for name in comparison.environments}
    if any(len(line.band.agents) for lines in times.values() for line in lines):
        bands_by_members(times, two("time"), axis="minutes of training", hollow=EXTRAPOLATED, scale=60.0)
    good = {_limits(name, limit): _quality_lines(comparison, name) for name, limit in comparison.thresholds.items()}
    if any(good.values()):
        bands_by_members(good, two("quality"), axis="real steps to equal quality", hollow="lower bound", bounds=True)
    return found


def _limits(name: str, limit: Thresholds) -> str:
    return f"{short_name(name)}: SP ≥ {limit.sp:g}, XP ≤ {limit.xp:g}"


def short_name(environment: str) -> str:
    """As the paper calls it, else the variant alone."""
    return paper.LAYOUT_NAMES.get(environment, environment.rpartition("/")[2])


def _of(comparison: Comparison, name: str) -> list[Group]:
    return [group for group in comparison.groups if group.environment == name]


def _step_lines(comparison: Comparison, name: str) -> list[Line]:
    lines = [Line(g.label, g.name, step_band(g, comparison.agents)) for g in _of(comparison, name)]
    simulated = [
        Line(g.label, g.name, band, dotted=True)
        for g in _of(comparison, name)
        if (band := step_band(g, comparison.agents, str(Kind.SIMULATED))).mean.any()
    ]
    return lines + simulated


def _time_lines(comparison: Comparison, name: str) -> list[Line]:
    return [Line(g.label, g.name, time_band(g, comparison.agents)) for g in _of(comparison, name)]


def _quality_lines(comparison: Comparison, name: str) -> list[Line]:
    limits = comparison.thresholds[name]
    groups = [g for g in _of(comparison, name) if any(m.curve for run in g.runs for m in run.members)]
    return [Line(g.label, g.name, quality_band(g, limits)) for g in groups]


def _kind_panels(comparison: Comparison) -> dict[str, Any]:
    panels = {}
    for group in comparison.groups:
        title = group.name
        if len(comparison.environments) > 1:
            title += f"\n{short_name(group.environment)}"
        kinds = {str(kind): step_band(group, comparison.agents, str(kind)) for kind in REAL}
        panels[title] = (kinds, step_band(group, comparison.agents, str(Kind.SIMULATED)))
    return panels


def write_report(comparison: Comparison, folder: str | Path) -> dict[str, Path]:
    """Write comparison.json and .md, costs.csv, quality.csv, budgets.csv and the charts; gives the paths by name.

    Raises:
        UserError: the folder cannot be written.
    """
    folder, report = Path(folder), to_dict(comparison)
    texts = {
        "comparison.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "comparison.md": to_markdown(report),
        "costs.csv": costs_csv(report),
        "quality.csv": quality_csv(report),
        "budgets.csv": budgets_csv(report),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
        return {name: folder / name for name in texts} | draw(comparison, folder)
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
