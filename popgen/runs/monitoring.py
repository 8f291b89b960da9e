"""What the outside sees of a running run: a log of JSON lines, gauges for Prometheus, and an eye on the disk."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import ray
from ray.util.metrics import Gauge

from popgen.errors import UserError
from popgen.progress import Figure, Reporter

LOG = "run.log"

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

_gauges: dict[str, Gauge] = {}


def gauge(name: str, value: float, **tags: str) -> None:
    """Set one of `GAUGES`; nothing happens without Ray."""
    if not ray.is_initialized() or not math.isfinite(value):
        return
    if name not in _gauges:
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
