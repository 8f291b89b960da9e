"""MLflow: the only file that imports it. One parent run per population, a nested run per member, all in batches.

The store is `mlflow.db` (sqlite) beside the runs' folders, one for all runs of a root, unless a URI is given. Importing
MLflow and making the tables of a new sqlite file takes a few seconds, once, in the process that holds the `Tracker`;
nothing is sent anywhere but to that store.
"""

from __future__ import annotations

import logging
import os
import re
import shlex
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from popgen.config.sections import TrackingConfig
from popgen.errors import UserError, mask_credentials
from popgen.runs.provenance import read_commit
from popgen.runs.tracking_address import sqlite_uri

BATCH = 1000
"""Metrics in one `log_batch`: MLflow's own limit. One by one, ten thousand points take minutes on sqlite."""

KEPT = 100_000
"""Points kept while the store does not answer; older ones are dropped beyond it."""

SCALING_METRIC = "environment_steps_by_members"

KIND_METRIC = "environment_steps/{kind}"
"""Real and simulated steps so far by kind, with step = number of members, from 0."""

STORE, ARTEFACTS = "mlflow.db", "mlflow_artifacts"

PICTURE = "artefact:"
"""In a description, an address that begins so is a file of the run's artefacts."""

_NOTE = "mlflow.note.content"
_NOTE_LENGTH = 5000
_SINGLE_EVENT = re.compile(r"(?:^|/)((?:precision|recall)_.*)")
"""Figures of single events: dozens of tiles that say little alone."""

SINGLE_EVENTS = "single_events/"
"""Their prefix, which MLflow's page folds into one section."""

_TAGS = {
    **{"method": ("method",), "layout": ("env.name", "environment")},
    **{"seed": ("run.seed", "seed"), "scale": ("scale",)},
}
"""Tag -> the parameter that it repeats, by the first name that is there."""
_QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "GIT_PYTHON_REFRESH": "quiet",
}
_log = logging.getLogger(__name__)


def choose_store(run_dir: Path, storage: str | None = None) -> Path:
    """Folder of a run's default store: the runs' root, so that one MLflow shows them beside each other.

    A run that is copied elsewhere (`run.storage`), or that has a store of its own already, keeps it in its folder.
    """
    return run_dir if storage or (run_dir / STORE).exists() else run_dir.parent


def view_address(state: Mapping[str, Any], server: str = "http://127.0.0.1:5000") -> str:
    """Where MLflow's pages show a run in full; without the last part MLflow 3 opens its view of language models.

    Args:
        state: of a tracker.
        server: of `mlflow ui`.
    """
    experiment, run = state.get("experiment"), state.get("runs", {}).get("parent")
    place = f"experiments/{experiment}" if experiment else "experiments"
    return f"{server}/#/{place}{f'/runs/{run}' if experiment and run else ''}?workflowType=machine_learning"


def address_in_mlflow(tracking: TrackingConfig, state: Mapping[str, Any], store: Path) -> dict[str, str]:
    """How to look at a run: the command that serves the pages (none for a server, which does already) and the address.

    Args:
        tracking: where to.
        state: of a tracker.
        store: folder of the default store.
    """
    if tracking.uri is not None and tracking.uri.startswith("http"):
        return {"command": "", "address": view_address(state, mask_credentials(tracking.uri).rstrip("/"))}
    uri = tracking.uri or sqlite_uri(store / STORE)
    return {"command": f"mlflow ui --backend-store-uri {shlex.quote(uri)}", "address": view_address(state)}


