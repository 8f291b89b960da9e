"""What a run leaves behind: its folder, ledger, metrics, MLflow runs, population and checkpoints."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from popgen.actors.tracker_actor import RemoteTracker
from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.jsonable import unique
from popgen.methods.training import Collected
from popgen.nets.weights import Weights
from popgen.play.policy import Policy
from popgen.population import PopulationWriter, load_population
from popgen.population.manifest import MemberInfo
from popgen.runs.directory import RunState, named, run_folder
from popgen.runs.ledger import Ledger
from popgen.runs.monitoring import DiskWatch, RunLog, gauge, show_figures
from popgen.runs.state_files import read_regular
from popgen.runs.storage import Mirror
from popgen.types import Kind, LedgerEntry


class RunRecorder:
    """One run's records. Everything is on disk when `close` returns, and enough of it to go on before that.

    Opened again on the same folder, they go on: after the death of a driver, or of an actor, from the disk alone.

    Args:
        config: of the run; without `run.id` it gets one.
        spec: of its environment.
        tracker: that of the recorder of an earlier attempt of this process.

    Raises:
        UserError: another process is at this run, it has another config, or a file of it is damaged.
    """

    def __init__(self, config: RunConfig, spec: EnvSpec, tracker: RemoteTracker | None = None) -> None:
        config = named(config)
        self.config, self.spec = config, spec
        self.run_id = str(config.run.id)
        self.dir = run_folder(config)
        self.dir.mkdir(parents=True, exist_ok=True)
        self.began = time.time()
        self.state = RunState(self.dir)
        self._check_same_config()
        self.attempt = self._next_attempt()
        self._mend_metrics()
        self.ledger = Ledger(self.dir / "ledger.jsonl")
        self.population = PopulationWriter(
            self.dir / "population",
            spec,
            method=config.method,
            config_digest=config.digest(),
            seed=config.run.seed,
            resume=True,
        )
        params = config.relevant()
        self.tracker = tracker or RemoteTracker(config.tracking, self.dir, self.run_id, params, self._resumed())
        self.events = RunLog(self.dir, self.run_id, self.attempt)
        self._next_member()
        self.disk = DiskWatch(self.dir, config.run.disk_reserve)
        self.mirror = Mirror(self.dir, config.run.storage) if config.run.storage else None
        self.state.start(self.attempt)
        self.events.write("start", method=config.method, environment=config.env.name)

    def _check_same_config(self) -> None:
        path = self.dir / "config.json"
        if path.exists() or path.is_symlink():
            try:
                known = RunConfig.parse(json.loads(read_regular(path), object_pairs_hook=unique))
            except (OSError, ValueError, RecursionError) as error:  # damaged, or of a version with other fields
                raise UserError("run.id", f"cannot go on with {path} ({error})", "choose another id") from None
            if known.digest() != self.config.digest():
                raise UserError("run.id", f"{self.run_id} exists with another config", "choose another id")
        _replace(path, json.dumps(self.config.relevant(), indent=1))

    def _next_attempt(self) -> int:
        path = self.dir / "attempts.txt"
        attempt = 1 + (read_regular(path).count(b"\n") if path.exists() else 0)
        with path.open("a") as file:
            file.write(datetime.now(UTC).isoformat() + "\n")
        return attempt

    def _resumed(self) -> dict[str, Any] | None:
        path = self.dir / "tracking.json"
        try:
            known = json.loads(read_regular(path)) if path.exists() else {}
            runs = known.get("runs", {}) if isinstance(known, dict) else None
            if not isinstance(runs, dict) or not all(isinstance(run, str) for run in runs.values()):
                raise ValueError("it holds no runs")
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(str(path), f"cannot be read ({error})", "remove it: MLflow gets new runs") from None
        return known if known or self.attempt > 1 else None

    def _mend_metrics(self) -> None:
        """A process that died while it wrote a point leaves half a line."""
        path = self.dir / "metrics.jsonl"
        data = read_regular(path) if path.exists() else b""
        if data and not data.endswith(b"\n"):
            os.truncate(path, data.rfind(b"\n") + 1)

    def record_sampling(self, member: int, collected: Collected) -> None:
        """Enter a round of sampling: one ledger entry per segment."""
        matches = Counter((e.kind, e.members) for e in collected.episodes)
        scores: Counter[tuple[Kind, tuple[int, int]]] = Counter()
        for episode in collected.episodes:
            scores[episode.kind, episode.members] += episode.score
        for kind, members, sequence, steps in collected.counts:
            key = (kind, members)
            entry = LedgerEntry(
                self.run_id, member, kind, collected.sampler, sequence, steps, matches[key], float(scores[key])
            )
            self.ledger.record(entry)
        self._flush_ledger()

    def record_steps(
        self, member: int, kind: Kind, name: str, sequence: int, steps: int, episodes: int, score: float = 0.0
    ) -> None:
        """Enter steps that no sampler actor took."""
        self.ledger.record(LedgerEntry(self.run_id, member, kind, name, sequence, steps, episodes, score))
        self._flush_ledger()

    def record_evaluation(self, member: int, steps: int, episodes: int) -> None:
        """Enter the final evaluation, a run's last steps. Done again, it counts once: other figures replace the old."""
        name = "evaluation"
        entries = list(self.ledger)
        before = next((i for i, e in enumerate(entries) if e.kind is Kind.EVALUATION and e.sampler == name), None)
        if before is not None:
            self.ledger.cut(before)
        self.record_steps(member, Kind.EVALUATION, name, 0, steps, episodes)

    def _flush_ledger(self) -> None:
        self.ledger.flush()
        for kind in Kind:
            if steps := self.ledger.steps(kind=kind):
                gauge("popgen_environment_steps", steps, run=self.run_id, kind=str(kind))

    def progress(self) -> tuple[int, int]:
        """Members and ledger entries: a run that goes on comes to have more of them than it ever had."""
        return len(self.population), len(self.ledger)

    def record_checkpoint(self, member: int, iteration: int) -> None:
        """Tell that a checkpoint is whole on disk, after `iteration` iterations of `member`: it is copied to the
        storage. A storage that does not take it is told of and does not stop the run."""
        gauge("popgen_iteration", iteration, run=self.run_id, member=str(member))
        self.events.place = {"member": member, "iteration": iteration}
        self.events.write("checkpoint", steps=self.ledger.steps(member=member))
        self._copy()

    def _copy(self) -> None:
        if self.mirror is None:
            return
        try:
            self.mirror.push()
        except OSError as error:
            text = f"{self.mirror.uri} did not take a copy ({' '.join(str(error).split())[:200]})"
            self.events.write("note", level="WARNING", text=text)

    def training_steps(self, member: int) -> dict[str, int]:
        """This member's environment steps by kind, evaluation aside."""
        kinds = (Kind.RANDOM, Kind.SP, Kind.XP, Kind.MP)
        return {str(kind): steps for kind in kinds if (steps := self.ledger.steps(member=member, kind=kind))}

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

    def record_metrics(self, member: int, step: int, **figures: float) -> None:
        """One point of all given metrics, in metrics.jsonl and MLflow."""
        if (free := self.disk.look()) is not None:
            gauge("popgen_disk_free_bytes", free, run=self.run_id)
        show_figures(self.run_id, member, figures)
        row = {"member": member, "step": step, "seconds": round(time.time() - self.began, 2)}
        with (self.dir / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(row | {k: _rounded(v) for k, v in figures.items()}) + "\n")
        self.tracker.log(figures, step=step, member=member)

    def add_member(self, policy: Policy, training: Weights | None, *, seed: int, extra: dict[str, Any]) -> None:
        """Save the next member, with its steps so far, and enter it in the scaling figure."""
        member = len(self.population) + 1
        self.population.add_member(policy, seed=seed, steps=self.training_steps(member), training=training, extra=extra)
        self.tracker.log_scaling(member, sum(self.member_steps()))
        self.save_tracking()
        gauge("popgen_members", member, run=self.run_id)
        self.events.write("member", member=member, steps=sum(self.training_steps(member).values()))
        self._next_member()
        self._copy()

    def _next_member(self) -> None:
        """Lines of the log are from now on of the member that the population does not hold yet."""
        member = len(self.population) + 1
        self.events.place = {"member": member} if member <= self.config.population.size else {}

    def member_steps(self) -> list[int]:
        """Environment steps that each member's training took, those of another run included."""
        return [info.total_steps for info in load_population(self.population.path).members]

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

    def save_tracking(self) -> None:
        """Keep the MLflow run ids: a resumed run goes on in the same MLflow runs."""
        _replace(self.dir / "tracking.json", json.dumps(self.tracker.flush()))

    def adopt_member(self, policy: Policy, info: MemberInfo, training: Weights | None) -> None:
        """Copy a member of another run; its steps stay in that run's ledger and in the member's record."""
        self.population.add_member(policy, seed=info.seed, steps=info.steps, training=training, extra=info.extra)

    def close(self, status: str, error: BaseException | None = None) -> None:
        """Everything to disk; status is MLflow's FINISHED, FAILED or KILLED, `error` what ended the run."""
        try:
            self.ledger.flush()
            self.tracker.finish(status)
            if status == "FINISHED":
                self._copy()
        finally:
            self._tell_end(status, error)
            self.state.end(status, error)

    def hand_over(self, error: BaseException) -> None:
        """An actor or a node died: this attempt ends, other recorder of this process go on with its tracker."""
        try:
            self.ledger.flush()
        finally:
            self._tell_end("KILLED", error)
            self.state.release()

    def _tell_end(self, status: str, error: BaseException | None) -> None:
        text = None if error is None else " ".join(str(error).split())[:500]
        self.events.write("end", level="INFO" if error is None else "ERROR", status=status, error=text)


def _replace(path: Path, text: str) -> None:
    """The old contents or the new, whatever interrupts it."""
    fresh = path.with_name(path.name + ".writing")
    fresh.write_text(text)
    fresh.replace(path)


def _rounded(value: float) -> float | None:
    return round(float(value), 5) if np.isfinite(value) else None
