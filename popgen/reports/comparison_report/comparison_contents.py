"""What a comparison tells: the JSON object of the package's docstring."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from popgen.errors import UserError
from popgen.evaluation.estimates import Estimate
from popgen.evaluation.held_members import HeldScores
from popgen.methods.registry import recipe
from popgen.reports import paper_figures as paper
from popgen.reports.comparison import (
    KINDS,
    LINE,
    Budget,
    Group,
    Quality,
    Thresholds,
    budgets,
    costs,
    default_thresholds,
    judge_members,
    quality_costs,
)
from popgen.reports.frames import spread_of
from popgen.reports.method_titles import name_of, title_of
from popgen.reports.run_record import REAL, RunRecord, flatten_settings
from popgen.types import Kind


@dataclass(frozen=True)
class Comparison:
    """What is compared, and how.

    Attributes:
        groups: from `group_runs`.
        agents: costs are carried on to this many where that can be; None for costs as measured.
        thresholds: of equal quality by environment; an environment without is left out of it.
        held: folder of a run -> held evaluation of its members.
    """

    groups: tuple[Group, ...]
    agents: int | None
    thresholds: Mapping[str, Thresholds]
    held: Mapping[str, HeldScores] = field(default_factory=dict)

    @property
    def budget_agents(self) -> int:
        """Agents for which the baselines' budget is told: as many as asked for, else the paper's."""
        return self.agents or paper.AGENTS

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
    """The JSON object of the package's docstring."""
    return {
        "format": "popgen-comparison",
        "format_version": 1,
        "agents": comparison.agents,
        "runs": [_describe_run(comparison, group, run) for group in comparison.groups for run in group.runs],
        "costs": [row for group in comparison.groups for row in _list_costs(group, comparison.agents)],
        "scores": [_average_scores(group) for group in comparison.groups],
        "quality": _describe_quality(comparison),
        "headline": list(_list_headlines(comparison)),
        "options": [_describe_options(group) for group in comparison.groups],
        "paper": {
            name: {name_of(r.method): {"sp": r.sp, "xp": r.xp} for r in paper.REPORTED if r.environment == name}
            for name in comparison.environments
        },
        "budgets": [_describe_budget(budget) for budget in budgets(comparison.groups, comparison.budget_agents)],
        "notes": _write_notes(comparison),
    }


def _describe_run(comparison: Comparison, group: Group, run: RunRecord) -> dict[str, Any]:
    held = comparison.held.get(str(run.path))
    steps = {kind: sum(m.steps.get(kind, 0) for m in run.members) for kind in KINDS}
    times = [m.seconds for m in run.members if m.seconds is not None]
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
        "held_episodes": None if held is None else held.episodes,
        "held_steps": 0 if held is None else held.steps,
        "lost_steps": run.lost_steps,
        "seconds": round(sum(times), 1) if len(times) == len(run.members) else None,
    }


def _list_costs(group: Group, agents: int | None) -> Iterable[dict[str, Any]]:
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


def _average_scores(group: Group) -> dict[str, Any]:
    """Means over seeds of each run's own SP/XP report."""
    reports = [run.scores for run in group.runs]
    sp, xp = (spread_of([report[name]["mean"] for report in reports]) for name in ("sp", "xp"))
    theirs = paper.find_row(group.environment, title_of(group.method))
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
            who: spread_of([report["beside"][who]["both"]["mean"] for report in reports]) for who in ("random", "idle")
        },
        "paper": None if theirs is None else {"sp": theirs.sp, "xp": theirs.xp},
    }


def _describe_quality(comparison: Comparison) -> dict[str, Any]:
    members, agents = [], []
    for group in comparison.groups:
        limits = comparison.thresholds.get(group.environment)
        if limits is None:
            continue
        for run in group.runs:
            head = {"label": group.label, "environment": group.environment, "seed": run.seed, "run": run.run_id}
            held = comparison.held.get(str(run.path))
            for one in judge_members(run, limits, held):
                figures = {name: None if value is None else value.to_dict() for name, value in _scores_of(one).items()}
                members.append(head | asdict(one) | figures)
            for many in quality_costs(run, limits, held):
                agents.append(head | asdict(many) | {"lower_bound": many.bound})
    chosen = {name: comparison.thresholds.get(name) for name in comparison.environments}
    thresholds = {name: None if limit is None else {"sp": limit.sp, "xp": limit.xp} for name, limit in chosen.items()}
    return {"thresholds": thresholds, "members": members, "agents": agents}


