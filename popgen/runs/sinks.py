"""Where a run's records go: what the recorder tells its sinks, and one sink each for ledger, metrics, MLflow, gauges of
Prometheus, run log and storage copy. A sink overrides what it wants to know; each can be left out."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from popgen.durable_files import read_regular, replace_file
from popgen.errors import UserError
from popgen.progress import Figure, Reporter
from popgen.runs.ledger import Ledger
from popgen.runs.storage import Mirror
from popgen.types import Kind, LedgerEntry

LOG = "run.log"


@dataclass(frozen=True)
class MetricPoint:
    """Figures of a member after so many of its environment steps; `free_bytes` of the disk, where it was looked at."""

    member: int
    step: int
    figures: Mapping[str, float]
    free_bytes: int | None = None


@dataclass(frozen=True)
class CheckpointWritten:
    """A checkpoint is whole on disk, after `iteration` iterations and `steps` environment steps of `member`."""

    member: int
    iteration: int
    steps: int


@dataclass(frozen=True)
class MemberAdded:
    """The population has one more member.

    Attributes:
        steps: environment steps of its training.
        total_steps: of all members so far.
        following: the member that is trained next, None after the last one.
        kinds: of all members so far by kind, simulated ones among them.
    """

    member: int
    steps: int
    total_steps: int
    following: int | None
    kinds: Mapping[str, int] = field(default_factory=dict)


class Sink:
    """Ignores everything."""

    def on_entries(self, entries: Sequence[LedgerEntry]) -> None:
        """Environment steps were taken."""

    def on_metrics(self, point: MetricPoint) -> None:
        """A point of metrics."""

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """A checkpoint was written."""

    def on_member(self, added: MemberAdded) -> None:
        """A member was added to the population."""

    def on_end(self, status: str) -> None:
        """The run ends with an MLflow status: FINISHED, FAILED or KILLED."""


class LedgerSink(Sink):
    """Counts every entry once."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger

    def on_entries(self, entries: Sequence[LedgerEntry]) -> None:
        """Record and flush."""
        for entry in entries:
            self.ledger.record(entry)
        self.ledger.flush()

    def on_end(self, status: str) -> None:
        """Flush what a full disk may have kept back."""
        self.ledger.flush()


class MetricsSink(Sink):
    """Appends a line for each point. A process that died while it wrote one left half a line, which is cut off."""

    def __init__(self, folder: Path, began: float) -> None:
        self.path, self.began = folder / "metrics.jsonl", began
        data = read_regular(self.path) if self.path.exists() else b""
        if data and not data.endswith(b"\n"):
            os.truncate(self.path, data.rfind(b"\n") + 1)

    def on_metrics(self, point: MetricPoint) -> None:
        """One line: member, step, seconds of this attempt, figures."""
        row = {"member": point.member, "step": point.step, "seconds": round(time.time() - self.began, 2)}
        figures = {name: _round_figure(value) for name, value in point.figures.items()}
        with self.path.open("a") as file:
            file.write(json.dumps(row | figures) + "\n")


def _round_figure(value: float) -> float | None:
    return round(float(value), 5) if math.isfinite(value) else None


class TrackerClient(Protocol):
    """The recorder's end of a tracker, see `popgen.runs.mlflow_tracker.Tracker`. Each method does nothing by itself."""

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """Open the store; `resume` is what `flush` gave in an earlier attempt."""

    def forget(self) -> None:
        """Its process is gone; `start` makes another one."""

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """Metrics of the population (member None) or of one member."""

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """Environment steps so far, in all and by kind, with step = number of members."""

    def describe(self, text: str, overview: str = "") -> None:
        """Markdown of the run and of its experiment."""

    def log_artifact(self, path: str | Path, folder: str | None = None) -> None:
        """Copy a file or folder."""

    def flush(self) -> dict[str, Any]:
        """Wait until everything is written; what a later tracker needs to continue."""
        return {}

    def finish(self, status: str) -> None:
        """End all MLflow runs."""


class NoTracker(TrackerClient):
    """A run without MLflow: nothing is kept."""


