"""The whole run's estimate against runs of a known shape, by a clock that the test sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.mappo.comedi import OBJECTIVE as COMEDI
from popgen.methods.mappo.config import BaselineRun
from popgen.methods.mappo.lipo import OBJECTIVE as LIPO
from popgen.methods.mappo.objective import SELF_PLAY, Objective
from popgen.methods.mappo.train import RllibTraining
from popgen.methods.training import Phase, PlannedPhase
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.member_training import plan_phases
from popgen.pipelines.training_driver import RunEstimate


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@dataclass(frozen=True)
class Stretch:
    """A phase of a run: seconds that it took, and the shares of its total at which it began and ended."""

    name: str
    member: int
    seconds: float
    end: float = 1.0
    begin: float = 0.0


# As `scale=demo` in the cramped room went, by its run.log: the first member reached its target after 160,000
# of 344,000 steps of self-play, the second played four of five rounds at most.
DEMO = (
    Stretch("random play", 1, 1.3),
    Stretch("world model", 1, 84.0),
    Stretch("self-play", 1, 67.4, end=160 / 344),
    Stretch("imagination", 2, 240.6, end=280 / 340),
    Stretch("evaluation", 2, 20.0),
)
EVALUATION = PlannedPhase("evaluation", 2, 4.0)


def demo_plan() -> list[PlannedPhase]:
    config = RunConfig.parse(compose(["env=overcooked/cramped_room", "scale=demo"]))
    assert isinstance(config, XpmWmRun)
    return [*plan_phases(config, make_env(config.env.name, 1).spec), EVALUATION]


def estimate_after(plan: Sequence[PlannedPhase], run: Sequence[Stretch], share: float) -> tuple[float, float]:
    """(estimate, truth) of the seconds left after a share of the run's time."""
    clock, total = Clock(), sum(stretch.seconds for stretch in run)
    estimate, left = RunEstimate(plan, clock), share * total
    for stretch in run:
        estimate.begin(Phase(stretch.name, 1000.0, stretch.member, done=1000.0 * stretch.begin))
        passed = min(left, stretch.seconds)
        for step in range(1, 51):
            clock.now += passed / 50
            done = stretch.begin + (stretch.end - stretch.begin) * passed / stretch.seconds * step / 50
            estimate.update(1000.0 * done)
        left -= passed
        if left <= 0.0:
            break
    seconds = estimate.seconds_left()
    assert seconds is not None
    return seconds, total * (1.0 - share)


@pytest.mark.parametrize("share", [0.2, 0.3, 0.5, 0.7, 0.9])
def test_the_demo_is_foreseen_within_a_factor_of_one_and_a_half(share: float) -> None:
    estimate, truth = estimate_after(demo_plan(), DEMO, share)
    assert 1 / 1.5 <= estimate / truth <= 1.5


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6])
def test_a_resumed_run_counts_from_where_it_is(share: float) -> None:
    """The second member goes on after two rounds of five: 160 of 340 updates."""
    rest = (Stretch("imagination", 2, 126.6, end=280 / 340, begin=160 / 340), DEMO[-1])
    estimate, truth = estimate_after(demo_plan(), rest, share)
    assert 1 / 1.5 <= estimate / truth <= 1.5


def test_eight_members_each_as_long_as_the_one_before() -> None:
    """The plan says 10 s each, a member takes 30: half-way through the third, 5.5 are left."""
    plan = [PlannedPhase("play", member, 10.0) for member in range(1, 9)]
    run = [Stretch("play", member, 30.0) for member in range(1, 9)]
    estimate, truth = estimate_after(plan, run, 2.5 / 8)
    assert truth == 165.0 and estimate == pytest.approx(165.0)


def test_an_early_end_is_expected_again() -> None:
    """A member that ended at 40 % of its budget in 20 s: the next is to take 20 s too, not 50."""
    plan = [PlannedPhase("play", member, 50.0, earliest=0.0) for member in (1, 2)]
    estimate, _ = estimate_after(plan, [Stretch("play", 1, 20.0, end=0.4)], 1.0)
    assert estimate == pytest.approx(30.0 / 2 + 25.0), "it may still go on: to the middle; the next one to its middle"
    run = [Stretch("play", 1, 20.0, end=0.4), Stretch("play", 2, 20.0, end=0.4)]
    estimate, _ = estimate_after(plan, run, 0.5 + 1e-9)
    assert estimate == pytest.approx(0.5 * 50.0, rel=0.3)


def test_nothing_is_promised_before_something_was_measured() -> None:
    clock = Clock()
    estimate = RunEstimate(demo_plan(), clock)
    assert estimate.seconds_left() is None
    estimate.begin(Phase("random play", 100, 1))
    assert estimate.seconds_left() is None
    estimate.begin(Phase("a phase that no plan has", 100, 1))
    assert estimate.seconds_left() is None


@pytest.mark.parametrize(
    ("method", "objective", "groups"),
    [
        ("mappo", SELF_PLAY, [(1, 1), (2, 2), (3, 3)]),
        ("comedi", COMEDI, [(1, 1), (2, 2), (3, 3)]),
        ("lipo", LIPO, [(1, 3)]),
    ],
)
def test_baselines_plan_a_phase_for_each_group_of_members(
    method: str, objective: Objective, groups: list[tuple[int, int]]
) -> None:
    config = RunConfig.parse(compose(["env=overcooked/cramped_room", f"method={method}", "population.size=3"]))
    assert isinstance(config, BaselineRun)
    plan = RllibTraining(config, make_env(config.env.name, 1).spec, "run.1", objective).plan()
    assert [(phase.member, phase.last) for phase in plan] == groups
    costs = [phase.cost for phase in plan]
    assert min(costs) > 0.0 and costs == sorted(costs), "whoever meets more partners takes longer"