def _scores_of(one: Quality) -> dict[str, Estimate | None]:
    return {"sp": one.sp, "xp": one.xp}


def _list_headlines(comparison: Comparison) -> Iterable[dict[str, Any]]:
    """For each label: steps taken in all when agent M had passed, M being the most that all runs there have, and how
    many times as many as the label with the fewest that passed."""
    for name, limits in comparison.thresholds.items():
        groups = [group for group in comparison.groups if group.environment == name]
        agents = min(len(run.members) for group in groups for run in group.runs)
        if not agents:
            continue
        rows = []
        for group in groups:
            found = [quality_costs(run, limits, comparison.held.get(str(run.path)))[agents - 1] for run in group.runs]
            passed = sum(not one.bound for one in found)
            steps, simulated = spread_of(one.steps for one in found), spread_of(one.simulated for one in found)
            seeds = len(found)
            rows.append({"label": group.label, "steps": steps, "simulated": simulated, "passed": passed, "runs": seeds})
        least = min((row["steps"]["mean"] for row in rows if row["passed"] == row["runs"]), default=None)
        for row in rows:
            ratio = None if least is None else row["steps"]["mean"] / least
            yield {"environment": name, "agents": agents, **row, "ratio": ratio}


OPTION_WORDS = ("lambda", "clip", "stop", "target", "until", "floor", "constraint", "restart", "rounds", "bound")
"""Settings with one of these words in their names decide how hard and how long cross-play is pressed down."""


def _describe_options(group: Group) -> dict[str, Any]:
    """What a method was given: settings that are not its recipe's, and those of the recipe that shape cross-play."""
    settings = group.runs[0].settings if group.runs else {}
    try:
        usual = flatten_settings(recipe(group.method, group.environment, group.runs[0].scale).as_dict())
    except (UserError, KeyError, ValueError):  # of a method or scale that is not installed here
        usual = {}
    given = {name: value for name, value in settings.items() if name in usual and usual[name] != value}
    shaping = {name: settings[name] for name in sorted(settings) if _shapes_cross_play(name)}
    return {"label": group.label, "environment": group.environment, "given": given, "cross_play": shaping}


def _shapes_cross_play(setting: str) -> bool:
    return any(word in setting.rpartition(".")[2] for word in OPTION_WORDS)


def _describe_budget(budget: Budget) -> dict[str, Any]:
    names = ("source", "method", "environment", "agents", "reading", "budget", "total", "ratio")
    return {name: getattr(budget, name) for name in names} | {"steps": dict(budget.steps)}


def _write_notes(comparison: Comparison) -> list[str]:
    """Sentences about what the figures do not say by themselves."""
    notes = ["Simulated steps (of an exact simulator used as dynamics model) are counted apart and in no total."]
    runs = [run for group in comparison.groups for run in group.runs]
    held = [one for run in runs if (one := comparison.held.get(str(run.path)))]
    if held:
        steps = sum(one.steps for one in held)
        told = f"{held[0].episodes} episodes for each member alone, and for each pair and seating"
        notes.append(f"A member passes by a held evaluation of its own policy: {told}; {steps:,} steps, in no total.")
    if any(cost.rule == LINE for run in runs for cost in costs(run, comparison.agents)):
        notes.append("Points with more agents than a run has are extrapolated: a line through members 2 and up.")
    agents = comparison.budget_agents
    for name in comparison.environments:
        if (steps := paper.xpm_wm_budget(name, agents)) is not None:
            notes.append(f"The paper's XPM-WM took {steps:,} steps for {agents} agents on {name}.")
    for run in runs:
        if run.settings.get("diversity.order") == "concurrent":
            notes.append(f"{run.run_id} trained its agents together: for fewer agents it is these agents' share.")
        notes += [f"{run.run_id}: {line}." for line in run.weak_members]
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
