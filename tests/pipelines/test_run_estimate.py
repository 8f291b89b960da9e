"""The whole run's estimate against runs of a known shape, by a clock that the test sets."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.mappo.comedi import OBJECTIVE as COMEDI
from popgen.methods.mappo.config import BaselineRun, FcpRun
from popgen.methods.mappo.fcp import FcpTraining
from popgen.methods.mappo.lipo import OBJECTIVE as LIPO
from popgen.methods.mappo.objective import SELF_PLAY, Objective
from popgen.methods.mappo.train import RllibTraining
from popgen.methods.training import Phase, PlannedPhase, State, Work
from popgen.methods.xpm_wm.config import FcpWmRun, XpmWmRun
from popgen.methods.xpm_wm.member_training import FIT_SECONDS, plan_phases
from popgen.methods.xpm_wm.skilled_training import FcpWmTraining
from popgen.pipelines import training_driver
from popgen.pipelines.population import run_population
from popgen.pipelines.training_driver import RunEstimate, costs_of, plan_evaluation
from popgen.progress import NullReporter
from popgen.runs.checkpoints import CheckpointFiles, resolve_handles

pytestmark = pytest.mark.usefixtures("quick_pictures")


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


@cache
def demo_plan(transport: str = "ray") -> list[PlannedPhase]:
    words = ["env=overcooked/cramped_room", "scale=demo", "phase2.partner_fits=0"]  # recorded before there were fits
    config = RunConfig.parse(compose([*words, f"run.transport={transport}"]))
    assert isinstance(config, XpmWmRun)
    spec = make_env(config.env.name, 1).spec
    return [*plan_phases(config, spec), plan_evaluation(config, spec)]


@dataclass(frozen=True)
class GoodBy:
    """So much is done of a phase that will end at `ends_at` as things stand."""

    done: float
    ends_at: float


Recorded = list[tuple[float, Phase | GoodBy | float, dict[str, Work]]]

# `scale=demo` in the cramped room as the driver's records told it: seconds since the first phase, what is done of the
# phase, and the model's and the agent's work where a round ended. In one process (run.transport=inline), in processor
# seconds:
INLINE: Recorded = [
    (0.0, Phase("random play", 256_000, 1), {}),
    (3.5, 102_400, {}),
    (3.8, Phase("world model", 1500, 1), {}),
    (32.2, 400, {}),
    (62.7, 800, {}),
    (90.6, 1200, {}),
    (112.2, Phase("self-play", 344_000, 1), {}),
    (128.2, 25_600, {"model": Work(4, 6.7), "agent": Work(4, 7.7)}),
    (144.7, 51_200, {"model": Work(8, 13.9), "agent": Work(8, 15.2)}),
    (162.6, 76_800, {"model": Work(12, 21.4), "agent": Work(12, 23.7)}),
    (179.7, 102_400, {"model": Work(16, 28.7), "agent": Work(16, 31.6)}),
    (186.2, Phase("imagination", 340, 2), {}),
    (217.2, 50, {}),
    (250.7, 100, {}),
    (303.2, 150, {}),
    (309.3, 160, {}),
    (309.4, GoodBy(160, 280), {}),
    (361.7, GoodBy(210, 280), {}),
    (368.1, GoodBy(220, 280), {}),
]
INLINE_END = 445.3
# and by its actors side by side on two cores, where an update of the agent waits a third of its time for the others:
ACTORS: Recorded = [
    (0.0, Phase("random play", 256_000, 1), {}),
    (1.4, 256_000, {}),
    (1.4, Phase("world model", 1500, 1), {}),
    (22.0, 400, {}),
    (46.0, 900, {}),
    (65.4, 1300, {}),
    (75.9, Phase("self-play", 344_000, 1), {}),
    (78.6, 6_400, {"model": Work(1, 2.1, 1.5), "agent": Work(1, 1.3, 0.9)}),
    (88.8, 32_000, {"model": Work(5, 11.5, 8.1), "agent": Work(5, 6.7, 4.4)}),
    (100.8, 64_000, {"model": Work(10, 22.8, 15.9), "agent": Work(10, 13.7, 9.1)}),
    (113.1, 96_000, {"model": Work(15, 34.2, 24.0), "agent": Work(15, 20.4, 13.6)}),
    (130.4, 140_800, {"model": Work(22, 50.3, 35.3), "agent": Work(22, 30.0, 20.0)}),
    (131.8, Phase("imagination", 340, 2), {}),
    (147.3, 50, {}),
    (161.6, 100, {}),
    (192.0, 150, {}),
    (194.8, 160, {}),
    (195.0, GoodBy(160, 280), {}),
    (225.4, GoodBy(210, 280), {}),
    (228.7, GoodBy(220, 280), {}),
    (228.9, GoodBy(220, 280), {}),
    (260.1, GoodBy(270, 280), {}),
    (263.3, GoodBy(280, 280), {}),
]
ACTORS_END = 269.0


def make_clocked(plan: Sequence[PlannedPhase]) -> tuple[RunEstimate, Clock]:
    clock = Clock()
    return RunEstimate(plan, clock), clock


def replay(
    estimate: RunEstimate, clock: Clock, recorded: Recorded, end: float, begin: float = 0.0, until: float = math.inf
) -> list[tuple[float, float]]:
    """(estimate, truth) at each record from `begin` to `until`, and every five seconds to the evaluation."""
    found, start, rows = list[tuple[float, float]](), clock.now, [row for row in recorded if begin <= row[0] <= until]
    for (seconds, done, work), (following, *_) in zip(
        rows, [*rows[1:], (min(until, end - 20.0), None, None)], strict=True
    ):
        clock.now = start + seconds - begin
        if isinstance(done, Phase):
            estimate.begin(done)
        elif isinstance(done, GoodBy):
            estimate.update(done.done, ends_at=done.ends_at, work=work)
        else:
            estimate.update(done, work=work)
        for now in [seconds, *np.arange(seconds + 5.0, following, 5.0)]:
            clock.now = start + now - begin
            if (left := estimate.seconds_left()) is not None:
                found.append((left, end - now))
    return found


def is_close(estimate: float, truth: float) -> bool:
    """Within a factor of 1.5, or less than the screen's ten seconds apart."""
    return 1 / 1.5 <= estimate / truth <= 1.5 or abs(estimate - truth) < 5.0


