"""The one driver of all methods: it goes through the members and does what a training loop's records ask for.

The loop says what happened; here it is written down: steps to the ledger, figures to the metrics, segments to the
checkpoint's log, progress to the screen, checkpoints where they are due.

The time that the whole run still takes is told from expected costs of its phases, corrected by what they took:

    seconds of a phase = speed of the phase * its cost by kind of work, each times the seconds that a cost of 1 takes

Both factors are measured. Where nothing is, they are those of the recipe (1) or of the work so far, which count as so
many seconds of measurement; so the first seconds, in which code is compiled and buffers are filled, promise nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.training import (
    Checkpoint,
    Phase,
    PlannedPhase,
    Progress,
    Record,
    Round,
    State,
    TrainedMember,
    Training,
    Work,
)
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.runs.checkpoints import CheckpointFiles, fitting, member_folder, resolve_handles
from popgen.runs.recorder import RunRecorder
from popgen.runs.recovery import wait_for_room

PRIOR_SECONDS, KIND_SECONDS, PHASE_SECONDS = 20.0, 5.0, 5.0
"""What was not measured counts as a measurement of so many seconds: the recipe for all work, all work for a kind of it,
the kinds of a phase's work for the phase."""
LEAST_SECONDS = 2.0
"""A run promises nothing before."""


@dataclass(frozen=True)
class Part:
    """Part of a phase: shares of its total at which it begins and ends."""

    first: float = 0.0
    last: float = 1.0

    def share_after(self, begin: float) -> float:
        """The share of work that is done in it and goes on evenly from `begin` to the phase's full length."""
        if begin >= 1.0:
            return 0.0
        return (max(begin, self.last) - max(begin, self.first)) / (1.0 - begin)


WHOLE = Part()


@dataclass
class Spent:
    """Seconds that work took, and those that it was to cost."""

    seconds: float = 0.0
    cost: float = 0.0

    def add(self, seconds: float, cost: float) -> None:
        """More of it."""
        self.seconds += seconds
        self.cost += cost

    def rate(self, prior: float, weight: float) -> float:
        """Seconds for a cost of 1, `prior` counting as a cost of `weight`."""
        return (self.seconds + weight * prior) / (self.cost + weight)


def seconds_alone(work: Work) -> float:
    """Seconds that work takes where nothing else wants its core: side by side it waits for the others now and then."""
    return min(work.seconds, work.cpu_seconds) if work.cpu_seconds > 0.0 else work.seconds


@dataclass
class SpentByKind:
    """Seconds that phases of one name took, and what they were to cost by kind of work."""

    seconds: float = 0.0
    costs: dict[str, float] = field(default_factory=dict)

    def add(self, seconds: float, costs: Mapping[str, float]) -> None:
        """More of it."""
        self.seconds += seconds
        self.costs = {kind: self.costs.get(kind, 0.0) + cost for kind, cost in costs.items()}


@dataclass
class Measured:
    """What a run's work has shown.

    Attributes:
        work: all of it.
        kinds: work of one kind.
        phases: phases of one name.
        ends: shares of the total at which phases of a name were over.
    """

    work: Spent = field(default_factory=Spent)
    kinds: dict[str, Spent] = field(default_factory=dict)
    phases: dict[str, SpentByKind] = field(default_factory=dict)
    ends: dict[str, list[float]] = field(default_factory=dict)

    def add(self, phase: PlannedPhase, part: Part, seconds: float, work: Mapping[str, Work]) -> None:
        """Part of a phase took so many seconds; `work` by kind, as far as it is known."""
        costs = costs_of(phase, part)
        known = {kind: seconds_alone(work[kind]) for kind in costs if kind in work}
        known |= dict.fromkeys(costs, seconds) if len(costs) == 1 else {}
        self.work.add(seconds, join_kinds(phase, costs))
        for kind, spent in known.items():
            self.kinds.setdefault(kind, Spent()).add(spent, costs[kind])
        self.phases.setdefault(phase.name, SpentByKind()).add(seconds, costs)

    def predict_phase(self, phase: PlannedPhase, part: Part) -> float:
        """Seconds that this part of it takes."""
        past = self.phases.get(phase.name, SpentByKind())
        common = self.work.rate(1.0, PRIOR_SECONDS)
        costs = costs_of(phase, part)
        rates = {kind: self.kinds.get(kind, Spent()).rate(common, KIND_SECONDS) for kind in costs}
        expected = join_kinds(phase, {kind: past.costs.get(kind, 0.0) * rate for kind, rate in rates.items()})
        correction = Spent(past.seconds, expected).rate(1.0, PHASE_SECONDS)
        return correction * join_kinds(phase, {kind: costs[kind] * rate for kind, rate in rates.items()})

    def expect_end(self, phase: PlannedPhase, share: float = 0.0) -> float:
        """The share of its total at which it will be over, now at `share`: in the middle of where it still may be, and
        where those before it were."""
        guesses = [(max(share, phase.earliest) + 1.0) / 2.0]
        guesses += [end for end in self.ends.get(phase.name, []) if end > share]
        return sum(guesses) / len(guesses)


