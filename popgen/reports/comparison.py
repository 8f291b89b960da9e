"""Runs of several methods beside each other: cost against the number of agents, scores, and steps to equal quality.

A group is one label (a method, unless runs were given names) in one environment; its runs differ in their seeds only.
Cost after M agents is the sum over members 1..M, as measured. Beyond a run's own size it is extrapolated only if asked
for, and only where at least three later members were measured and cost more and more: kind by kind, a straight line
through members 2, 3, ... by least squares; its time is that many real and simulated steps at the speed of the later
members. Nothing is extrapolated flat. Real steps, steps of an exact simulator used as dynamics model, and those of
evaluations are three figures.

Equal quality is judged by held evaluations of finished members (`popgen.evaluation.held_members`), with as many
episodes for every method. Its cost is what had been taken in all when the member was finished, with everything that it
builds on: all earlier members, or all members where they learn together.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from popgen.errors import UserError
from popgen.evaluation.estimates import Estimate
from popgen.evaluation.held_members import HeldMember, HeldScores
from popgen.reports import paper_figures as paper
from popgen.reports.method_titles import METHODS, name_of, title_of
from popgen.reports.run_record import REAL, MemberRecord, RunRecord, differences
from popgen.types import Kind

KINDS = (*(str(kind) for kind in REAL), str(Kind.SIMULATED))
MEASURED, LINE = "measured", "line through members 2 and up"
LEAST_LATER = 3
"""Later members without which no line is drawn beyond the last."""
SHARE_SP, SHARE_XP = 0.8, 0.2
"""Default thresholds of equal quality, as shares of the self-play score of the paper's XPM-WM on the layout."""


@dataclass(frozen=True)
class Cost:
    """What a run took for its first M agents.

    Attributes:
        agents: M.
        steps: kind -> cumulative environment steps, simulated ones among them.
        seconds: cumulative; None where a member's time is unknown.
        rule: `measured`, or how the figure was extrapolated.
    """

    agents: int
    steps: Mapping[str, float]
    seconds: float | None
    rule: str

    @property
    def measured(self) -> bool:
        """Every member of it was trained."""
        return self.rule == MEASURED

    @property
    def real(self) -> float:
        """Real environment steps of training."""
        return sum(self.steps[str(kind)] for kind in REAL)

    @property
    def simulated(self) -> float:
        """Steps of an exact simulator used as dynamics model; no part of `real`."""
        return self.steps[str(Kind.SIMULATED)]


@dataclass(frozen=True)
class Thresholds:
    """Equal quality: self-play of at least `sp` while cross-play with the strongest partner is at most `xp`."""

    sp: float
    xp: float


@dataclass(frozen=True)
class Quality:
    """Whether a finished member is good enough, and what it took to have it.

    Attributes:
        member: from 1.
        passed: by a held evaluation of its policy; None where there was none.
        sp, xp: of that evaluation; `xp` with the strongest earlier member, None for the first.
        taken: real steps in all when it was finished, of everything that it builds on.
        simulated: the same of simulated steps; no part of `taken`.
        spent: its own real steps.
        window: as `taken`, when a window of training first showed both thresholds passed, by whatever policy played in
            it; None where none did. No evidence of a policy's quality.
    """

    member: int
    passed: bool | None
    sp: Estimate | None
    xp: Estimate | None
    taken: int
    simulated: int
    spent: int
    window: int | None


@dataclass(frozen=True)
class Group:
    """Runs of one label in one environment."""

    label: str
    method: str
    environment: str
    runs: tuple[RunRecord, ...]

    @property
    def name(self) -> str:
        """As charts and tables call it."""
        return title_of(self.label)