@pytest.mark.parametrize(
    ("transport", "recorded", "end"), [("inline", INLINE, INLINE_END), ("ray", ACTORS, ACTORS_END)]
)
def test_a_recorded_demo_is_foreseen_within_a_factor_of_one_and_a_half(
    transport: str, recorded: Recorded, end: float
) -> None:
    """From its first seconds to its last round, which decides whether a further one follows."""
    estimate, clock = make_clocked(demo_plan(transport))
    found = replay(estimate, clock, recorded, end)
    assert len(found) > 40 and all(is_close(*pair) for pair in found), found


@pytest.mark.parametrize(
    ("transport", "recorded", "end", "killed"),
    [("inline", INLINE, INLINE_END, 309.3), ("ray", ACTORS, ACTORS_END, 194.8)],
)
def test_a_recorded_demo_that_goes_on_knows_its_speed(
    transport: str, recorded: Recorded, end: float, killed: float
) -> None:
    """It was killed after two rounds of its second member."""
    before, clock = make_clocked(demo_plan(transport))
    replay(before, clock, recorded, end, until=killed)
    after, clock = make_clocked(demo_plan(transport))
    after.load_state(json.loads(json.dumps(before.to_state())))
    after.begin(Phase("imagination", 340, 2, done=160, ends_at=280))
    found = replay(after, clock, recorded, end, begin=killed + 0.3)
    assert len(found) > 5 and all(is_close(*pair) for pair in found), found


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


def test_eight_members_each_as_long_as_the_one_before() -> None:
    """The plan says 10 s each, a member takes 30: half-way through the third, 5.5 are left."""
    plan = [PlannedPhase("play", member, 10.0) for member in range(1, 9)]
    run = [Stretch("play", member, 30.0) for member in range(1, 9)]
    estimate, truth = estimate_after(plan, run, 2.5 / 8)
    assert truth == 165.0 and estimate == pytest.approx(165.0, rel=0.02)


