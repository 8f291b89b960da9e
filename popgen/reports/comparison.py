"""Runs of several methods beside each other: cost against the number of agents, scores, and steps to equal quality.

A group is one label (a method, unless runs were given names) in one environment; its runs differ in their seeds only.
Cost after M agents is the sum over members 1..M. Beyond a run's own size it is extrapolated, kind by kind: a straight
line through the cost of members 2, 3, ... by least squares (never below 0), or the cost of member 2 where it is the
only later one; its time is that many real and simulated steps at the speed of the later members. Real steps, steps of
an exact simulator used as dynamics model, and those of evaluations are three figures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from popgen.errors import UserError
from popgen.reports import paper_figures as paper
from popgen.reports.method_titles import METHODS, name_of, title_of
from popgen.reports.run_record import REAL, MemberRecord, RunRecord, differences
from popgen.types import Kind

KINDS = (*(str(kind) for kind in REAL), str(Kind.SIMULATED))
MEASURED, LINE, CONSTANT = "measured", "line through members 2 and up", "cost of member 2 held"
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
    """Equal quality: real self-play of at least `sp` while the strongest real cross-play is at most `xp`."""

    sp: float
    xp: float


@dataclass(frozen=True)
class Quality:
    """When a member was first good enough.

    Attributes:
        member: from 1.
        steps: its own real steps until then; None where that never happened, or nothing is known of it.
        simulated: its own simulated steps until then, or in all; no part of `steps`.
        spent: its real steps in all.
        known: whether its learning curve was kept.
    """

    member: int
    steps: int | None
    simulated: int
    spent: int
    known: bool


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
        for run in members[1:]:
            _check_label(members[0], run)
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


def costs(run: RunRecord, agents: int) -> list[Cost]:
    """Cumulative cost after 1, 2, ..., max(agents, members) agents; one agent alone is not extrapolated."""
    size = len(run.members)
    total = max(agents, size) if size > 1 else size
    steps = {kind: _sum_up([m.steps.get(kind, 0) for m in run.members], total) for kind in KINDS}
    seconds, rule = _sum_seconds(run, steps, total), LINE if size > 2 else CONSTANT
    return [
        Cost(
            agents=m,
            steps={kind: steps[kind][m - 1] for kind in KINDS},
            seconds=None if seconds is None else seconds[m - 1],
            rule=MEASURED if m <= size else rule,
        )
        for m in range(1, total + 1)
    ]


def _sum_up(values: Sequence[float], total: int) -> list[float]:
    """Sums after each member, carried on to `total` members by the module's rule."""
    size = len(values)
    members = list(map(float, values))
    later = np.arange(2, size + 1)
    if size > 2:
        slope, level = np.polyfit(later, members[1:], 1)
        members += [max(0.0, float(level + slope * m)) for m in range(size + 1, total + 1)]
    elif size == 2:
        members += [members[1]] * (total - size)
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


def quality(member: MemberRecord, thresholds: Thresholds) -> Quality:
    """The first point of real play at which a member passed both thresholds.

    Where no cross-play was measured, a first member passes (it has no partner) and a later one does not.
    """
    for point in member.curve:
        apart = member.member == 1 if point.xp is None else point.xp <= thresholds.xp
        if point.sp >= thresholds.sp and apart:
            return Quality(member.member, point.step, point.simulated, member.real, True)
    simulated = member.steps.get(str(Kind.SIMULATED), 0)
    return Quality(member.member, None, simulated, member.real, bool(member.curve))


@dataclass(frozen=True)
class QualityCost:
    """Real steps until each of the first M members was good enough.

    Attributes:
        agents: M.
        steps: sum over members; those that never were count with all they took.
        simulated: the same of simulated steps.
        reached: how many were.
    """

    agents: int
    steps: int
    simulated: int
    reached: int

    @property
    def bound(self) -> bool:
        """Some never were, so that the true figure is above `steps`."""
        return self.reached < self.agents


def quality_costs(run: RunRecord, thresholds: Thresholds) -> list[QualityCost]:
    """After 1, 2, ..., M members of the run."""
    found = [quality(member, thresholds) for member in run.members]
    sums = accumulate(one.spent if one.steps is None else one.steps for one in found)
    simulated = accumulate(one.simulated for one in found)
    reached = accumulate(int(one.steps is not None) for one in found)
    rows = zip(range(1, len(found) + 1), sums, simulated, reached, strict=True)
    return [QualityCost(*row) for row in rows]


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


def step_band(group: Group, agents: int, kind: str | None = None) -> Band:
    """Environment steps against M: real ones of all kinds, or of one kind."""
    rows = []
    for run in group.runs:
        found = costs(run, agents)
        rows.append([(c.agents, c.real if kind is None else c.steps[kind], c.measured) for c in found])
    return Band.over(rows)


def time_band(group: Group, agents: int) -> Band:
    """Seconds of training against M."""
    return Band.over([[(c.agents, c.seconds, c.measured) for c in costs(run, agents)] for run in group.runs])


def quality_band(group: Group, thresholds: Thresholds) -> Band:
    """Real steps to equal quality against M; `measured` is False where a member never got there (a lower bound)."""
    rows = []
    for run in group.runs:
        rows.append([(q.agents, float(q.steps), not q.bound) for q in quality_costs(run, thresholds)])
    return Band.over(rows)
