"""Metrics and the scaling figure to MLflow, by a tracker that the pipeline makes; tracking.json keeps its run ids."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from popgen.durable_files import read_regular, replace_file
from popgen.errors import UserError
from popgen.runs.sinks.sink import MemberAdded, MetricPoint, Sink


class TrackerClient(Protocol):
    """The recorder's end of a tracker, see `popgen.runs.mlflow_tracker.Tracker`."""

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
        ...

    def finish(self, status: str) -> None:
        """End all MLflow runs."""


class NoTracker:
    """A run without MLflow."""

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """There is no store to open."""

    def forget(self) -> None:
        """There is no process."""

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """Ignore metrics."""

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """Ignore the figures."""

    def describe(self, text: str, overview: str = "") -> None:
        """Ignore the text."""

    def log_artifact(self, path: str | Path, folder: str | None = None) -> None:
        """Ignore the file."""

    def flush(self) -> dict[str, Any]:
        """There are no MLflow runs."""
        return {}

    def finish(self, status: str) -> None:
        """There is nothing to end."""


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