def test_early_ends_are_expected_again() -> None:
    """Members that ended at 40 % of their budget of 50 s: the next is to end between there and the middle."""
    plan = [PlannedPhase("play", member, 50.0, earliest=0.0) for member in range(1, 5)]
    run = [Stretch("play", member, 20.0, end=0.4) for member in range(1, 5)]
    estimate, truth = estimate_after(plan, run[:1], 1.0)
    assert estimate == pytest.approx(15.0 + 3 * 25.0), "nothing has ended: to the middle of what is left, and of each"
    estimate, truth = estimate_after(plan, run, 0.75)
    assert truth == 20.0 and estimate == pytest.approx(15.0 + 50.0 * (0.5 + 0.4 + 0.4) / 3), "the fourth is expected"


def spend(estimate: RunEstimate, clock: Clock, seconds: float, done: float, **more: Any) -> float:
    """Seconds left after more work; sure of the rates, so that what is measured counts alone."""
    clock.now += seconds
    estimate.update(done, **more)
    left = estimate.seconds_left()
    assert left is not None
    return left


@pytest.fixture
def certain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements count alone."""
    for name in ("PRIOR_SECONDS", "KIND_SECONDS", "PHASE_SECONDS"):
        monkeypatch.setattr(training_driver, name, 1e-9)


@pytest.mark.usefixtures("certain")
def test_kinds_of_work_are_timed_where_they_first_occur() -> None:
    """Phase "both" gives seconds by kind: the model's work takes 3 s for a cost of 1, the agent's 1; what follows is of
    the agent alone, then of both in turn."""
    later = [PlannedPhase("agent alone", 2, {"agent": 40.0}), PlannedPhase("turns", 3, {"agent": 10.0, "model": 10.0})]
    estimate, clock = make_clocked([PlannedPhase("both", 1, {"agent": 20.0, "model": 20.0}), *later])
    estimate.begin(Phase("both", 100, 1))
    left = spend(estimate, clock, 40.0, 50, work={"agent": Work(1, 10.0), "model": Work(1, 30.0)})
    assert left == pytest.approx(40.0 + 40.0 + 40.0)


@pytest.mark.usefixtures("certain")
def test_side_by_side_the_longest_kind_counts() -> None:
    """The same work on two cores: 30 s for the first half, as long as the model takes."""
    both = PlannedPhase("both", 1, {"agent": 20.0, "model": 20.0}, side_by_side=True)
    estimate, clock = make_clocked([both, PlannedPhase("agent alone", 2, {"agent": 40.0})])
    estimate.begin(Phase("both", 100, 1))
    left = spend(estimate, clock, 30.0, 50, work={"agent": Work(1, 10.0), "model": Work(1, 30.0)})
    assert left == pytest.approx(30.0 + 40.0)


@pytest.mark.usefixtures("certain")
def test_a_kind_that_begins_later_is_not_in_what_was_done() -> None:
    """The model learns in the second half alone: 10 s for the first, 40 for what follows, of which it takes 30."""
    known = PlannedPhase("model", 1, {"model": 30.0})
    estimate, clock = make_clocked(
        [known, PlannedPhase("turns", 2, {"agent": 20.0, "model": 30.0}, begins={"model": 0.5})]
    )
    estimate.begin(Phase("model", 100, 1))
    spend(estimate, clock, 30.0, 100)
    estimate.begin(Phase("turns", 100, 2))
    assert spend(estimate, clock, 10.0, 50) == pytest.approx(40.0)
    assert spend(estimate, clock, 20.0, 75) == pytest.approx(20.0)


@pytest.mark.usefixtures("certain")
def test_what_waited_for_a_core_is_not_of_the_work() -> None:
    """Side by side the agent's 10 s took 15: alone it is foreseen by its processor seconds."""
    both = PlannedPhase("both", 1, {"agent": 20.0, "model": 20.0}, side_by_side=True)
    estimate, clock = make_clocked([both, PlannedPhase("agent alone", 2, {"agent": 40.0})])
    estimate.begin(Phase("both", 100, 1))
    left = spend(estimate, clock, 15.0, 50, work={"agent": Work(1, 15.0, 10.0), "model": Work(1, 12.0, 8.0)})
    assert left == pytest.approx(15.0 + 40.0)


