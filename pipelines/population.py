"""The main job: a population by any method, its evaluation and its report.

A method is a driver: a class that trains the members which the run's books do not hold yet.
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any, Protocol

import numpy as np
import ray

from actors.common import build_env, settle
from pipelines.books import Books
from pipelines.crew import start_ray
from pipelines.report import write_run_figures
from popgen.config import RunConfig
from popgen.envs.base import EnvSpec
from popgen.errors import UserError
from popgen.evaluation.crossplay import evaluate_population
from popgen.evaluation.report import to_dict, write_report
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.types import Kind

DRIVERS: dict[str, str] = {
    "xpm_wm": "pipelines.xpm_wm:XpmWm",
    "xpm_sim": "pipelines.xpm_sim:XpmSim",
    "mappo": "pipelines.baselines:Mappo",
    "lipo": "pipelines.baselines:Lipo",
    "comedi": "pipelines.baselines:CoMeDi",
}
"""method -> `module:class`, imported when first needed."""


class Driver(Protocol):
    """Trains the members of one run."""

    def __init__(self, config: RunConfig, spec: EnvSpec, books: Books, reporter: Reporter) -> None:
        """Books and Ray are open; nothing of the method has started."""

    def run(self) -> None:
        """Train every member that `books.population` does not hold, and add it with `books.add_member`.

        Every environment step goes to `books.ledger` before the member that it was spent on is added. An
        interrupted run is the same call again.

        Raises:
            FloatingPointError: training diverged.
            UserError: a checkpoint to go on from is damaged.
        """


def driver_class(method: str) -> type[Driver]:
    """The driver of a method."""
    module, _, name = DRIVERS[method].partition(":")
    return getattr(import_module(module), name)


def run_population(config: RunConfig, *, reporter: Reporter) -> dict[str, Any]:
    """Train a population by `config.method` and evaluate it.

    Args:
        config: a validated run.
        reporter: told of progress.

    Returns:
        run_id, run_dir, population (path), members (count), ledger (steps by member and kind), matrix and evaluation
        (`popgen.evaluation.report`), files (paths by name or suffix), seconds.

    Raises:
        UserError: training diverged, the disk is full, or a checkpoint to go on from is damaged.
    """
    settle(config.cluster.threads)
    spec = build_env(config.env, 1).spec
    books = Books(config, spec)
    reporter.note(f"run {books.run_id} in {books.dir}")
    mine, status = False, "FAILED"
    try:
        mine = start_ray(config.cluster)
        books.tracker.start()
        books.save_tracking()
        driver_class(config.method)(config, spec, books, reporter).run()
        result = finish(config, spec, books, reporter)
        status = "FINISHED"
        return result
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    except FloatingPointError as error:  # of a learner; Ray wraps it in an error of both types
        raise UserError("training", str(getattr(error, "cause", error)), "lower the learning rates") from None
    finally:
        books.close(status)
        if mine:
            ray.shutdown()


def finish(config: RunConfig, spec: EnvSpec, books: Books, reporter: Reporter) -> dict[str, Any]:
    """Evaluate the population, write the report, return the summary (keys: see `run_population`)."""
    path = books.dir / "population"
    reporter.phase("evaluation", 1)
    result = evaluate_population(
        load_population(path),
        config.evaluation.episodes,
        config.run.seed,
        progress=lambda done, total: reporter.update(done / total, episodes=done),
    )
    files = write_report(result, books.dir / "report")
    size = len(books.population)
    episodes = result.episodes * len(result.pairings)
    books.record_steps(size, Kind.EVALUATION, f"evaluation.{books.attempt}", 0, result.steps, episodes)
    files |= write_run_figures(
        books.dir, books.dir / "report", books.member_steps(), unit=spec.score_name, title=spec.name
    )
    for file in files.values():
        books.tracker.log_artifact(file, "report")
    figures = {"sp": result.sp.mean, "xp": result.xp.mean}
    books.tracker.log({name: value for name, value in figures.items() if np.isfinite(value)}, step=size)
    evaluation = to_dict(result)
    return {
        "run_id": books.run_id,
        "run_dir": str(books.dir),
        "population": str(path),
        "members": size,
        "ledger": books.ledger.table(),
        "matrix": evaluation["matrix"],
        "evaluation": evaluation,
        "files": {suffix: str(file) for suffix, file in files.items()},
        "seconds": round(time.time() - books.began, 1),
    }
