"""The main job: a population by any method, its evaluation and its report.

A method is a driver: a class that trains the members which the run's recorder do not hold yet.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module
from typing import Any, Protocol

import numpy as np
import ray
from ray.exceptions import RayError

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.evaluation.crossplay import evaluate_population
from popgen.pipelines.crew import start_ray
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.reports.crossplay_report import to_dict, write_report
from popgen.reports.method_titles import title_of
from popgen.reports.run_figures import write_run_figures
from popgen.runs.directory import RunState
from popgen.runs.monitoring import LoggingReporter, gauge
from popgen.runs.recorder import RunRecorder, named, run_folder
from popgen.runs.recovery import RetryBudget, death, first_line, nodes_alive, told, wait_for_room
from popgen.runs.storage import Mirror

DRIVERS: dict[str, str] = {
    "xpm_wm": "popgen.pipelines.xpm_wm_driver:XpmWm",
    "xpm_sim": "popgen.pipelines.xpm_sim_driver:XpmSim",
    "mappo": "popgen.pipelines.baseline_driver:Mappo",
    "lipo": "popgen.pipelines.baseline_driver:Lipo",
    "comedi": "popgen.pipelines.baseline_driver:CoMeDi",
}
"""method -> `module:class`, imported when first needed."""


class Driver(Protocol):
    """Trains the members of one run."""

    def __init__(self, config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> None:
        """RunRecorder and Ray are open; nothing of the method has started."""

    def run(self) -> None:
        """Train every member that `recorder.population` does not hold, and add it with `recorder.add_member`.

        Every environment step is in `recorder.ledger` before the member that it was spent on is added. An interrupted
        run is resumed by the same call of a new driver with a new recorder on the same folder: in another process, or
        in this one after an actor or a node died, for which `run` raises Ray's error once its own actors are gone.

        Raises:
            FloatingPointError: training diverged.
            UserError: a checkpoint to go on from is damaged.
        """


def driver_class(method: str) -> type[Driver]:
    """The driver of a method."""
    module, _, name = DRIVERS[method].partition(":")
    return getattr(import_module(module), name)


def run_population(config: RunConfig, *, reporter: Reporter) -> dict[str, Any]:
    """Train a population by `config.method` and evaluate it, over the deaths of actors and nodes.

    Args:
        config: a validated run.
        reporter: told of progress.

    Returns:
        run_id, run_dir, population (path), members (count), ledger (steps by member and kind), matrix and evaluation
        (`popgen.reports.crossplay_report`), files (paths by name or suffix), seconds.

    Raises:
        UserError: training diverged, the disk is (nearly) full, a checkpoint to go on from is damaged, another process
            is at this run, or actors died `cluster.retries` times in a row without progress.
    """
    limit_threads(config.cluster.threads)
    spec = build_env(config.env, 1).spec
    config = named(config)
    if config.run.storage:
        RunState.check_free(run_folder(config))  # the copy would be put in place of what its driver writes to
        if restored := Mirror(run_folder(config), config.run.storage).pull():
            reporter.note(restored)
    recorder = RunRecorder(config, spec)
    reporter.note(f"run {recorder.run_id} in {recorder.dir}")
    job = _Job(config, spec, recorder, reporter)
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
        if (known := told(error)) is error:
            raise
        raise known from None
    finally:
        try:
            job.recorder.close(status, None if status == "FINISHED" else sys.exception())
        finally:
            job.end()


class _Job:
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
                cause = death(error)
                if cause is None:
                    raise
                retries.spend(self.recorder.progress(), cause)
                lost = first_line(cause)
            # Outside of the except clause: the error's frames hold what is left of the last attempt.
            self._go_on(lost, retries.spent)

    def _start_ray(self) -> None:
        """Connect to a cluster and wait for its nodes, or start a local Ray, unless there is one."""
        self.mine = start_ray(self.config)
        if self.mine and self.config.cluster.address is not None:
            wait_for_room(self.config, self.reporter.note)

    def _attempt(self) -> dict[str, Any]:
        recorder = self.recorder
        reporter = LoggingReporter(self.reporter, recorder.events)
        recorder.tracker.start()
        recorder.save_tracking()
        driver_class(self.config.method)(self.config, self.spec, recorder, reporter).run()
        result = finish(self.config, self.spec, recorder, reporter)
        return result | {"seconds": round(time.time() - self.began, 1)}

    def _go_on(self, lost: str, spent: int) -> None:
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


def finish(config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> dict[str, Any]:
    """Evaluate the population, write the report, return the summary (keys: see `run_population`)."""
    path = recorder.dir / "population"
    reporter.phase("evaluation", 1)
    result = evaluate_population(
        load_population(path),
        config.evaluation.episodes,
        config.run.seed,
        progress=lambda done, total: reporter.update(done / total, episodes=done),
    )
    files = write_report(result, recorder.dir / "report")
    size = len(recorder.population)
    episodes = result.episodes * len(result.pairings)
    recorder.record_evaluation(size, result.steps, episodes)
    title = f"{spec.name}, {title_of(config.method)}, seed {config.run.seed}"
    files |= write_run_figures(
        recorder.dir, recorder.dir / "report", recorder.member_steps(), unit=spec.score_name, title=title
    )
    recorder.log_artefacts(files.values())
    figures = {"sp": result.sp.mean, "xp": result.xp.mean}
    recorder.tracker.log({name: value for name, value in figures.items() if np.isfinite(value)}, step=size)
    evaluation = to_dict(result)
    return {
        "run_id": recorder.run_id,
        "run_dir": str(recorder.dir),
        "population": str(path),
        "members": size,
        "ledger": recorder.ledger.table(),
        "matrix": evaluation["matrix"],
        "evaluation": evaluation,
        "files": {suffix: str(file) for suffix, file in files.items()},
        "seconds": round(time.time() - recorder.began, 1),
    }