def costs_of(phase: PlannedPhase, part: Part = WHOLE) -> dict[str, float]:
    """The cost of a part of it by kind of work; a phase that names no kinds is one of its own."""
    costs = {phase.name: phase.cost} if isinstance(phase.cost, (int, float)) else dict(phase.cost)
    return {kind: cost * part.share_after(phase.begins.get(kind, 0.0)) for kind, cost in costs.items()}


def join_kinds(phase: PlannedPhase, parts: Mapping[str, float]) -> float:
    """Seconds of all its kinds of work together."""
    return max(parts.values()) if phase.side_by_side else sum(parts.values())


class RunEstimate:
    """What is left of a run's plan.

    Args:
        plan: the phases in order.
        clock: seconds, monotonic.
    """

    def __init__(self, plan: Sequence[PlannedPhase], clock: Callable[[], float] = time.monotonic) -> None:
        self.plan, self.clock = list(plan), clock
        self._past = Measured()
        self._running: PlannedPhase | None = None
        self._total, self._first, self._share, self._began, self._heard = 1.0, 0.0, 0.0, 0.0, 0.0
        self._end: float | None = None
        self._work: Mapping[str, Work] = {}

    def begin(self, phase: Phase) -> None:
        """A phase begins: those before it are over. One that the plan does not know takes no time in it."""
        self._end_running()
        places = [i for i, one in enumerate(self.plan) if (one.name, one.member) == (phase.name, phase.member)]
        if places:
            self._running, self.plan = self.plan[places[0]], self.plan[places[0] + 1 :]
            self._total, self._began, self._work = phase.total or 1.0, self.clock(), {}
            self._heard = self._began
            self._first = self._share = min(1.0, phase.done / self._total)
            self._end = self._share_at(phase.ends_at)

    def update(self, done: float, *, ends_at: float | None = None, work: Mapping[str, Work] | None = None) -> None:
        """So much of the running phase's total is done; `ends_at`: where it will end as things stand; `work`, by kind,
        since it began, where that is known."""
        self._share, self._heard = min(1.0, done / self._total), self.clock()
        self._end = self._share_at(ends_at)
        self._work = work or self._work

    def _share_at(self, ends_at: float | None) -> float | None:
        return None if ends_at is None else max(self._share, min(1.0, ends_at / self._total))

    def seconds_left(self) -> float | None:
        """Of the whole run, None as long as nothing was measured."""
        now = self._measure_work()
        if now.work.seconds < LEAST_SECONDS or now.work.cost <= 0.0:
            return None
        left = sum(now.predict_phase(phase, Part(0.0, now.expect_end(phase))) for phase in self.plan)
        if (running := self._running) is not None:
            end = now.expect_end(running, self._share) if self._end is None else self._end
            rest = now.predict_phase(running, Part(self._share, end))
            left += max(0.0, rest - (self.clock() - self._heard))
        return left

    def to_state(self) -> State:
        """For a checkpoint: what was measured."""
        now = self._measure_work()
        return {
            "work": vars(now.work),
            "kinds": {kind: vars(spent) for kind, spent in now.kinds.items()},
            "phases": {name: vars(spent) for name, spent in now.phases.items()},
            "ends": now.ends,
        }

    def load_state(self, state: State) -> None:
        """Go on from `to_state()`, as it was read: half as sure, since this may be another machine."""
        past = Measured(ends={name: [float(end) for end in values] for name, values in state["ends"].items()})
        past.work = _halve_spent(state["work"])
        past.kinds = {kind: _halve_spent(spent) for kind, spent in state["kinds"].items()}
        for name, spent in state["phases"].items():
            costs = {kind: float(cost) / 2.0 for kind, cost in spent["costs"].items()}
            past.phases[name] = SpentByKind(float(spent["seconds"]) / 2.0, costs)
        self._past = past

    def _measure_work(self) -> Measured:
        """What was measured, the running phase included."""
        now = deepcopy(self._past)
        if self._running is not None and self._share > self._first:
            now.add(self._running, Part(self._first, self._share), self._heard - self._began, self._work)
        return now

    def _end_running(self) -> None:
        if self._running is not None and self._share > self._first:
            self._heard = self.clock()  # what followed the last update was of the phase too
            self._past = self._measure_work()
            self._past.ends.setdefault(self._running.name, []).append(self._share)
        self._running = None


