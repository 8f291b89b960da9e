"""Tracker actor: the one process of a run that talks to MLflow, so that a slow store never holds up training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray

from popgen.config import TrackingConfig
from popgen.tracking import Tracker


class TrackerActor:
    """Holds a `Tracker`; calls arrive in order."""

    def __init__(
        self,
        config: TrackingConfig,
        run_dir: str,
        run_name: str,
        params: Mapping[str, Any],
        resume: Mapping[str, Any] | None,
    ) -> None:
        self.tracker = Tracker(config, run_dir, run_name, params, resume)

    def log(self, metrics: Mapping[str, float], step: int, member: int | None) -> None:
        """See `Tracker.log`."""
        self.tracker.log(metrics, step, member)

    def log_scaling(self, members: int, environment_steps: int) -> None:
        """See `Tracker.log_scaling`."""
        self.tracker.log_scaling(members, environment_steps)

    def log_artifact(self, path: str, folder: str | None) -> None:
        """See `Tracker.log_artifact`."""
        self.tracker.log_artifact(path, folder)

    def flush(self) -> dict[str, Any]:
        """Write everything buffered; what a later tracker needs to go on."""
        self.tracker.flush()
        return self.tracker.state()

    def finish(self, status: str) -> None:
        """See `Tracker.finish`."""
        self.tracker.finish(status)


class RemoteTracker:
    """The driver's end: the same calls, sent to the actor and not waited for, but for `flush` and `finish`.

    Nothing happens before `start`, nor with tracking disabled.
    """

    def __init__(
        self,
        config: TrackingConfig,
        run_dir: Path,
        run_name: str,
        params: Mapping[str, Any],
        resume: Mapping[str, Any] | None,
    ) -> None:
        self._enabled, self._arguments = config.enabled, (config, str(run_dir), run_name, params, resume)
        self._actor: Any = None

    def start(self) -> None:
        """Create the actor; needs Ray."""
        if self._enabled:
            self._actor = ray.remote(TrackerActor).options(num_cpus=0).remote(*self._arguments)

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """Metrics at `step` of the population (member None) or of one member."""
        if self._actor is not None:
            self._actor.log.remote(dict(metrics), step, member)

    def log_scaling(self, members: int, environment_steps: int) -> None:
        """Environment steps so far, with step = number of members."""
        if self._actor is not None:
            self._actor.log_scaling.remote(members, environment_steps)

    def log_artifact(self, path: str | Path, folder: str | None = None) -> None:
        """Copy a file or folder to the run's artefacts."""
        if self._actor is not None:
            self._actor.log_artifact.remote(str(path), folder)

    def flush(self) -> dict[str, Any]:
        """Everything so far is written; what a resumed run needs to go on in the same MLflow runs."""
        return {} if self._actor is None else ray.get(self._actor.flush.remote())

    def finish(self, status: str) -> None:
        """End all MLflow runs with a status and the actor with them."""
        if self._actor is not None:
            ray.get(self._actor.finish.remote(status))
            ray.kill(self._actor)
            self._actor = None