def group_runs(runs: Sequence[RunRecord]) -> list[Group]:
    """Sort runs by environment and label.

    Raises:
        UserError: no runs, one folder twice, one environment name with different rules, or one label for runs that
            differ in more than their seed.
    """
    if not runs:
        raise UserError("runs", "there are none to compare", "give folders of finished runs, or --start one")
    places: set[str] = set()
    for run in runs:
        if (place := str(run.path.resolve())) in places:
            raise UserError(str(run.path), "is given twice", "give each run once")
        places.add(place)
    found: dict[tuple[str, str], list[RunRecord]] = {}
    for run in runs:
        found.setdefault((run.environment.name, run.label), []).append(run)
    for first in {run.environment.name: run for run in reversed(runs)}.values():
        for run in runs:
            if run.environment.name == first.environment.name:
                _check_environment(first, run)
    for members in found.values():
        for first, run in itertools.combinations(members, 2):
            _check_label(first, run)
    order = list(METHODS)
    groups = [Group(label, members[0].method, name, tuple(members)) for (name, label), members in found.items()]
    rank = {label: order.index(label) if label in order else len(order) for _, label in found}
    names = list(dict.fromkeys(group.environment for group in groups))
    return sorted(groups, key=lambda group: (names.index(group.environment), rank[group.label]))


def _check_environment(first: RunRecord, run: RunRecord) -> None:
    """Two runs on an environment of the same name must have the same rules."""
    here, there = run.environment, first.environment
    if here.fingerprint == there.fingerprint:
        return
    if here.cooking != there.cooking:
        problem = f"cooking is {here.cooking}, in {first.path} it is {there.cooking}"
    else:
        names = sorted({*here.params, *there.params})
        different = [name for name in names if here.params.get(name) != there.params.get(name)]
        told = (f"{n} is {_shorten(here.params.get(n))}, there {_shorten(there.params.get(n))}" for n in different)
        problem = f"{here.name} is not that of {first.path}: {', '.join(told) or 'its rules differ'}"
    raise UserError(str(run.path), problem, "compare runs of one environment")


def _check_label(first: RunRecord, run: RunRecord) -> None:
    """Runs of one label must be seeds of the same thing."""
    name = f"{run.label} on {run.environment.name}"
    if different := differences(first, run):
        values = f"{_shorten(run.settings.get(different[0]))}, there {_shorten(first.settings.get(different[0]))}"
        more = f" and {len(different) - 1} more" if len(different) > 1 else ""
        problem = f"is {name} like {first.path}, but {different[0]} is {values}{more}"
        raise UserError(str(run.path), problem, "tell them apart with NAME=RUN")
    if run.seed == first.seed:
        problem = f"is {name} with seed {run.seed}, like {first.path}"
        raise UserError(str(run.path), problem, "give one of them, or tell them apart with NAME=RUN")


def _shorten(value: object) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def costs(run: RunRecord, agents: int | None = None) -> list[Cost]:
    """Cumulative cost after 1, 2, ... agents: of the members, and beyond them up to `agents` by the module's rule."""
    size = len(run.members)
    total = max(agents or size, size) if _grows(run) else size
    steps = {kind: _sum_up([m.steps.get(kind, 0) for m in run.members], total) for kind in KINDS}
    seconds = _sum_seconds(run, steps, total)
    return [
        Cost(
            agents=m,
            steps={kind: steps[kind][m - 1] for kind in KINDS},
            seconds=None if seconds is None else seconds[m - 1],
            rule=MEASURED if m <= size else LINE,
        )
        for m in range(1, total + 1)
    ]


def _grows(run: RunRecord) -> bool:
    """Whether enough later members were measured, and the line through their cost rises."""
    later = [sum(m.steps.get(kind, 0) for kind in KINDS) for m in run.members[1:]]
    return len(later) >= LEAST_LATER and float(np.polyfit(np.arange(len(later)), later, 1)[0]) > 1e-9 * max(later)


def _sum_up(values: Sequence[float], total: int) -> list[float]:
    """Sums after each member, carried on to `total` members in a straight line through the later ones."""
    size = len(values)
    members = list(map(float, values))
    if total > size:
        slope, level = np.polyfit(np.arange(2, size + 1), members[1:], 1)
        members += [max(0.0, float(level + slope * m)) for m in range(size + 1, total + 1)]
    return list(accumulate(members))


