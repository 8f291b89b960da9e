"""MLflow: the only file that imports it. One parent run per population, a nested run per member, all in batches.

The store is `mlflow.db` (sqlite) in the run's folder unless a URI is given. Importing MLflow and making the tables
of a new sqlite file takes a few seconds, once, in the process that holds the `Tracker`; nothing is sent anywhere
but to that store.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from popgen.config.sections import TrackingConfig
from popgen.errors import UserError, mask_credentials
from popgen.runs.tracking_address import sqlite_uri

BATCH = 1000
"""Metrics in one `log_batch`: MLflow's own limit. One by one, ten thousand points take minutes on sqlite."""

KEPT = 100_000
"""Points kept while the store does not answer; older ones are dropped beyond it."""

SCALING_METRIC = "environment_steps_by_members"
_QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "GIT_PYTHON_REFRESH": "quiet",
}
_log = logging.getLogger(__name__)


class Tracker:
    """Buffers metrics and writes them to MLflow in batches.

    A store that stops answering does not stop training: points that could not be written stay buffered for the next
    `flush` and a warning is logged. An artefact that it does not take is missing, which a warning tells too.

    Args:
        config: where to track; with `enabled` false every call does nothing.
        run_dir: the run's folder, for the default store and its artefacts.
        run_name: of the parent run.
        params: a (nested) dictionary, logged as the parent's parameters.
        resume: `state()` of an earlier tracker of this run, to go on in the same MLflow runs.

    Raises:
        UserError: the store cannot be opened.
    """

    def __init__(
        self,
        config: TrackingConfig,
        run_dir: str | Path,
        run_name: str,
        params: Mapping[str, Any] | None = None,
        resume: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.run_dir, self.run_name = config, Path(run_dir).resolve(), run_name
        self.uri = config.uri or sqlite_uri(self.run_dir / "mlflow.db")
        self._runs: dict[str, str] = dict((resume or {}).get("runs", {}))
        self._points: dict[int | None, list[Any]] = {}
        self._client: Any = None
        self._monitor: Any = None
        self._resumed = resume is not None
        self._experiment = ""
        if config.enabled:
            self._open_store(params or {})

    @property
    def enabled(self) -> bool:
        return self._client is not None

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None, when: int | None = None) -> None:
        """Buffer metrics at `step`, of the population (member None) or of one member's nested run.

        when: milliseconds since 1970, now if None. The same point given twice with the same time is kept once.
        """
        if not self.enabled:
            return
        from mlflow.entities import Metric

        now = int(time.time() * 1000) if when is None else when
        points = self._points.setdefault(member, [])
        points += [Metric(name, float(value), now, int(step)) for name, value in metrics.items()]
        if len(points) >= BATCH:
            self.flush()

    def log_scaling(self, members: int, environment_steps: int) -> None:
        """The figure that methods are compared by: environment steps so far, with step = number of members."""
        self.log({SCALING_METRIC: environment_steps}, step=members)

    def log_artifact(self, path: str | Path, folder: str | None = None, member: int | None = None) -> None:
        """Copy a file, or what a folder holds, to the run's artefacts, into `folder` of these.

        A file that is there under the same name is replaced, so that a run that goes on has each once.
        """
        if not self.enabled:
            return
        path = Path(path)
        send = self._client.log_artifacts if path.is_dir() else self._client.log_artifact
        # Each kind of artefact store raises errors of its own.
        self._try_write(lambda: send(self._find_run(member), str(path), folder), Exception)

    def flush(self) -> None:
        """Write everything buffered, `BATCH` points a call."""
        for member, points in self._points.items():
            while points:
                batch = points[:BATCH]
                if not self._try_write(
                    lambda m=member, batch=batch: self._client.log_batch(self._find_run(m), metrics=batch)
                ):
                    del points[: max(0, len(points) - KEPT)]
                    break
                del points[:BATCH]

    def state(self) -> dict[str, Any]:
        """What a later tracker needs to go on in the same MLflow runs; JSON-able."""
        return {"runs": dict(self._runs)}

    def finish(self, status: str = "FINISHED") -> None:
        """Flush and end all runs with an MLflow status: FINISHED, FAILED or KILLED."""
        if not self.enabled:
            return
        if self._monitor is not None:
            self._monitor.finish()
        self.flush()
        for run in reversed(self._runs.values()):
            self._try_write(lambda run=run: self._client.set_terminated(run, status=status))

    def _open_store(self, params: Mapping[str, Any]) -> None:
        os.environ.update({name: os.environ.get(name, value) for name, value in _QUIET.items()})
        from mlflow.exceptions import MlflowException
        from mlflow.tracking import MlflowClient
        from sqlalchemy.exc import SQLAlchemyError

        for name in ("mlflow", "alembic"):
            logging.getLogger(name).setLevel(logging.WARNING)
        if self.config.uri is None:
            self.run_dir.mkdir(parents=True, exist_ok=True)
        try:
            self._client = MlflowClient(tracking_uri=self.uri)
            self._experiment = self._find_experiment()
            known = "parent" in self._runs
            parent = self._find_run(None)
        except (MlflowException, SQLAlchemyError, OSError, ImportError) as error:
            first = str(error).strip().partition("\n")[0]
            raise UserError("tracking.uri", f"cannot open {self.uri} ({first})", "or use tracking=off") from None
        if known:
            self._try_write(lambda: self._client.update_run(parent, status="RUNNING"))
        else:
            self._log_params(parent, params)
        if self.config.system_metrics:
            self._watch_system(parent)

    def _watch_system(self, run: str) -> None:
        from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

        logging.getLogger("mlflow.system_metrics").setLevel(logging.ERROR)
        self._monitor = SystemMetricsMonitor(run, resume_logging=self._resumed, tracking_uri=self.uri)
        self._monitor.start()

    def _find_experiment(self) -> str:
        from mlflow.exceptions import MlflowException

        name = self.config.experiment
        found = self._client.get_experiment_by_name(name)
        if found is None:
            place = (self.run_dir / "mlflow_artifacts").as_uri() if self.config.uri is None else None
            try:
                return self._client.create_experiment(name, artifact_location=place)
            except MlflowException:  # another run made it meanwhile
                found = self._client.get_experiment_by_name(name)
                if found is None:
                    raise
        return found.experiment_id

    def _find_run(self, member: int | None) -> str:
        """MLflow id of the parent run or of a member's nested run, made when first needed."""
        key = "parent" if member is None else f"member_{member:03d}"
        if key not in self._runs and self._resumed and (found := self._search_run(member)):
            self._runs[key] = found
        if key not in self._runs:
            tags = {"popgen.run": self.run_name}
            if member is not None:
                tags |= {"mlflow.parentRunId": self._find_run(None), "popgen.member": str(member)}
            name = self.run_name if member is None else f"{self.run_name}/{key}"
            self._runs[key] = self._client.create_run(self._experiment, tags=tags, run_name=name).info.run_id
        return self._runs[key]

    def _search_run(self, member: int | None) -> str | None:
        """A run that an earlier tracker made, and died before anybody learned of it."""
        tags = f"tags.`popgen.run` = '{self.run_name}'"
        if member is not None:
            tags += f" and tags.`popgen.member` = '{member}'"
        found = self._client.search_runs([self._experiment], tags, order_by=["attributes.start_time DESC"])
        return next((r.info.run_id for r in found if ("popgen.member" in r.data.tags) == (member is not None)), None)

    def _log_params(self, run: str, params: Mapping[str, Any]) -> None:
        from mlflow.entities import Param

        flat = [Param(name, str(value)[:500]) for name, value in _flatten_params(params)]
        for start in range(0, len(flat), 100):
            self._try_write(lambda start=start: self._client.log_batch(run, params=flat[start : start + 100]))

    def _try_write(self, call: Any, *errors: type[Exception]) -> bool:
        from mlflow.exceptions import MlflowException

        try:
            call()
        except (MlflowException, OSError, *errors) as error:
            _log.warning(
                "tracking: %s did not take a write, training goes on (%s)",
                *(mask_credentials(text) for text in (self.uri, str(error).partition("\n")[0])),
            )
            return False
        return True


