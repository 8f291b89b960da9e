"""A sweep: many runs on Ray Tune, each a `popgen run` of its own process, and one report of all.

Tune gives every run its share of the machine or cluster and keeps as many going as fit. What a run has learned is in
its own folder: a sweep that ended early goes on by the same command, which leaves finished runs alone and lets
interrupted ones continue from their last checkpoints.
"""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ray
from ray import tune

from popgen.actors.local_ray import start_ray
from popgen.config.run_config import RunConfig
from popgen.progress import Reporter
from popgen.reports.run_record import is_finished, read_run
from popgen.reports.sweep_report import SweptRun, build_report, write_report
from popgen.runs.resources import demands, places, total
from popgen.runs.supervisor import end_with_parent

STORE_BYTES = 80 * 2**20
"""Of the sweep's own Ray, which carries no data."""

_OURS = {"TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1", "TUNE_DISABLE_SIGINT_HANDLER": "1", "RAY_CHDIR_TO_TRIAL_DIR": "0"}


@dataclass(frozen=True)
class SweepRun:
    """A run of a sweep.

    Attributes:
        config: checked, with root and id.
        words: overrides that give this config.
        settings: values of the settings that the sweep varies, seeds aside.
    """

    config: RunConfig
    words: tuple[str, ...]
    settings: Mapping[str, Any]

    @property
    def folder(self) -> Path:
        """Of the run."""
        return Path(self.config.run.root) / str(self.config.run.id)

    @property
    def log(self) -> Path:
        """What its process says."""
        return Path(self.config.run.root) / f"{self.config.run.id}.log"

    def command(self, config_dir: str | None) -> list[str]:
        """Of its process."""
        place = [f"run.root={json.dumps(self.config.run.root)}", f"run.id={self.config.run.id}", "--json"]
        presets = [] if config_dir is None else ["--config-dir", config_dir]
        return [sys.executable, "-m", "popgen", "run", *self.words, *place, *presets]


def run_sweep(
    runs: Sequence[SweepRun],
    varied: Sequence[str],
    out: Path,
    *,
    concurrent: int,
    config_dir: str | None,
    reporter: Reporter,
) -> dict[str, Any]:
    """Run what is not finished, and report on all that is.

    Args:
        runs: all of the sweep, finished ones too.
        varied: settings that it varies, seeds aside.
        out: folder of the report.
        concurrent: runs at a time at most; 0: as many as find room.
        config_dir: the user's own presets.
        reporter: told of progress.

    Returns:
        The object of `popgen.reports.sweep_report`, and `files` (paths by name).
    """
    pending = [run for run in runs if not is_finished(run.folder)]
    reporter.phase(f"sweep of {len(runs)} runs", len(runs))
    reporter.update(len(runs) - len(pending))
    if pending:
        run_on_tune(pending, out, concurrent, config_dir, reporter, done=len(runs) - len(pending))
    finished = [run for run in runs if is_finished(run.folder)]
    missing = {str(run.config.run.id): last_line(run.log) for run in runs if run not in finished}
    swept = [SweptRun(read_run(run.folder), run.settings) for run in finished]
    report = build_report(swept, varied, missing)
    files = write_report(report, out) if swept else {}
    return report | {"files": {name: str(path) for name, path in files.items()}}


def run_on_tune(
    runs: Sequence[SweepRun], out: Path, concurrent: int, config_dir: str | None, reporter: Reporter, done: int
) -> None:
    """Let Tune start the runs' processes as room allows, until all have ended."""
    os.environ |= _OURS
    logging.getLogger("ray.tune").setLevel(logging.ERROR)
    largest = max(runs, key=lambda run: total(demands(run.config)).get("CPU", 0.0)).config
    cluster = largest.cluster.model_copy(update={"object_store_bytes": STORE_BYTES})
    mine = start_ray(largest.model_copy(update={"cluster": cluster}))
    local = cluster.address is None
    shutil.rmtree(out / "tune", ignore_errors=True)  # its states; the runs' own are in their folders
    trials = [describe_trial(run, config_dir, local) for run in runs]
    most = concurrent or (None if local else count_room(runs))
    tuner = tune.Tuner(
        tune.with_resources(run_trial, trial_resources),
        param_space={"trial": tune.grid_search(trials)},
        tune_config=tune.TuneConfig(max_concurrent_trials=most),
        run_config=tune.RunConfig(
            name="tune",
            storage_path=str(out.absolute()),
            verbose=0,
            callbacks=[TrialProgress(reporter, done)],
        ),
    )
    try:
        with redirect_stdout(io.StringIO()):  # of Tune, whose table is no part of our result
            tuner.fit()
    finally:
        if mine:
            ray.shutdown()


