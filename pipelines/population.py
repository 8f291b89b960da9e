"""The main job: a population by any method, its evaluation and its report, over the deaths of actors and nodes."""

from __future__ import annotations

import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import ray
from ray.exceptions import RayError

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.actors.local_ray import start_ray
from popgen.actors.ray_transport import RayTransport
from popgen.actors.tracker_actor import RemoteTracker
from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.evaluation.crossplay import evaluate_population
from popgen.methods.registry import METHODS
from popgen.methods.training import InlineTransport, Training, Transport
from popgen.pages.report_source import read_source
from popgen.pages.run_report import list_findings, write_run_report
from popgen.pipelines.training_driver import TrainingDriver
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.reports.crossplay_report import list_warnings, to_dict, write_report
from popgen.reports.method_titles import title_of
from popgen.reports.run_description import describe_experiment, describe_run
from popgen.reports.run_figures import write_run_figures
from popgen.runs.chart_trackers import FOLDER, OFFLINE, TensorboardTracker, WandbTracker
from popgen.runs.checkpoints import CheckpointFiles
from popgen.runs.directory import RunState, named, run_folder
from popgen.runs.mlflow_tracker import LocalTracker, address_in_mlflow, choose_store
from popgen.runs.recorder import RunRecorder
from popgen.runs.recovery import RetryBudget, actor_failure, first_line, nodes_alive, user_facing_error, wait_for_room
from popgen.runs.sinks import LoggingReporter, NoTracker, TrackerClient, gauge
from popgen.runs.storage import Mirror

HALT_SECONDS = 30.0
"""Least time between two checkpoints where all overlapping work halts for one."""


def open_training(config: RunConfig, spec: EnvSpec, attempt: str, transport: Transport) -> Training:
    """Start the workers of the run's method."""
    return METHODS[config.method].load_training()(config, spec, attempt, transport)


def run_population(config: RunConfig, *, reporter: Reporter) -> dict[str, Any]:
    """Train a population by `config.method` and evaluate it, over the deaths of actors and nodes.

    Args:
        config: a validated run.
        reporter: told of progress.

    Returns:
        run_id, run_dir, population (path), members (count), ledger (steps by member and kind), matrix and evaluation
        (`popgen.reports.crossplay_report`), warnings (what of it speaks against low cross-play, in sentences), tracking
        (writer, command and address that show the run; None with tracking=off), findings (text and good: what the
        figures mean), files (paths by name or suffix), seconds.

    Raises:
        UserError: training diverged, the disk is (nearly) full, a checkpoint to continue from is damaged, another
            process is at this run, or actors died `cluster.retries` times in a row without progress.
    """
    limit_threads(config.cluster.threads)
    spec = build_env(config.env, 1).spec
    config = named(config)
    if config.run.storage:
        RunState.check_free(run_folder(config))  # the copy would be put in place of what its driver writes to
        if restored := Mirror(run_folder(config), config.run.storage).pull():
            reporter.note(restored)
    recorder = RunRecorder(config, spec, make_tracker(config))
    reporter.note(f"run {recorder.run_id} in {recorder.dir}")
    job = PopulationJob(config, spec, recorder, reporter)
    status = "FAILED"
    try:
        result = job.run()
        status = "FINISHED"
        return result
    except (KeyboardInterrupt, SystemExit):  # Ray turns SIGTERM into the latter
        status = "KILLED"
        raise
    except FloatingPointError as error:  # of a learner; Ray wraps it in an error of both types
        raise UserError("training", str(getattr(error, "cause", error)), "lower the learning rates") from None
    except RayError as error:
        if (known := user_facing_error(error)) is error:
            raise
        raise known from None
    finally:
        try:
            job.recorder.close(status, None if status == "FINISHED" else sys.exception())
        finally:
            job.end()


def make_tracker(config: RunConfig) -> TrackerClient:
    """What `tracking` asks for, not yet started: MLflow's in an actor of its own where the run has Ray."""
    folder, name = run_folder(config), str(config.run.id)
    if not config.tracking.enabled:
        return NoTracker()
    if config.tracking.writer == "tensorboard":
        return TensorboardTracker(folder)
    if config.tracking.writer == "wandb":
        return WandbTracker(config.tracking, folder, name, config.as_dict())
    kind = RemoteTracker if config.run.transport == "ray" else LocalTracker
    return kind(config.tracking, folder, name, config.as_dict(), store=choose_store(folder, config.run.storage))


