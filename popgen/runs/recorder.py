"""What a run leaves behind. The recorder knows the run's folder and fans every record out to its sinks."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.durable_files import read_regular, replace_file
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.jsonable import unique
from popgen.methods.training import Collected, StepCount
from popgen.play.policy import Policy
from popgen.population import PopulationWriter, load_population
from popgen.population.manifest import MemberInfo
from popgen.runs.directory import RunState, describe_end, named, run_folder
from popgen.runs.ledger import Ledger
from popgen.runs.provenance import note_attempt
from popgen.runs.sinks import (
    CheckpointWritten,
    GaugeSink,
    LedgerSink,
    MemberAdded,
    MetricPoint,
    MetricsSink,
    MlflowSink,
    NoTracker,
    RunLog,
    RunLogSink,
    Sink,
    StorageSink,
    TrackerClient,
)
from popgen.runs.storage import Mirror
from popgen.types import POPULATION, TRAINING_KINDS, Kind, LedgerEntry, Weights


class RunRecorder:
    """One run's records. `close` flushes everything; a crash before it loses at most the current iteration.

    Opened again on the same folder, a recorder continues from the disk alone.

    Args:
        config: of the run; without `run.id` it gets one.
        spec: of its environment.
        tracker: writes to MLflow, that of an earlier attempt of this process for one; None for a run without MLflow.

    Raises:
        UserError: another process is at this run, it has another config, or a file of it is damaged.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec, tracker: TrackerClient | None = None) -> None:
        config = named(config)
        self.config, self.spec = config, spec
        self.run_id = str(config.run.id)
        self.dir = run_folder(config)
        self.dir.mkdir(parents=True, exist_ok=True)
        self.began = time.time()
        # The lock comes first: nothing in the folder is touched while another driver is at it.
        self.state = RunState(self.dir)
        _check_same_config(self.dir, config)
        self.attempt = _count_attempt(self.dir)
        note_attempt(self.dir)
        metrics = MetricsSink(self.dir, self.began)
        self.ledger = Ledger(self.dir / "ledger.jsonl")
        self.population = _open_population(self.dir, config, spec)
        replace_file(self.dir / "config.json", json.dumps(config.as_dict(), indent=1).encode())
        self.tracker = tracker or NoTracker()
        self.mlflow = MlflowSink(self.dir, self.tracker, self.attempt)
        self.events = RunLog(self.dir, self.run_id, self.attempt)
        if (member := self._following_member()) is not None:
            self.events.place = {"member": member}
        self.disk = DiskWatch(self.dir, config.run.disk_reserve)
        self.sinks: tuple[Sink, ...] = (
            LedgerSink(self.ledger),
            metrics,
            self.mlflow,
            GaugeSink(self.run_id, self.ledger),
            RunLogSink(self.events),
        )
        if config.run.storage:  # last: it copies what the others wrote
            self.sinks += (StorageSink(Mirror(self.dir, config.run.storage), self.events),)
        self.state.start(self.attempt)
        self.events.write("start", method=config.method, environment=config.env.name)

    # ---- environment steps -----------------------------------------------------------------------------------------

    def record_sampling(self, member: int, collected: Collected) -> None:
        """Enter a round of sampling: one ledger entry per segment."""
        matches = Counter((e.kind, e.members) for e in collected.episodes)
        scores: defaultdict[tuple[Kind, tuple[int, int]], float] = defaultdict(float)
        for episode in collected.episodes:
            scores[episode.kind, episode.members] += episode.score
        entries = []
        for kind, members, sequence, steps in collected.counts:
            episodes, score = matches[kind, members], float(scores[kind, members])
            entries.append(LedgerEntry(self.run_id, member, kind, collected.sampler, sequence, steps, episodes, score))
        self._record_entries(entries)

    def record_step_count(self, count: StepCount) -> None:
        """Enter steps that no sampler actor took."""
        entry = LedgerEntry(
            self.run_id,
            count.member,
            count.kind,
            count.sampler,
            count.sequence,
            count.steps,
            count.episodes,
            count.score,
        )
        self._record_entries([entry])

    def record_steps(self, member: int, kind: Kind, name: str, sequence: int, steps: int, episodes: int) -> None:
        """Enter steps that no sampler actor took."""
        self.record_step_count(StepCount(member, kind, name, sequence, steps, episodes))

    def record_evaluation(self, steps: int, episodes: int) -> None:
        """Enter the final evaluation, a run's last steps. Done again, it counts once: other figures replace the old."""
        name = "evaluation"
        entries = enumerate(self.ledger)
        before = next((i for i, e in entries if e.kind is Kind.EVALUATION and e.sampler == name), None)
        if before is not None:
            self.ledger.cut(before)
        self.record_steps(POPULATION, Kind.EVALUATION, name, 0, steps, episodes)

    def _record_entries(self, entries: Sequence[LedgerEntry]) -> None:
        for sink in self.sinks:
            sink.on_entries(entries)

    def training_steps(self, member: int) -> dict[str, int]:
        """This member's environment steps by kind, evaluation aside."""
        return {str(kind): steps for kind in TRAINING_KINDS if (steps := self.ledger.steps(member=member, kind=kind))}

    def member_steps(self) -> list[int]:
        """Environment steps that each member's training took, those of another run included."""
        return [info.total_steps for info in load_population(self.population.path).members]

    def progress(self) -> tuple[int, int]:
        """Members and ledger entries: a run that makes progress comes to have more of them than it ever had."""
        return len(self.population), len(self.ledger)

    def rewind_ledger(self, entries: int, tell: Callable[[str], None]) -> None:
        """Work that no checkpoint holds will be done again: its steps leave the ledger, of which `entries` stay.

        Raises:
            UserError: the ledger has fewer.
        """
        if entries > (held := len(self.ledger)):
            problem = f"has {held} entries, the checkpoint knows {entries}"
            raise UserError(str(self.dir / "ledger.jsonl"), problem, "restore it from a copy, or start a new run")
        if lost := self.ledger.cut(entries):
            tell(f"{lost} ledger entries without a checkpoint are set aside: their work is done again")

    # ---- what happens ----------------------------------------------------------------------------------------------

    def record_metrics(self, member: int, step: int, **figures: float) -> None:
        """One point of all given metrics.

        Raises:
            UserError: the disk is nearly full.
        """
        point = MetricPoint(member, step, figures, self.disk.look())
        for sink in self.sinks:
            sink.on_metrics(point)

    def record_checkpoint(self, member: int, iteration: int) -> None:
        """A checkpoint is whole on disk, after `iteration` iterations of `member`."""
        checkpoint = CheckpointWritten(member, iteration, self.ledger.steps(member=member))
        for sink in self.sinks:
            sink.on_checkpoint(checkpoint)

    def add_member(self, policy: Policy, training: Weights | None, *, seed: int, extra: dict[str, Any]) -> None:
        """Save the next member with its steps so far."""
        member, steps = len(self.population) + 1, self.training_steps(len(self.population) + 1)
        self.population.add_member(policy, seed=seed, steps=steps, training=training, extra=extra)
        kinds = _count_kinds(self.population.path, self.ledger)
        real = sum(count for kind, count in kinds.items() if kind != Kind.SIMULATED)
        added = MemberAdded(member, sum(steps.values()), real, self._following_member(), kinds)
        for sink in self.sinks:
            sink.on_member(added)

    def adopt_member(self, policy: Policy, info: MemberInfo, training: Weights | None) -> None:
        """Copy a member of another run; its steps stay in that run's ledger and in the member's record."""
        self.population.add_member(policy, seed=info.seed, steps=info.steps, training=training, extra=info.extra)

    def _following_member(self) -> int | None:
        """The member that the population does not hold yet, None once it is complete."""
        member = len(self.population) + 1
        return member if member <= self.config.population.size else None

    # ---- MLflow ----------------------------------------------------------------------------------------------------

    def start_tracking(self) -> None:
        """Open the MLflow store; needs Ray where the tracker is an actor."""
        self.mlflow.start()

    def log_artefacts(self, report: Iterable[Path]) -> None:
        """Copy what the run leaves behind to its MLflow run: configuration, ledger, population and report.

        They have the names of the run's folder there. Done again, they replace those of before.
        """
        self.ledger.to_csv(self.dir / "ledger.csv")
        for name in ("config.json", "ledger.jsonl", "ledger.csv"):
            self.tracker.log_artifact(self.dir / name)
        self.tracker.log_artifact(self.population.path, "population")
        for path in report:
            self.tracker.log_artifact(path, "report")

    # ---- the end ---------------------------------------------------------------------------------------------------

    def close(self, status: str, error: BaseException | None = None) -> None:
        """Everything to disk; status is MLflow's FINISHED, FAILED or KILLED, `error` what ended the run."""
        try:
            for sink in self.sinks:
                sink.on_end(status)
        finally:
            self._log_end(status, error)
            self.state.end(status, error)

    def hand_over(self, error: BaseException) -> None:
        """An actor or a node died: this attempt ends, another recorder of this process continues with its tracker."""
        try:
            self.ledger.flush()
        finally:
            self._log_end("KILLED", error)
            self.state.release()

    def _log_end(self, status: str, error: BaseException | None) -> None:
        text = None if error is None else describe_end(error)
        self.events.write("end", level="INFO" if error is None else "ERROR", status=status, error=text)


