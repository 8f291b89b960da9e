"""Tracker actor: the one process of a run that talks to MLflow, so that a slow store never holds up training."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from popgen.config.sections import TrackingConfig
from popgen.runs.mlflow_tracker import Tracker

MARKED = 50
"""Calls after which the driver has the tracker write, and learns what has been written."""

REVIVALS = 3
"""Tracker restarts tolerated per driver call."""

_log = logging.getLogger(__name__)


class TrackerActor:
    """Holds a `Tracker`; calls arrive in order, `open` first."""

    def __init__(self) -> None:
        self.tracker: Tracker | None = None

    def open(
        self,
        config: TrackingConfig,
        run_dir: str,
        run_name: str,
        params: Mapping[str, Any],
        resume: Mapping[str, Any] | None,
        store: str | None = None,
    ) -> None:
        """See `Tracker`; not done in the constructor, whose errors reach nobody with their type."""
        self.tracker = Tracker(config, run_dir, run_name, params, resume, store=store)

    def call(self, method: str, *arguments: Any) -> None:
        """A method of the `Tracker`; nothing where no store was opened."""
        if self.tracker is not None:
            getattr(self.tracker, method)(*arguments)

    def flush(self) -> dict[str, Any]:
        """Write everything buffered; what a later tracker needs to go on, nothing where no store was opened."""
        if self.tracker is None:
            return {}
        self.tracker.flush()
        return self.tracker.state()


class RemoteTracker:
    """The driver's end: the same calls, sent to the actor and not waited for, but for `flush` and `finish`.

    Nothing happens before `start`, nor with tracking disabled. Calls are kept until the actor has said that what they
    gave is written: should it die, another one gets them again. MLflow keeps a point that comes twice once, for it
    carries the time at which the driver gave it.
    """

    def __init__(
        self,
        config: TrackingConfig,
        run_dir: Path,
        run_name: str,
        params: Mapping[str, Any],
        resume: Mapping[str, Any] | None = None,
        *,
        store: Path | None = None,
    ) -> None:
        self._store = None if store is None else str(store)
        self._enabled, self._arguments = config.enabled, (config, str(run_dir), run_name, params)
        self._state: dict[str, Any] | None = None if resume is None else dict(resume)
        self._actor: Any = None
        self._open = False
        self._unwritten: list[tuple[Any, ...]] = []
        self._mark: tuple[Any, int] | None = None

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """Create the actor; needs Ray. `resume` is what `flush` gave in an earlier attempt of another process.

        Raises:
            UserError: the store cannot be opened.
        """
        if self._enabled and self._actor is None:
            if self._state is None and resume is not None:
                self._state = dict(resume)
            self._open = True
            self._create_actor()

    def forget(self) -> None:
        """Ray was shut down, and the actor with it: `start` makes another one."""
        self._actor = self._mark = None

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """Metrics at `step` of the population (member None) or of one member."""
        self._send_call("log", dict(metrics), step, member, int(time.time() * 1000))

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """Environment steps so far, in all and by kind, with step = number of members."""
        self._send_call("log_scaling", members, environment_steps, None if kinds is None else dict(kinds))

    def describe(self, text: str, overview: str = "") -> None:
        """Markdown of the run and of its experiment."""
        self._send_call("describe", text, overview)

    def log_artifact(self, path: str | Path, folder: str | None = None) -> None:
        """Copy a file or folder to the run's artefacts."""
        self._send_call("log_artifact", str(path), folder)

    def flush(self) -> dict[str, Any]:
        """Everything so far is written; what a resumed run needs to go on in the same MLflow runs."""
        if self._open:
            self._call_despite_failures(self._wait_written)
        return self._state or {}

    def finish(self, status: str) -> None:
        """End all MLflow runs with a status and the actor with them."""
        if not self._open or self._actor is None:
            return

        def end() -> None:
            self._wait_written()
            ray.get(self._actor.call.remote("finish", status))

        self._call_despite_failures(end)
        if self._actor is not None:
            ray.kill(self._actor)
        self._actor, self._open = None, False

    # ---- a tracker that may die ------------------------------------------------------------------------------------

    def _create_actor(self) -> None:
        """An actor on the driver's node, whose files it reads, that gets all that may not have been written."""
        here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
        self._actor = ray.remote(TrackerActor).options(num_cpus=0, scheduling_strategy=here).remote()
        ray.get(self._actor.open.remote(*self._arguments, self._state, self._store))
        self._mark = None
        for call in self._unwritten:
            self._actor.call.remote(*call)

    def _send_call(self, *call: Any) -> None:
        if not self._open:
            return
        self._unwritten.append(call)
        if self._actor is None:
            return  # between two Rays; `start` sends it
        self._actor.call.remote(*call)
        if self._mark is None and len(self._unwritten) >= MARKED:
            self._mark = (self._actor.flush.remote(), len(self._unwritten))
        elif self._mark is not None and ray.wait([self._mark[0]], timeout=0)[0]:
            self._call_despite_failures(self._read_mark)

    def _read_mark(self) -> None:
        if self._mark is not None:
            reference, count = self._mark
            self._state = ray.get(reference)
            del self._unwritten[:count]
            self._mark = None

    def _wait_written(self) -> None:
        self._state = ray.get(self._actor.flush.remote())
        self._unwritten.clear()
        self._mark = None

    def _call_despite_failures(self, act: Any) -> None:
        """Whatever happens to the actor. After too many deaths the run goes on without tracking."""
        for _ in range(REVIVALS):
            try:
                if self._actor is None:
                    self._create_actor()
                return act()
            except RayTaskError:
                raise
            except RayError as error:
                _log.warning("tracking: the tracker died (%s); another one takes over", type(error).__name__)
                self._actor = self._mark = None
                self._state = self._state or {}  # its MLflow runs are there, if it made them
        _log.warning("tracking: the tracker died %d times; the run goes on without it", REVIVALS)
        self._open = False
