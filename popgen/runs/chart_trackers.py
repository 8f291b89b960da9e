"""Trackers beside MLflow's: TensorBoard's event files by tensorboardX, which Ray brings, and Weights & Biases by its
own client. Both are `TrackerClient`s in the driver's process. Reports and populations stay in the run's folder."""

from __future__ import annotations

import importlib.util
import logging
import math
import netrc
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from popgen.config.sections import TrackingConfig
from popgen.errors import UserError
from popgen.runs.sinks import NoTracker

FOLDER = "tensorboard"
"""Of the event files, in the run's folder."""

_PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb"}
OFFLINE = ("offline", "disabled", "dryrun")
_log = logging.getLogger(__name__)


def check_writer(config: TrackingConfig) -> None:
    """What `tracking.writer` needs beyond popgen's own dependencies, before anything starts.

    Raises:
        UserError: its package is not installed, or Weights & Biases has no key to log in with.
    """
    package = _PACKAGES.get(config.writer)
    if package is not None and importlib.util.find_spec(package) is None:
        raise UserError("tracking", f"{config.writer} needs the package {package}", f"pip install {package}")
    if config.writer == "wandb" and os.environ.get("WANDB_MODE") not in OFFLINE and not _has_key():
        raise UserError("tracking", "wandb has no key", "run `wandb login`, or set WANDB_MODE=offline")


def _has_key() -> bool:
    """Where wandb looks for one: its variable, and the file that `wandb login` writes."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    host = os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai").partition("://")[2].partition("/")[0]
    with suppress(OSError, netrc.NetrcParseError):
        return netrc.netrc(os.environ.get("NETRC")).authenticators(host) is not None
    return False


def name_series(member: int | None) -> str:
    """The group of charts that a point belongs to."""
    return "population" if member is None else f"member_{member:03d}"


def count_by_kind(environment_steps: int, kinds: Mapping[str, int] | None) -> dict[str, int]:
    """The figures of `log_scaling`: environment steps so far, in all and by kind."""
    return {"environment_steps": environment_steps} | {
        f"environment_steps/{kind}": steps for kind, steps in (kinds or {}).items() if steps
    }


class TensorboardTracker(NoTracker):
    """A folder of event files for the population, whose step is the number of members, and one for each member, whose
    step is its environment steps.

    A run that goes on writes files beside the old ones, in which TensorBoard leaves out what is done again.

    Args:
        run_dir: the run's folder.
    """

    def __init__(self, run_dir: Path) -> None:
        self.folder = run_dir / FOLDER
        self._writers: dict[str, Any] = {}
        self._open, self._goes_on = False, False

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """Later points are written; after an earlier attempt into new files."""
        self._close_writers()
        self._open, self._goes_on = True, resume is not None

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """A scalar for each figure that is finite."""
        if not self._open:
            return
        writer = self._find_writer(name_series(member), step)
        for name, value in metrics.items():
            if math.isfinite(value):
                writer.add_scalar(name, value, step)

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """Environment steps so far, with step = number of members."""
        self.log(count_by_kind(environment_steps, kinds), members)

    def describe(self, text: str, overview: str = "") -> None:
        """The run's text."""
        if self._open:
            self._find_writer(name_series(None), 0).add_text("run", text, 0)

    def flush(self) -> dict[str, Any]:
        """All points are in the files; there is nothing to continue from."""
        for writer in self._writers.values():
            writer.flush()
        return {}

    def finish(self, status: str) -> None:
        """Close the files."""
        self._close_writers()
        self._open = False

    def _find_writer(self, name: str, step: int) -> Any:
        from tensorboardX import SummaryWriter

        if name not in self._writers:
            purge = step if self._goes_on else None
            self._writers[name] = SummaryWriter(str(self.folder / name), purge_step=purge, flush_secs=10)
        return self._writers[name]

    def _close_writers(self) -> None:
        for writer in self._writers.values():
            writer.close()
        self._writers = {}


class WandbTracker(NoTracker):
    """One run of Weights & Biases, with a group of charts for the population and for each member.

    Where it goes is wandb's own matter: WANDB_MODE, WANDB_BASE_URL, `wandb login`. The project is
    `tracking.experiment`. What wandb refuses during training is a warning.

    Args:
        config: of tracking.
        run_dir: the run's folder, which gets wandb's files too.
        run_name: of the run.
        params: (nested) settings of the run.
    """

    def __init__(self, config: TrackingConfig, run_dir: Path, run_name: str, params: Mapping[str, Any]) -> None:
        self.config, self.run_dir, self.run_name, self.params = config, run_dir, run_name, params
        self._run: Any = None
        self._id: str | None = None
        self._series: set[str] = set()

    def start(self, resume: Mapping[str, Any] | None = None) -> None:
        """Begin a run, or go on in that of an earlier attempt.

        Raises:
            UserError: wandb does not begin one.
        """
        if self._run is not None:
            return
        import wandb  # pyright: ignore[reportMissingImports]

        self._id = (resume or {}).get("runs", {}).get("wandb")
        try:
            self._run = wandb.init(
                **{"project": self.config.experiment, "name": self.run_name, "id": self._id, "resume": "allow"},
                **{"dir": str(self.run_dir), "config": dict(self.params)},
                settings=wandb.Settings(console="off", silent=True),
            )
        except (wandb.Error, OSError) as error:
            problem = f"wandb begins no run ({str(error).strip().partition(chr(10))[0]})"
            raise UserError("tracking", problem, "set WANDB_MODE=offline, or use tracking=off") from None
        self._id = str(self._run.id)

    def log(self, metrics: Mapping[str, float], step: int, member: int | None = None) -> None:
        """Figures of a group of charts, over its own steps."""
        name = name_series(member)
        self._try_call(lambda run: self._log_series(run, name, metrics, step))

    def log_scaling(self, members: int, environment_steps: int, kinds: Mapping[str, int] | None = None) -> None:
        """Environment steps so far, over the number of members."""
        self.log(count_by_kind(environment_steps, kinds), members)

    def describe(self, text: str, overview: str = "") -> None:
        """The run's notes."""
        self._try_call(lambda run: setattr(run, "notes", text))

    def flush(self) -> dict[str, Any]:
        """The id to continue by; wandb's own process writes."""
        return {"runs": {"wandb": self._id}} if self._id else {}

    def finish(self, status: str) -> None:
        """End the run: as failed unless it is finished."""
        self._try_call(lambda run: run.finish(exit_code=int(status != "FINISHED")))
        self._run = None

    def _log_series(self, run: Any, name: str, metrics: Mapping[str, float], step: int) -> None:
        if name not in self._series:
            run.define_metric(f"{name}/step", hidden=True)
            run.define_metric(f"{name}/*", step_metric=f"{name}/step")
            self._series.add(name)
        run.log({f"{name}/step": step} | {f"{name}/{figure}": float(value) for figure, value in metrics.items()})

    def _try_call(self, call: Callable[[Any], None]) -> None:
        if self._run is None:
            return
        try:
            call(self._run)
        except Exception as error:  # wandb's own, and those of its transport
            _log.warning("tracking: wandb did not take a write, training goes on (%s)", str(error).partition("\n")[0])