def _sum_seconds(run: RunRecord, steps: Mapping[str, Sequence[float]], total: int) -> list[float] | None:
    """Seconds after each member; of those not trained by their steps. None where a member's are unknown.

    Single times depend on what else the machine did, too much for a line through two of them.
    """
    known = [m.seconds for m in run.members if m.seconds is not None]
    size = len(run.members)
    if len(known) < size:
        return None
    sums = list(accumulate(known))
    taken = [sum(steps[kind][m] for kind in KINDS) for m in range(total)]
    if total > size:
        later = taken[size - 1] - taken[0]
        pace = (sums[-1] - sums[0]) / later if later else 0.0
        sums += [sums[-1] + pace * (taken[m] - taken[size - 1]) for m in range(size, total)]
    return sums


def default_thresholds(environment: str) -> Thresholds | None:
    """SHARE_SP and SHARE_XP of the paper's XPM-WM self-play; None for an environment without dishes in the paper."""
    scores = paper.find_row(environment, paper.OWN_METHOD)
    return None if scores is None else Thresholds(round(SHARE_SP * scores.sp, 2), round(SHARE_XP * scores.sp, 2))


def judge_members(run: RunRecord, thresholds: Thresholds, held: HeldScores | None) -> list[Quality]:
    """Each member's quality and cost; without a held evaluation nobody is known to have passed."""
    together = run.settings.get("diversity.order") == "concurrent"
    found, before, simulated = [], 0, 0
    everything = sum(member.real for member in run.members)
    everything_simulated = sum(member.steps.get(str(Kind.SIMULATED), 0) for member in run.members)
    for number, member in enumerate(run.members):
        one = held.members[number] if held is not None else None
        simulated += member.steps.get(str(Kind.SIMULATED), 0)
        window = _find_window(member, thresholds)
        found.append(
            Quality(
                member=member.member,
                passed=None if one is None else _passes_thresholds(one, thresholds),
                sp=None if one is None else one.sp,
                xp=None if one is None else one.xp,
                taken=everything if together else before + member.real,
                simulated=everything_simulated if together else simulated,
                spent=member.real,
                window=None if window is None else before + window,
            )
        )
        before += member.real
    return found


def _passes_thresholds(one: HeldMember, thresholds: Thresholds) -> bool:
    return one.sp.mean >= thresholds.sp and (one.xp is None or one.xp.mean <= thresholds.xp)


def _find_window(member: MemberRecord, thresholds: Thresholds) -> int | None:
    """A member's own steps when training first showed both thresholds passed; a later member needs cross-play."""
    for point in member.curve:
        apart = member.member == 1 if point.xp is None else point.xp <= thresholds.xp
        if point.sp >= thresholds.sp and apart:
            return point.step
    return None


@dataclass(frozen=True)
class QualityCost:
    """Real steps taken in all when member M had passed.

    Attributes:
        agents: M.
        steps: with everything that the first M members build on.
        simulated: the same of simulated steps.
        reached: how many of the first M passed.
    """

    agents: int
    steps: int
    simulated: int
    reached: int

    @property
    def bound(self) -> bool:
        """Some did not pass, so that the true figure is above `steps`."""
        return self.reached < self.agents


def quality_costs(run: RunRecord, thresholds: Thresholds, held: HeldScores | None) -> list[QualityCost]:
    """After 1, 2, ..., M members of the run."""
    found = judge_members(run, thresholds, held)
    reached = accumulate(int(bool(one.passed)) for one in found)
    pairs = zip(found, reached, strict=True)
    return [QualityCost(one.member, one.taken, one.simulated, count) for one, count in pairs]


