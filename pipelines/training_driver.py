"""The one driver of all methods: it goes through the members and does what a training loop's records ask for.

The loop says what happened; here it is written down: steps to the ledger, figures to the metrics, segments to the
checkpoint's log, progress to the screen, checkpoints where they are due.

The time that the whole run still takes is estimated from expected costs of its phases, corrected by what they took.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from popgen.config.run_config import RunConfig
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
)
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.runs.checkpoints import CheckpointFiles, fitting, member_folder
from popgen.runs.recorder import RunRecorder
from popgen.runs.recovery import wait_for_room

LEAST_SECONDS, LEAST_SHARE = 2.0, 0.01
"""The running phase is judged by its own speed once so much time and so much of its total has passed."""


@dataclass
class Spent:
    """Seconds that work took, for which cost of the plan."""

    seconds: float = 0.0
    cost: float = 0.0

    def add(self, seconds: float, cost: float) -> None:
        """More of it."""
        self.seconds += seconds
        self.cost += cost

    @property
    def rate(self) -> float | None:
        """Seconds for a cost of 1."""
        return self.seconds / self.cost if self.cost > 0.0 else None


class RunEstimate:
    """What is left of a run's plan.

    Args:
        plan: the phases in order.
        clock: seconds, monotonic.
    """

    def __init__(self, plan: Sequence[PlannedPhase], clock: Callable[[], float] = time.monotonic) -> None:
        self.plan, self.clock = list(plan), clock
        self._ended: dict[str, Spent] = {}  # by name, whole phases: cost of what an early end left out included
        self._work = Spent()
        self._running: PlannedPhase | None = None
        self._total, self._first, self._share, self._began = 1.0, 0.0, 0.0, 0.0

    def begin(self, phase: Phase) -> None:
        """A phase begins: those before it are over. One that the plan does not know takes no time in it."""
        self._end_running()
        places = [i for i, one in enumerate(self.plan) if (one.name, one.member) == (phase.name, phase.member)]
        if places:
            self._running, self.plan = self.plan[places[0]], self.plan[places[0] + 1 :]
            self._total, self._began = phase.total or 1.0, self.clock()
            self._first = self._share = min(1.0, phase.done / self._total)

    def update(self, done: float) -> None:
        """So much of the running phase's total is done."""
        self._share = min(1.0, done / self._total)

    def seconds_left(self) -> float | None:
        """Of the whole run, None as long as nothing was measured."""
        now, work = self._measure_running(), Spent(self._work.seconds, self._work.cost)
        work.add(now.seconds, now.cost)
        if work.rate is None:
            return None
        left = 0.0
        if (running := self._running) is not None:
            end = (max(self._share, running.earliest) + 1.0) / 2.0  # in the middle of where it still may end
            left += running.cost * (end - self._share) * (now.rate or work.rate)
        for phase in self.plan:
            ended = self._ended.get(phase.name, Spent()).rate
            left += phase.cost * (work.rate * (phase.earliest + 1.0) / 2.0 if ended is None else ended)
        return left

    def _measure_running(self) -> Spent:
        """What the running phase took so far; nothing as long as that says little."""
        seconds, share = self.clock() - self._began, self._share - self._first
        if self._running is None or seconds < LEAST_SECONDS or share < LEAST_SHARE:
            return Spent()
        return Spent(seconds, share * self._running.cost)

    def _end_running(self) -> None:
        running, self._running = self._running, None
        if running is not None and self._share > self._first:
            seconds = self.clock() - self._began
            self._work.add(seconds, running.cost * (self._share - self._first))
            self._ended.setdefault(running.name, Spent()).add(seconds, running.cost * (1.0 - self._first))


EVALUATION, EVALUATION_SECONDS, EVALUATED_SECONDS = "evaluation", 3.0, 4e-5
"""Its name, and what it takes on a laptop's core: in any case, and for each environment step."""


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
        size = config.population.size
        steps = size**2 * config.evaluation.episodes * recorder.spec.horizon
        self.estimate = RunEstimate(
            [*training.plan(), PlannedPhase(EVALUATION, size, EVALUATION_SECONDS + steps * EVALUATED_SECONDS)]
        )

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
            self.estimate.begin(record)
            self.reporter.phase(title_of_phase(record, self.config.population.size), record.total)
            return False
        self._record_steps(record)
        self._record_figures(record)
        if record.note:
            self.reporter.note(record.note)
        if record.done is not None:
            self.estimate.update(record.done)
            self.reporter.expect(self.estimate.seconds_left())
            self.reporter.update(record.done, **record.shown)
        return isinstance(record, Round) and self._save_if_due(record)

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
        state = {**self.training.checkpoint(), "ledger": len(self.recorder.ledger)}
        buffers = self.training.buffers() if self.checkpoints.log_is_long else None
        self.checkpoints.save(self.running[0], state, buffers)
        self.recorder.record_checkpoint(record.member, record.number)
        return False

    def _add_member(self, trained: TrainedMember) -> None:
        """Keep what the member leaves behind, then add it to the population, unless an earlier attempt did."""
        recorder = self.recorder
        if trained.member <= len(recorder.population):
            return
        self.checkpoints.save_member(trained.member, {**trained.left, "ledger": len(recorder.ledger)})
        recorder.add_member(trained.policy, trained.training, seed=trained.seed, extra=trained.extra)
        if trained.note:
            self.reporter.note(trained.note)

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