def _group_figure(name: str) -> str:
    found = _SINGLE_EVENT.search(name)
    return f"{SINGLE_EVENTS}{found[1]}" if found else name


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
        store: folder of the default store; the run's own if None.
        parent: MLflow id of a run that this one is nested in.

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
        *,
        store: str | Path | None = None,
        parent: str | None = None,
    ) -> None:
        self.config, self.run_dir, self.run_name = config, Path(run_dir).resolve(), run_name
        self.store = Path(store or run_dir).resolve()
        self.uri = config.uri or sqlite_uri(self.store / STORE)
        self._params, self._parent = dict(_flatten_params(params or {})), parent
        self._runs: dict[str, str] = dict((resume or {}).get("runs", {}))
        self._points: dict[int | None, list[Any]] = {}
        self._client: Any = None
        self._monitor: Any = None
        self._resumed = resume is not None
        self._experiment = ""
        self._scaled: set[str] = set((resume or {}).get("scaled", ()))
        if config.enabled:
            self._open_store()

    @property
    def enabled(self) -> bool:
        return self._client is not None

    @property
    def run_id(self) -> str | None:
        """MLflow id of the (parent) run, None with tracking disabled."""
        return self._runs.get("parent")

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None, when: int | None = None) -> None:
        """Buffer metrics at `step`, of the population (member None) or of one member's nested run.

        when: milliseconds since 1970, now if None. The same point given twice with the same time is kept once.
        """
        if not self.enabled:
            return
        from mlflow.entities import Metric

        now = int(time.time() * 1000) if when is None else when
        points = self._points.setdefault(member, [])
        points += [Metric(_group_figure(name), float(value), now, int(step)) for name, value in metrics.items()]
        if len(points) >= BATCH:
            self.flush()

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """The figures that methods are compared by: environment steps so far, with step = number of members, from 0.

        Args:
            members: of the population by now.
            environment_steps: real ones of training, all members together.
            kinds: the same by kind; simulated ones among them.
        """
        figures = {SCALING_METRIC: environment_steps}
        figures |= {KIND_METRIC.format(kind=kind): steps for kind, steps in (kinds or {}).items() if steps}
        new = [name for name in figures if name not in self._scaled]
        self._scaled.update(new)
        self.log(dict.fromkeys(new, 0), step=0)
        self.log(figures, step=members)

    def describe(self, text: str, overview: str = "") -> None:
        """Markdown at the top of the run's page, and of its experiment's.

        Args:
            text: of the run; pictures at `artefact:PATH` are those of its artefacts.
            overview: of the experiment; nothing without it.
        """
        if not self.enabled:
            return
        run = self._find_run(None)
        whole = text.replace(f"({PICTURE}", f"(get-artifact?run_uuid={run}&path=")
        self._try_write(lambda: self._client.set_tag(run, _NOTE, whole[:_NOTE_LENGTH]))
        if overview:
            told = overview.replace(f"({PICTURE}", f"(get-artifact?run_uuid={run}&path=")
            self._try_write(lambda: self._client.set_experiment_tag(self._experiment, _NOTE, told[:_NOTE_LENGTH]))

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
        return {"runs": dict(self._runs), "experiment": self._experiment, "scaled": sorted(self._scaled)}

    def finish(self, status: str = "FINISHED") -> None:
        """Flush and end all runs with an MLflow status: FINISHED, FAILED or KILLED."""
        if not self.enabled:
            return
        if self._monitor is not None:
            self._monitor.finish()
        self.flush()
        for run in reversed(self._runs.values()):
            self._try_write(lambda run=run: self._client.set_terminated(run, status=status))

    def _open_store(self) -> None:
        os.environ.update({name: os.environ.get(name, value) for name, value in _QUIET.items()})
        from mlflow.exceptions import MlflowException
        from mlflow.tracking import MlflowClient
        from sqlalchemy.exc import SQLAlchemyError

        for name in ("mlflow", "alembic"):
            logging.getLogger(name).setLevel(logging.WARNING)
        if self.config.uri is None:
            self.store.mkdir(parents=True, exist_ok=True)
        try:
            with _lock_store(self.store, self.config.uri), remove_stray_folder(self.uri):
                self._client = MlflowClient(tracking_uri=self.uri)
                self._experiment = _find_experiment(self._client, self.config, self.store)
            known = "parent" in self._runs
            parent = self._find_run(None)
        except (MlflowException, SQLAlchemyError, OSError, ImportError) as error:
            first = str(error).strip().partition("\n")[0]
            raise UserError("tracking.uri", f"cannot open {self.uri} ({first})", "or use tracking=off") from None
        if known:
            self._try_write(lambda: self._client.update_run(parent, status="RUNNING"))
        if self.config.system_metrics:
            self._monitor = _watch_system(parent, self.uri, self._resumed)

    def _find_run(self, member: int | None) -> str:
        """MLflow id of the parent run or of a member's nested run, made when first needed."""
        key = "parent" if member is None else f"member_{member:03d}"
        if (
            key not in self._runs
            and self._resumed
            and (found := _search_run(self._client, self._experiment, self.run_name, member))
        ):
            self._runs[key] = found
        if key not in self._runs:
            tags = {"popgen.run": self.run_name, **_list_tags(self._params)}
            if member is None and self._parent is not None:
                tags["mlflow.parentRunId"] = self._parent
            if member is not None:
                tags |= {"mlflow.parentRunId": self._find_run(None), "popgen.member": str(member)}
            name = self.run_name if member is None else f"{self.run_name}/{key}"
            self._runs[key] = self._client.create_run(self._experiment, tags=tags, run_name=name).info.run_id
            self._log_params(self._runs[key])
        return self._runs[key]

    def _log_params(self, run: str) -> None:
        for batch in _batch_params(self._params):
            self._try_write(lambda batch=batch: self._client.log_batch(run, params=batch))

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