@pytest.mark.usefixtures("certain")
def test_what_kinds_do_not_explain_is_of_the_phase() -> None:
    """A phase that waits takes 20 s where its work takes 10; so does the next of its name, and no other."""
    plan = [PlannedPhase("waits", 1, {"agent": 10.0}), PlannedPhase("waits", 2, {"agent": 10.0, "model": 10.0})]
    estimate, clock = make_clocked([PlannedPhase("model", 1, {"model": 10.0}), *plan])
    estimate.begin(Phase("model", 100, 1))
    assert spend(estimate, clock, 10.0, 100) == pytest.approx(30.0)
    estimate.begin(Phase("waits", 100, 1))
    assert spend(estimate, clock, 20.0, 100) == pytest.approx(30.0), "20 s of the agent's work, 10 of the model's"


@pytest.mark.usefixtures("certain")
def test_an_end_that_is_known_is_taken() -> None:
    estimate, clock = make_clocked([PlannedPhase("play", 1, 100.0, earliest=0.6)])
    estimate.begin(Phase("play", 100, 1))
    assert spend(estimate, clock, 40.0, 40) == pytest.approx(40.0), "to the middle of where it may end"
    assert spend(estimate, clock, 10.0, 50, ends_at=60) == pytest.approx(10.0)


def test_the_first_seconds_promise_no_hours() -> None:
    """9 s for what was to take 0.13, while code is compiled: a run of 5 minutes is told as less than 15."""
    estimate, clock = make_clocked(demo_plan())
    estimate.begin(Phase("random play", 256_000, 1))
    assert 200.0 < spend(estimate, clock, 9.0, 25_600) < 900.0


def test_another_attempt_goes_on_with_what_was_measured() -> None:
    """Also through a checkpoint's file: a member that takes 30 s in place of 10, known from the first second on."""
    plan = [PlannedPhase("play", member, 10.0) for member in range(1, 9)]
    estimate, clock = make_clocked(plan)
    for member in (1, 2, 3, 4):
        estimate.begin(Phase("play", 100, member))
        spend(estimate, clock, 30.0, 100)
    again, later = make_clocked(plan)
    again.load_state(json.loads(json.dumps(estimate.to_state())))
    again.begin(Phase("play", 100, 5))
    assert spend(again, later, 3.0, 10) == pytest.approx(3.9 * 30.0, rel=0.1)


class Screen(NullReporter):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[tuple[Any, ...]] = []

    def phase(self, name: str, total: float) -> None:
        self.lines.append((name, total))

    def expect(self, seconds: float | None) -> None:
        self.lines.append(("left", seconds))

    def update(self, done: float, **figures: Any) -> None:
        self.lines.append(("done", done))


def test_a_phase_that_goes_on_says_so_at_once() -> None:
    """With 44 % done, and the time left as the earlier attempt knew it: 10 s for 100, of which 56 are left."""
    config = RunConfig.parse(compose(["env=overcooked/cramped_room", "scale=demo"]))
    spec, screen = make_env(config.env.name, 1).spec, Screen()
    known: State = {"seconds": 40.0, "cost": 40.0}
    phases = {"self-play": {"seconds": 40.0, "costs": {"self-play": 40.0}}}
    training: Any = SimpleNamespace(plan=lambda: [PlannedPhase("self-play", 1, 10.0)])
    recorder: Any = SimpleNamespace(spec=spec)
    driver = training_driver.TrainingDriver(config, recorder, screen, training, SimpleNamespace())  # type: ignore[arg-type]
    driver.estimate.plan = driver.estimate.plan[:1]
    driver.estimate.load_state({"work": known, "kinds": {"self-play": known}, "phases": phases, "ends": {}})
    driver.take_in(Phase("self-play", 100, 1, done=44, ends_at=100))
    name, left, done = screen.lines
    assert name == ("member 1 of 2: self-play", 100) and done == ("done", 44)
    assert left[0] == "left" and left[1] == pytest.approx(5.6, rel=0.01)
    driver.take_in(Phase("self-play", 100, 2))
    assert screen.lines[3:] == [("member 2 of 2: self-play", 100)], "a fresh phase waits for its first update"


