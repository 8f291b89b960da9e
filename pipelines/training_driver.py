"""The one driver of all methods: it goes through the members and does what a training loop's records ask for.

The loop says what happened; here it is written down: steps to the ledger, figures to the metrics, segments to the
checkpoint's log, progress to the screen, checkpoints where they are due.
"""

from __future__ import annotations

import math
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
)
from popgen.pipelines.run_estimate import RunEstimate
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.runs.checkpoints import CheckpointFiles, fitting, member_folder
from popgen.runs.recorder import RunRecorder
from popgen.runs.recovery import wait_for_room

EVALUATION, REPORT_SECONDS, EVALUATED_SECONDS = "evaluation", 8.0, 4e-5
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
            self.estimate.begin(record)
            self.reporter.phase(title_of_phase(record, self.config.population.size), record.total)
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
                self.estimate.load_state(state["estimate"])
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