@contextmanager
def remove_stray_folder(uri: str) -> Iterator[None]:
    """MLflow makes the folder of a sqlite address as it is spelled, which is another one where `?` is quoted."""
    spelled = Path(uri.removeprefix("sqlite:///")).parent
    stray = uri.startswith("sqlite:///") and not spelled.exists()
    yield
    if stray:
        with suppress(OSError):  # a folder that holds the store is not empty
            os.removedirs(spelled)


class LocalTracker:
    """A `Tracker` in this process, opened by `start`: for a run without Ray.

    Args:
        config, run_dir, run_name, params, store: see `Tracker`.
    """

    def __init__(
        self,
        config: TrackingConfig,
        run_dir: Path,
        run_name: str,
        params: Mapping[str, Any],
        *,
        store: Path | None = None,
    ) -> None:
        self._arguments, self._store = (config, run_dir, run_name, params), store
        self._tracker: Tracker | None = None

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """Open the store.

        Raises:
            UserError: it cannot be opened.
        """
        if self._tracker is None:
            self._tracker = Tracker(*self._arguments, resume, store=self._store)

    def forget(self) -> None:
        """There is no other process that could be gone."""

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """See `Tracker.log`."""
        if self._tracker is not None:
            self._tracker.log(metrics, step, member)

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """See `Tracker.log_scaling`."""
        if self._tracker is not None:
            self._tracker.log_scaling(members, environment_steps, kinds)

    def describe(self, text: str, overview: str = "") -> None:
        """See `Tracker.describe`."""
        if self._tracker is not None:
            self._tracker.describe(text, overview)

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


def _watch_system(run: str, uri: str, resumed: bool) -> Any:
    """A thread that logs the machine's load to an MLflow run."""
    from mlflow.system_metrics.system_metrics_monitor import SystemMetricsMonitor

    logging.getLogger("mlflow.system_metrics").setLevel(logging.ERROR)
    monitor = SystemMetricsMonitor(run, resume_logging=resumed, tracking_uri=uri)
    monitor.start()
    return monitor


def _lock_store(store: Path, uri: str | None) -> AbstractContextManager[Any]:
    """Runs that begin together must not make the same tables at once."""
    from filelock import FileLock

    return FileLock(store / f".{STORE}.lock") if uri is None else nullcontext()


def _find_experiment(client: Any, config: TrackingConfig, store: Path) -> str:
    from mlflow.exceptions import MlflowException

    name = config.experiment
    found = client.get_experiment_by_name(name)
    if found is None:
        place = (store / ARTEFACTS).as_uri() if config.uri is None else None
        try:
            return client.create_experiment(name, artifact_location=place)
        except MlflowException:  # another run made it meanwhile
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    return found.experiment_id


def _search_run(client: Any, experiment: str, name: str, member: int | None) -> str | None:
    """A run that an earlier tracker made, and died before anybody learned of it."""
    tags = f"tags.`popgen.run` = '{name}'"
    if member is not None:
        tags += f" and tags.`popgen.member` = '{member}'"
    found = client.search_runs([experiment], tags, order_by=["attributes.start_time DESC"])
    return next((r.info.run_id for r in found if ("popgen.member" in r.data.tags) == (member is not None)), None)


def _list_tags(params: Mapping[str, Any]) -> dict[str, str]:
    """What runs are told apart by, under short names: method, layout, seed, scale and the code's commit."""
    told = {tag: next((params[name] for name in names if name in params), None) for tag, names in _TAGS.items()}
    told["commit"] = read_commit()["commit"] if params else None
    return {f"popgen.{tag}": str(value) for tag, value in told.items() if value is not None}


def _batch_params(params: Mapping[str, Any]) -> Iterator[list[Any]]:
    """As many as MLflow takes at once."""
    from mlflow.entities import Param

    flat = [Param(name, str(value)[:500]) for name, value in params.items()]
    yield from (flat[start : start + 100] for start in range(0, len(flat), 100))


def _flatten_params(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten_params(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