def describe_trial(run: SweepRun, config_dir: str | None, local: bool) -> dict[str, Any]:
    """What Tune's worker needs of a run: plain values.

    On a cluster the run's actors find their own room; its process stays on this node, with the files.
    """
    if not local:
        amounts = {f"node:{ray.util.get_node_ip_address()}": 0.001}
    elif run.config.run.transport == "inline":
        amounts = {"CPU": 1.0}
    else:  # the driver takes a core itself where no actor does
        amounts = {name: amount for name, amount in total(demands(run.config)).items() if amount} or {"CPU": 1.0}
    return {
        "name": str(run.config.run.id),
        "command": run.command(config_dir),
        "folder": str(run.folder.absolute()),
        "log": str(run.log.absolute()),
        "cwd": os.getcwd(),
        "local": local,
        "amounts": amounts,
    }


def trial_resources(space: Mapping[str, Any]) -> tune.PlacementGroupFactory:
    """What Tune holds for a trial while it runs."""
    return tune.PlacementGroupFactory([dict(space["trial"]["amounts"])])


def count_room(runs: Sequence[SweepRun]) -> int:
    """How many of the largest run find room on the cluster at a time."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    room = [places(total(demands(run.config)), nodes, len(runs)) for run in runs]
    return max(1, min(room))


def run_trial(space: Mapping[str, Any]) -> None:
    """In Tune's worker: one run's process, to its end.

    Raises:
        RuntimeError: it failed; the last line that it said.
    """
    trial = space["trial"]
    log = Path(trial["log"])
    log.parent.mkdir(parents=True, exist_ok=True)
    # Without what Ray told this worker: a local run starts a Ray of its own.
    kept = {k: v for k, v in os.environ.items() if not (trial["local"] and k.startswith("RAY_")) and k not in _OURS}
    with log.open("ab") as file:
        process = subprocess.Popen(
            trial["command"], cwd=trial["cwd"], env=kept, stdout=subprocess.DEVNULL, stderr=file,
            preexec_fn=end_with_parent,
        )  # fmt: skip
        code = process.wait()
    if not is_finished(trial["folder"]):  # a run with a weak member has an exit code of its own, and is finished
        raise RuntimeError(f"{trial['name']} ended with {code}: {last_line(log)}")
    scores = read_run(trial["folder"]).scores
    tune.report({name: scores[name]["mean"] for name in ("sp", "xp")})


def last_line(path: Path) -> str:
    """What a process said last; of one that was not started that it was not."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        return "was not started"
    return lines[-1].removeprefix("popgen: error: ")[:300] if lines else "said nothing"


class TrialProgress(tune.Callback):
    """Tells the reporter what Tune's trials do."""

    def __init__(self, reporter: Reporter | None, done: int) -> None:
        self.reporter, self.done = reporter, done

    def __getstate__(self) -> dict[str, Any]:
        """Tune keeps its callbacks on disk, where a terminal has no place."""
        return {"reporter": None, "done": self.done}

    def on_trial_start(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A run begins."""
        if self.reporter is not None:
            self.reporter.note(
                f"{trial.config['trial']['name']} begins, its progress is in {trial.config['trial']['log']}"
            )

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A run has ended well."""
        self._count_trial(f"{trial.config['trial']['name']} is finished")

    def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """A run has failed."""
        told = trial.config["trial"]
        self._count_trial(f"{told['name']} failed: {last_line(Path(told['log']))}")

    def _count_trial(self, text: str) -> None:
        self.done += 1
        if self.reporter is not None:
            self.reporter.note(text)
            self.reporter.update(self.done)