class MlflowSink(Sink):
    """Hands points on. A resumed run continues in the same MLflow runs.

    Raises:
        UserError: tracking.json cannot be read.
    """

    def __init__(self, folder: Path, tracker: TrackerClient, attempt: int) -> None:
        self.path, self.tracker = folder / "tracking.json", tracker
        runs = self._read_runs()
        self.resume = runs if runs or attempt > 1 else None

    def start(self) -> None:
        """Open the store and keep the run ids; needs Ray where the tracker is an actor."""
        self.tracker.start(self.resume)
        self.save_runs()

    def save_runs(self) -> None:
        """Keep the MLflow run ids."""
        replace_file(self.path, json.dumps(self.tracker.flush()).encode())

    def on_metrics(self, point: MetricPoint) -> None:
        """A member's figures."""
        self.tracker.log(point.figures, step=point.step, member=point.member)

    def on_member(self, added: MemberAdded) -> None:
        """One more point of the scaling figure."""
        self.tracker.log_scaling(added.member, added.total_steps, added.kinds)
        self.save_runs()

    def on_end(self, status: str) -> None:
        """End the MLflow runs."""
        self.tracker.finish(status)

    def _read_runs(self) -> dict[str, Any]:
        try:
            text = json.loads(read_regular(self.path)) if self.path.exists() else {}
            runs = text.get("runs", {}) if isinstance(text, dict) else None
            if not isinstance(runs, dict) or not all(isinstance(run, str) for run in runs.values()):
                raise ValueError("it holds no runs")
        except (OSError, ValueError, RecursionError) as error:
            raise UserError(str(self.path), f"cannot be read ({error})", "remove it: MLflow gets new runs") from None
        return text


GAUGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "popgen_environment_steps": ("Environment steps in the ledger.", ("run", "kind")),
    "popgen_members": ("Members in the population.", ("run",)),
    "popgen_iteration": ("Iterations of the member in training.", ("run", "member")),
    "popgen_score": ("Mean score of the latest self-play episodes.", ("run", "member")),
    "popgen_update_milliseconds": ("Mean time of one update of a learner.", ("run", "learner")),
    "popgen_learner_idle_share": ("Share of the time in which a learner had nothing to do.", ("run", "learner")),
    "popgen_staleness_rounds": ("Rounds by which the inputs of a task were out of date at its end.", ("run", "work")),
    "popgen_queue_rounds": ("Rounds that a kind of work is ahead of the slowest.", ("run", "work")),
    "popgen_restarts": ("Times that the run went on after the death of an actor or node.", ("run",)),
    "popgen_disk_free_bytes": ("Room left where the run's folder is.", ("run",)),
}
"""Name -> (description, tags). Ray serves them, `ray_` before each name, at every node's metrics port."""

FIGURES = {
    "real_sp": ("popgen_score", "member"),
    "score": ("popgen_score", "member"),
    "update_ms": ("popgen_update_milliseconds", "learner"),
    "idle": ("popgen_learner_idle_share", "learner"),
    "staleness": ("popgen_staleness_rounds", "work"),
    "queue": ("popgen_queue_rounds", "work"),
}
"""Figures of `RunRecorder.log` that are gauges: NAME of a member, NAME/WORK or LEARNER/NAME -> (gauge, tag)."""

_gauges: dict[str, Any] = {}


def gauge(name: str, value: float, **tags: str) -> None:
    """Set one of `GAUGES`; nothing happens without Ray, which a command without a run does not load."""
    ray = sys.modules.get("ray")
    if ray is None or not ray.is_initialized() or not math.isfinite(value):
        return
    if name not in _gauges:
        from ray.util.metrics import Gauge

        description, keys = GAUGES[name]
        _gauges[name] = Gauge(name, description=description, tag_keys=keys)
    _gauges[name].set(float(value), tags=tags)


def show_figures(run: str, member: int, figures: Mapping[str, float]) -> None:
    """Set the gauges that `figures` of a member have."""
    for name, value in figures.items():
        first, _, last = name.partition("/")
        known, of = (first, last) if first in FIGURES else (last or first, first)
        if known in FIGURES:
            wanted, tag = FIGURES[known]
            gauge(wanted, value, run=run, **{tag: str(member) if tag == "member" else of})