class PopulationJob:
    """One run in this process: attempts, until one of them reaches the end."""

    def __init__(self, config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> None:
        self.config, self.spec, self.recorder, self.reporter = config, spec, recorder, reporter
        self.began, self.mine = time.time(), False

    def run(self) -> dict[str, Any]:
        """Train and evaluate; after a death everything again from the recorder on disk."""
        retries = RetryBudget(self.config.cluster.retries)
        self._start_ray()
        while True:
            try:
                return self._attempt()
            except Exception as error:
                cause = actor_failure(error)
                if cause is None:
                    raise
                retries.spend(self.recorder.progress(), cause)
                lost = first_line(cause)
            # Outside of the except clause: the error's frames hold what is left of the last attempt.
            self._continue_from_disk(lost, retries.spent)

    @property
    def uses_ray(self) -> bool:
        """Workers are Ray's actors."""
        return self.config.run.transport == "ray"

    def _start_ray(self) -> None:
        """Connect to a cluster and wait for its nodes, or start a local Ray, unless there is one."""
        if not self.uses_ray:
            return
        self.reporter.phase("starting Ray", 0)
        self.mine = start_ray(self.config)
        if self.mine and self.config.cluster.address is not None:
            wait_for_room(self.config, self.reporter.note)

    def _attempt(self) -> dict[str, Any]:
        recorder = self.recorder
        reporter = LoggingReporter(self.reporter, recorder.events)
        recorder.start_tracking()
        self.train_members(recorder, reporter)
        result = finish(self.config, self.spec, recorder, reporter)
        return result | {"seconds": round(time.time() - self.began, 1)}

    def train_members(self, recorder: RunRecorder, reporter: Reporter) -> None:
        """All members that are missing; the workers end with the attempt."""
        config = self.config
        transport: Transport = RayTransport(config.cluster) if self.uses_ray else InlineTransport()
        reporter.phase("starting workers", 0)
        training = open_training(config, self.spec, f"{recorder.run_id}.{recorder.attempt}", transport)
        try:
            checkpoints = open_checkpoints(config, recorder.dir, training, transport)
            try:
                TrainingDriver(config, recorder, reporter, training, checkpoints).train_members()
            finally:
                checkpoints.close()
        finally:
            training.close()

    def _continue_from_disk(self, lost: str, spent: int) -> None:
        """Another recorder, on a cluster with room. A local Ray that lost its node starts anew; so does, after a second
        death at the same place, any connection that this job has made."""
        self.reporter.note(f"{lost}: going on from the last checkpoint")
        self.recorder.events.write("lost", level="WARNING", text=lost)
        self.recorder.hand_over(RuntimeError(lost))
        tracker = self.recorder.tracker
        local = self.config.cluster.address is None
        if self.mine and (spent > 1 or local and not nodes_alive()):
            tracker.forget()
            ray.shutdown()
            self._start_ray()
        wait_for_room(self.config, self.reporter.note)
        self.recorder = RunRecorder(self.config, self.spec, tracker)
        gauge("popgen_restarts", self.recorder.attempt - 1, run=self.recorder.run_id)

    def end(self) -> None:
        """Ray ends with the job that started it."""
        if self.mine:
            ray.shutdown()


def open_checkpoints(config: RunConfig, root: Path, training: Training, transport: Transport) -> CheckpointFiles:
    """The run's checkpoints, written on the driver's node by a worker of its own where there is bulk to write."""
    least = HALT_SECONDS if config.run.schedule == "async" and training.log_rows > 1 else 0.0
    return CheckpointFiles(
        root,
        long=training.log_rows,
        seconds=max(config.run.checkpoint_seconds, least),
        transport=transport if training.log_rows > 1 else InlineTransport(),
    )


def finish(config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> dict[str, Any]:
    """Evaluate the population, write the report, return the summary (keys: see `run_population`)."""
    path = recorder.dir / "population"
    reporter.expect(None)  # the last phase has an estimate of its own
    reporter.phase("evaluation", 1)
    result = evaluate_population(
        load_population(path),
        config.evaluation.episodes,
        config.run.seed,
        progress=lambda done, total: reporter.update(done / total, episodes=done),
    )
    reporter.phase("report", 0)
    files = write_report(result, recorder.dir / "report")
    size = len(recorder.population)
    episodes = result.count_episodes()
    recorder.record_evaluation(result.steps, episodes)
    title = f"{spec.name}, {title_of(config.method)}, seed {config.run.seed}"
    files |= write_run_figures(
        recorder.dir, recorder.dir / "report", recorder.member_steps(), unit=spec.score_name, title=title
    )
    source = read_source(recorder.dir)
    files["report"] = write_run_report(source, seed=config.run.seed)["report"]
    recorder.log_artefacts(files.values())
    figures = {"sp": result.sp.mean, "xp": result.xp.mean}
    recorder.tracker.log({name: value for name, value in figures.items() if np.isfinite(value)}, step=size)
    recorder.tracker.describe(describe_run(source.run, list_findings(source)), describe_experiment(recorder.dir))
    evaluation = to_dict(result)
    for line in source.run.weak_members:
        recorder.events.write("weak", level="WARNING", text=line)
    return {
        "run_id": recorder.run_id,
        "run_dir": str(recorder.dir),
        "population": str(path),
        "members": size,
        "ledger": recorder.ledger.table(),
        "matrix": evaluation["matrix"],
        "evaluation": evaluation,
        "tracking": find_tracked(config, recorder),
        "warnings": list_warnings(evaluation),
        "weak_members": list(source.run.weak_members),
        "findings": [finding.as_dict() for finding in list_findings(source)],
        "files": {suffix: str(file) for suffix, file in files.items()},
        "seconds": round(time.time() - recorder.began, 1),
    }


def find_tracked(config: RunConfig, recorder: RunRecorder) -> dict[str, str] | None:
    """Where to look at the run: writer, command and address, an empty one where there is none to give."""
    tracking = config.tracking
    if not tracking.enabled:
        return None
    if tracking.writer == "tensorboard":
        command = f"tensorboard --logdir {shlex.quote(str(recorder.dir / FOLDER))}"
        return {"writer": tracking.writer, "command": command, "address": ""}
    state = recorder.tracker.flush()
    if tracking.writer == "wandb":
        here = f"wandb sync {shlex.quote(str(recorder.dir / 'wandb'))}/offline-run-*"
        offline = os.environ.get("WANDB_MODE") in OFFLINE
        address = "" if offline else f"the run {recorder.run_id} of the project {tracking.experiment}"
        return {"writer": tracking.writer, "command": here if offline else "", "address": address}
    store = choose_store(recorder.dir, config.run.storage)
    return {"writer": tracking.writer, **address_in_mlflow(tracking, state, store)}