@pytest.mark.end_to_end
def test_a_run_goes_on_after_a_finished_member_with_what_was_measured(tmp_path: Path) -> None:
    """Trained in this process to its end, then the same command: the estimate comes from what the member left."""
    words = ["method=xpm_sim", "env=rendezvous/mppmr", "scale=smoke", "population.size=1", "evaluation.episodes=1"]
    words += ["run.transport=inline", "tracking=off", "run.id=r", f"run.root={tmp_path}", "xpm_sim.updates=2"]
    for _ in range(2):
        run_population(RunConfig.parse(compose(words)), reporter=NullReporter())
    left = CheckpointFiles(tmp_path / "r", long=1, seconds=0.0).load_member(tmp_path / "r", 1)
    estimate, _ = make_clocked([])
    estimate.load_state(resolve_handles(left["estimate"]))
    assert estimate.to_state()["kinds"]["simulated play"]["seconds"] > 0.0


@pytest.mark.parametrize(
    "damage", [{"work": 3}, {"kinds": {"a": {}}}, {"phases": {"a": {"seconds": 1}}}, {"ends": [1]}]
)
def test_a_damaged_state_does_not_fit(damage: State) -> None:
    whole = {"work": {"seconds": 1.0, "cost": 1.0}, "kinds": {}, "phases": {}, "ends": {}}
    estimate, _ = make_clocked([])
    estimate.load_state(whole)
    with pytest.raises((LookupError, TypeError, ValueError, AttributeError)):
        estimate.load_state(whole | damage)


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
    costs = [sum(costs_of(phase).values()) for phase in plan]
    assert min(costs) > 0.0 and costs == sorted(costs), "whoever meets more partners takes longer"


def test_a_seed_of_several_members_is_planned_once() -> None:
    """Of the three members that a seed gives, the final one alone is trained: its number is that of the phase."""
    words = ["env=overcooked/cramped_room", "scale=smoke"]
    free = RunConfig.parse(compose([*words, "method=fcp", "population.size=6"]))
    imagined = RunConfig.parse(compose([*words, "method=fcp_wm", "population.size=7"]))
    assert isinstance(free, FcpRun) and isinstance(imagined, FcpWmRun)
    spec = make_env(free.env.name, 1).spec
    assert [phase.member for phase in FcpTraining(free, spec, "run.1").plan()] == [3, 6]
    plan = FcpWmTraining(imagined, spec, cast(Any, None)).plan()
    assert [(phase.name, phase.member) for phase in plan] == [
        *((name, 1) for name in ("random play", "world model", "self-play")),
        *(("imagination", final) for final in (4, 7)),
    ]


def test_fits_of_partners_are_part_of_what_a_member_takes() -> None:
    """100 steps on 512 states in 2 seats, for each of 2 partners, in each of at most 4 rounds; none where nobody is
    met."""
    words = ["env=overcooked/cramped_room", "scale=smoke", "population.size=3", "phase2.rounds=4"]

    def agents_cost(fits: int, *more: str) -> float:
        config = RunConfig.parse(compose([*words, f"phase2.partner_fits={fits}", *more]))
        assert isinstance(config, XpmWmRun | FcpWmRun)
        return costs_of(plan_phases(config, make_env(config.env.name, 1).spec)[-1])["agent"]

    assert agents_cost(100) - agents_cost(0) == pytest.approx(4 * 2 * 100 * 512 * 2 * FIT_SECONDS)
    alone = ("agent.lambda_xp=0", "phase2.episodes_xp=0")
    assert agents_cost(100, *alone) == agents_cost(0, *alone)