@dataclass(frozen=True)
class Budget:
    """Environment steps that a reading of the paper's baseline budget comes to, for M agents.

    Attributes:
        source: `paper`, or the run whose mean self-play steps per member were taken as the budget.
        method, environment, agents, reading: see `popgen.reports.paper_figures.baseline_budget`.
        budget: steps of one type of trajectory.
        steps: by kind.
        ratio: total over the paper's XPM-WM steps for M agents; None for `source` other than the paper.
    """

    source: str
    method: str
    environment: str
    agents: int
    reading: str
    budget: int
    steps: Mapping[str, int]
    ratio: float | None

    @property
    def total(self) -> int:
        return sum(self.steps.values())


def budgets(groups: Sequence[Group], agents: int) -> Iterator[Budget]:
    """Both readings for LIPO and CoMeDi: the paper's numbers on each environment it has, then those of our runs."""
    environments = dict.fromkeys(group.environment for group in groups)
    for environment in environments:
        ours = paper.xpm_wm_budget(environment, agents)
        for title in paper.BASELINES if ours else ():
            for reading in paper.READINGS:
                steps = paper.baseline_budget(title, agents, reading)
                ratio = sum(steps.values()) / ours if ours else None
                yield Budget("paper", name_of(title), environment, agents, reading, paper.BASELINE_STEPS, steps, ratio)
    for group in groups:
        if title_of(group.method) not in paper.BASELINES:
            continue
        for run in group.runs:
            budget = round(float(np.mean([m.steps.get(str(Kind.SP), 0) for m in run.members])))
            for reading in paper.READINGS:
                steps = paper.baseline_budget(title_of(group.method), agents, reading, budget)
                yield Budget(run.run_id, group.method, group.environment, agents, reading, budget, steps, None)


@dataclass(frozen=True)
class Band:
    """A figure against the number of agents over the seeds of a group.

    Attributes:
        agents: (K,) M.
        mean, low, high: (K,) over the runs that have the point; low and high are the least and the largest.
        measured: (K,) bool, every run has it measured.
    """

    agents: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    measured: np.ndarray

    @classmethod
    def over(cls, runs: Sequence[Sequence[tuple[int, float | None, bool]]]) -> Band:
        """From (M, value, measured) of each run; points without a value in every run are left out."""
        found: dict[int, list[tuple[float | None, bool]]] = {}
        for points in runs:
            for agents, value, measured in points:
                found.setdefault(agents, []).append((value, measured))
        whole = {m: row for m, row in found.items() if len(row) == len(runs) and all(v is not None for v, _ in row)}
        values = {m: np.array([value for value, _ in row], dtype=float) for m, row in whole.items()}
        order = sorted(whole)
        return cls(
            agents=np.array(order, dtype=int),
            mean=np.array([values[m].mean() for m in order]),
            low=np.array([values[m].min() for m in order]),
            high=np.array([values[m].max() for m in order]),
            measured=np.array([all(measured for _, measured in whole[m]) for m in order], dtype=bool),
        )


def step_band(group: Group, agents: int | None, kind: str | None = None) -> Band:
    """Environment steps against M: real ones of all kinds, or of one kind."""
    rows = []
    for run in group.runs:
        found = costs(run, agents)
        rows.append([(c.agents, c.real if kind is None else c.steps[kind], c.measured) for c in found])
    return Band.over(rows)


def time_band(group: Group, agents: int | None) -> Band:
    """Seconds of training against M."""
    return Band.over([[(c.agents, c.seconds, c.measured) for c in costs(run, agents)] for run in group.runs])


def quality_band(group: Group, thresholds: Thresholds, held: Mapping[str, HeldScores]) -> Band:
    """Real steps to equal quality against M; `measured` is False where a member did not pass (a lower bound)."""
    rows = []
    for run in group.runs:
        found = quality_costs(run, thresholds, held.get(str(run.path)))
        rows.append([(q.agents, float(q.steps), not q.bound) for q in found])
    return Band.over(rows)