class LocalTracker:
    """A `Tracker` in this process, opened by `start`: for a run without Ray.

    Args:
        config, run_dir, run_name, params: see `Tracker`.
    """

    def __init__(self, config: TrackingConfig, run_dir: Path, run_name: str, params: Mapping[str, Any]) -> None:
        self._arguments = (config, run_dir, run_name, params)
        self._tracker: Tracker | None = None

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """Open the store.

        Raises:
            UserError: it cannot be opened.
        """
        if self._tracker is None:
            self._tracker = Tracker(*self._arguments, resume)

    def forget(self) -> None:
        """There is no other process that could be gone."""

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """See `Tracker.log`."""
        if self._tracker is not None:
            self._tracker.log(metrics, step, member)

    def log_scaling(self, members: int, environment_steps: int) -> None:
        """See `Tracker.log_scaling`."""
        if self._tracker is not None:
            self._tracker.log_scaling(members, environment_steps)

    def log_artifact(self, path: str | Path, folder: str | None = None) -> None:
        """See `Tracker.log_artifact`."""
        if self._tracker is not None:
            self._tracker.log_artifact(path, folder)

    def flush(self) -> dict[str, Any]:
        """Write everything; what a later tracker needs to continue in the same MLflow runs."""
        if self._tracker is None:
            return {}
        self._tracker.flush()
        return self._tracker.state()

    def finish(self, status: str) -> None:
        """See `Tracker.finish`."""
        if self._tracker is not None:
            self._tracker.finish(status)
            self._tracker = None


def _flatten_params(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten_params(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