class GaugeSink(Sink):
    """Sets the gauges that `GAUGES` lists."""

    def __init__(self, run: str, ledger: Ledger) -> None:
        self.run, self.ledger = run, ledger

    def on_entries(self, entries: Sequence[LedgerEntry]) -> None:
        """Totals by kind."""
        for kind in Kind:
            if steps := self.ledger.steps(kind=kind):
                gauge("popgen_environment_steps", steps, run=self.run, kind=str(kind))

    def on_metrics(self, point: MetricPoint) -> None:
        """The member's score, the learners' speed, room on the disk."""
        if point.free_bytes is not None:
            gauge("popgen_disk_free_bytes", point.free_bytes, run=self.run)
        show_figures(self.run, point.member, point.figures)

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """Iterations of the member in training."""
        gauge("popgen_iteration", checkpoint.iteration, run=self.run, member=str(checkpoint.member))

    def on_member(self, added: MemberAdded) -> None:
        """Members in the population."""
        gauge("popgen_members", added.member, run=self.run)


class RunLog:
    """`run.log` in the run's folder: one JSON object a line, each with time, level, run, attempt, event and place.

    Where they apply: text, and other fields of the event. Events: start, note, checkpoint, member, lost (an actor or
    node died), end. A line that cannot be written is dropped: the log never stops a run.

    Attributes:
        place: where the run is: the member in training, {} after the last, and its iteration once that is known.
    """

    def __init__(self, folder: Path, run: str, attempt: int) -> None:
        self.path, self._common = folder / LOG, {"run": run, "attempt": attempt}
        self.place: dict[str, int] = {}

    def write(self, event: str, *, level: str = "INFO", **fields: Any) -> None:
        """Append one line."""
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
        row = {"time": stamp, "level": level, **self._common, "event": event, **self.place, **fields}
        try:
            with self.path.open("a") as file:
                file.write(json.dumps(row) + "\n")
        except OSError:
            return


class LoggingReporter:
    """A reporter whose notes are also lines of the run's log."""

    def __init__(self, inner: Reporter, log: RunLog) -> None:
        self.inner, self.log = inner, log

    def phase(self, name: str, total: float) -> None:
        """See `Reporter.phase`."""
        self.log.write("note", text=name)
        self.inner.phase(name, total)

    def expect(self, seconds: float | None) -> None:
        """See `Reporter.expect`."""
        self.inner.expect(seconds)

    def update(self, done: float, **figures: Figure) -> None:
        """See `Reporter.update`."""
        self.inner.update(done, **figures)

    def note(self, text: str) -> None:
        """See `Reporter.note`."""
        self.log.write("note", text=text)
        self.inner.note(text)

    def close(self) -> None:
        """See `Reporter.close`."""
        self.inner.close()


class RunLogSink(Sink):
    """Writes to the run's log. Its last line is the recorder's, whatever the other sinks raise."""

    def __init__(self, log: RunLog) -> None:
        self.log = log

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """Lines are from now on of this member and iteration."""
        self.log.place = {"member": checkpoint.member, "iteration": checkpoint.iteration}
        self.log.write("checkpoint", steps=checkpoint.steps)

    def on_member(self, added: MemberAdded) -> None:
        """Lines are from now on of the following member."""
        self.log.write("member", member=added.member, steps=added.steps)
        self.log.place = {} if added.following is None else {"member": added.following}


class StorageSink(Sink):
    """Pushes the folder; a copy that was not taken is a line of the run's log."""

    def __init__(self, mirror: Mirror, log: RunLog) -> None:
        self.mirror, self.log = mirror, log

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """Copy what has changed."""
        self._push_copy()

    def on_member(self, added: MemberAdded) -> None:
        """Copy what has changed."""
        self._push_copy()

    def on_end(self, status: str) -> None:
        """Copy a finished run."""
        if status == "FINISHED":
            self._push_copy()

    def _push_copy(self) -> None:
        try:
            self.mirror.push()
        except OSError as error:
            text = f"{self.mirror.uri} did not take a copy ({' '.join(str(error).split())[:200]})"
            self.log.write("note", level="WARNING", text=text)