class DiskWatch:
    """Stops a run in one line before the disk is full, so that its last checkpoint stays whole.

    Args:
        folder: the run's.
        reserve: bytes that must stay free.
        every: seconds between two looks.
    """

    def __init__(self, folder: Path, reserve: int, every: float = 1.0) -> None:
        self.folder, self.reserve, self.every = folder, reserve, every
        self._last = -math.inf

    def look(self) -> int | None:
        """Bytes that are free, None where it is too early to look again.

        Raises:
            UserError: they are fewer than the reserve.
        """
        if time.monotonic() - self._last < self.every:
            return None
        self._last = time.monotonic()
        free = shutil.disk_usage(self.folder).free
        if free < self.reserve:
            problem = f"{self.folder} has {free / 2**20:,.0f} MiB left, fewer than run.disk_reserve"
            raise UserError("run.root", problem, "make room and give the same run.id again: it goes on from there")
        return free


def _count_kinds(population: Path, ledger: Ledger) -> dict[str, int]:
    """Environment steps of all members' training by kind, and simulated ones of this run."""
    kinds: Counter[str] = Counter()
    for info in load_population(population).members:
        kinds.update(info.steps)
    if simulated := ledger.steps(kind=Kind.SIMULATED):
        kinds[str(Kind.SIMULATED)] = simulated
    return dict(kinds)


def _check_same_config(folder: Path, config: RunConfig) -> None:
    """A run that exists has the same config.

    Raises:
        UserError: it has another, or one that cannot be read.
    """
    path = folder / "config.json"
    if path.exists() or path.is_symlink():
        try:
            previous = RunConfig.parse(json.loads(read_regular(path), object_pairs_hook=unique))
        except (OSError, ValueError, RecursionError) as error:  # damaged, or of a version with other fields
            raise UserError("run.id", f"cannot go on with {path} ({error})", "choose another id") from None
        if previous.digest() != config.digest():
            raise UserError("run.id", f"{folder.name} exists with another config", "choose another id")


def _count_attempt(folder: Path) -> int:
    """Note that an attempt begins; its number."""
    path = folder / "attempts.txt"
    attempt = 1 + (read_regular(path).count(b"\n") if path.exists() else 0)
    with path.open("a") as file:
        file.write(datetime.now(UTC).isoformat() + "\n")
    return attempt


def _open_population(folder: Path, config: RunConfig, spec: EnvSpec) -> PopulationWriter:
    digest, seed = config.digest(), config.run.seed
    return PopulationWriter(
        folder / "population", spec, method=config.method, config_digest=digest, seed=seed, resume=True
    )