def _halve_spent(spent: Mapping[str, float]) -> Spent:
    return Spent(float(spent["seconds"]) / 2.0, float(spent["cost"]) / 2.0)


EVALUATION, REPORT_SECONDS, EVALUATED_SECONDS = "evaluation", 4.0, 4e-5
"""Its name, and what takes how long on a laptop's core: figures and pages, and each environment step."""


def plan_evaluation(config: RunConfig, spec: EnvSpec) -> PlannedPhase:
    """Cross-play of all pairs, each member beside two simple partners, mixed play, and the report."""
    size, episodes = config.population.size, config.evaluation.episodes
    mixed = size + 4 * size * (size - 1) if size > 1 else 0
    played = episodes * (size**2 + 4 * size) + (episodes + 1) // 2 * mixed
    return PlannedPhase(EVALUATION, size, REPORT_SECONDS + played * spec.horizon * EVALUATED_SECONDS)


def title_of_phase(phase: Phase, size: int) -> str:
    """A phase as the user reads it, beside the number of members."""
    whom = f"members {phase.member} to {phase.last}" if phase.last > phase.member else f"member {phase.member}"
    return f"{whom} of {size}: {phase.name}"


class TrainingDriver:
    """Trains every member that the recorder's population does not hold yet.

    An interrupted run is resumed by the same call of a new driver with a new recorder on the same folder: in another
    process, or in this one after an actor or a node died.
    """

    def __init__(
        self,
        config: RunConfig,
        recorder: RunRecorder,
        reporter: Reporter,
        training: Training,
        checkpoints: CheckpointFiles,
    ) -> None:
        self.config, self.recorder, self.reporter = config, recorder, reporter
        self.training, self.checkpoints = training, checkpoints
        self.running: tuple[int, ...] = ()
        self.estimate = RunEstimate([*training.plan(), plan_evaluation(config, recorder.spec)])

    def train_members(self) -> None:
        """All members that are missing.

        Raises:
            FloatingPointError: training diverged.
            UserError: a checkpoint to continue from is damaged.
        """
        first, base, checkpoint = self._resume()
        while first <= self.config.population.size:
            if checkpoint is None:
                self.checkpoints.begin(base)
            if self.training.begins_workers:
                wait_for_room(self.config, self.reporter.note)  # RLlib would wait for ever
            self.running = self.training.begin(self.training.first_of_group(first))
            if checkpoint is not None:
                with fitting(self.checkpoints.folder):
                    self.training.restore(checkpoint)
            self._train()
            first, checkpoint = self.running[-1] + 1, None
            base = member_folder(self.recorder.dir, first - 1)

    def _train(self) -> None:
        """One run of the loop, to the last of the members that learn together."""
        loop = self.training.train()
        wants_checkpoint: bool | None = None
        try:
            while True:
                wants_checkpoint = self.take_in(loop.send(wants_checkpoint))
        except StopIteration:
            return
        finally:
            loop.close()

    # ---- records ---------------------------------------------------------------------------------------------------

    def take_in(self, record: Record) -> bool:
        """Do what a record asks for; whether the loop should come to rest for a checkpoint."""
        if isinstance(record, TrainedMember):
            self._add_member(record)
            return False
        if not isinstance(record, Progress):
            self._begin_phase(record)
            return False
        self._record_steps(record)
        self._record_figures(record)
        if record.note:
            self.reporter.note(record.note)
        if record.done is not None:
            work = record.work if isinstance(record, Round) else {}
            self.estimate.update(record.done, ends_at=record.ends_at, work=work)
            self.reporter.expect(self.estimate.seconds_left())
            self.reporter.update(record.done, **record.shown)
        return isinstance(record, Round) and self._save_if_due(record)

    def _begin_phase(self, phase: Phase) -> None:
        """One that goes on where an earlier attempt was says so at once, and not after its next round."""
        self.estimate.begin(phase)
        self.reporter.phase(title_of_phase(phase, self.config.population.size), phase.total)
        if phase.done:
            self.reporter.expect(self.estimate.seconds_left())
            self.reporter.update(phase.done)

    def _record_steps(self, record: Progress) -> None:
        for sampled in record.sampled:
            if sampled.segments:
                self.checkpoints.append(sampled.segments, record.member)
            self.recorder.record_sampling(record.member, sampled.collected)
        for count in record.counted:
            self.recorder.record_step_count(count)

    def _record_figures(self, record: Progress) -> None:
        """A point of metrics.

        Raises:
            FloatingPointError: a learner's figure is not finite: it will not recover.
        """
        if not record.figures:
            return
        self.recorder.record_metrics(record.member, record.steps, **record.figures)
        for name, value in record.figures.items():
            if name.partition("/")[0] in self.training.learners and not math.isfinite(value):
                place = f"member {record.member} is {value} after {record.steps:,} steps"
                raise FloatingPointError(f"{name} of {place}")

    def _save_if_due(self, record: Round) -> bool:
        due = record.must_save or self.checkpoints.due()
        if not due or not record.at_rest:
            return due
        state = {**self.training.checkpoint(), **self._own_state()}
        buffers = self.training.buffers() if self.checkpoints.log_is_long else None
        self.checkpoints.save(self.running[0], state, buffers)
        self.recorder.record_checkpoint(record.member, record.number)
        return False

    def _add_member(self, trained: TrainedMember) -> None:
        """Keep what the member leaves behind, then add it to the population, unless an earlier attempt did."""
        recorder = self.recorder
        if trained.member <= len(recorder.population):
            return
        self.checkpoints.save_member(trained.member, {**trained.left, **self._own_state()})
        recorder.add_member(trained.policy, trained.training, seed=trained.seed, extra=trained.extra)
        if trained.note:
            self.reporter.note(trained.note)

    def _own_state(self) -> State:
        return {"ledger": len(self.recorder.ledger), "estimate": self.estimate.to_state()}

    # ---- resuming --------------------------------------------------------------------------------------------------

    def _resume(self) -> tuple[int, Path | None, Checkpoint | None]:
        """Take over finished members of this run, or of the run that this one continues.

        Returns:
            The first member to train; the folder of what the one before it left; its last checkpoint, if there is one.
        """
        present, origin = len(self.recorder.population), self.config.population
        if origin.init_from and present <= origin.init_members:
            root, finished = Path(origin.init_from), origin.init_members
        else:
            root, finished = self.recorder.dir, present
        checkpoint = None
        if finished < origin.size:
            checkpoint = self.checkpoints.load(self.training.first_of_group(finished + 1))
            if note := self.checkpoints.note():
                self.reporter.note(note)
        left = self.checkpoints.load_member(root, finished) if finished else {}
        self._rewind_ledger(checkpoint, left if root == self.recorder.dir else {})
        state = left if checkpoint is None else checkpoint.state
        if "estimate" in state:  # one of an earlier version has none
            with fitting(self.checkpoints.folder):
                self.estimate.load_state(resolve_handles(state["estimate"]))
        if not finished:
            return 1, None, checkpoint
        self._adopt_members(root, finished, present, left)
        return finished + 1, member_folder(root, finished), checkpoint

    def _rewind_ledger(self, checkpoint: Checkpoint | None, left: State) -> None:
        state = left if checkpoint is None else checkpoint.state
        self.recorder.rewind_ledger(state.get("ledger", 0), self.reporter.note)

    def _adopt_members(self, root: Path, finished: int, present: int, left: State) -> None:
        source = load_population(root / "population")
        weights = {member: source[member].weights() for member in range(1, finished + 1)}
        for member in range(present + 1, finished + 1):
            self.recorder.adopt_member(source[member], source.info(member), source.training(member))
        with fitting(member_folder(root, finished)):
            self.training.adopt(weights, left)
        self.reporter.note(f"continuing after member {finished} of {root}")
