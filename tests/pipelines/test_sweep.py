"""A sweep on Ray Tune, killed and continued."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import ray  # noqa: F401  (marks this file)
from conftest import ROOT

from popgen.methods.registry import recipe
from popgen.pipelines.sweep import SweepRun, describe_trial, trial_resources

SETTINGS = ("scale=smoke", "population.size=1", "evaluation.episodes=1", "run.transport=inline", "tracking=off")
LIMIT = 240.0  # seconds, of a busy machine


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "popgen", "sweep", *words, *SETTINGS, "--out", "sweep", "--json", "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


def test_a_run_whose_driver_does_all_the_work_holds_a_core() -> None:
    """Baselines on RLlib have no actors at first: Tune refuses a trial that holds nothing."""
    for method, cores in (("mappo", 1.0), ("xpm_wm", 1.9)):
        config = recipe(method, scale="smoke")
        named = config.model_copy(update={"run": config.run.model_copy(update={"transport": "ray", "id": method})})
        trial = describe_trial(SweepRun(named, (), {}), None, local=True)
        assert trial["amounts"] == {"CPU": pytest.approx(cores)}
        assert trial_resources({"trial": trial}).required_resources["CPU"] == pytest.approx(cores)


def test_a_killed_sweep_goes_on_and_keeps_what_is_finished(tmp_path: Path) -> None:
    words = ("method=xpm_sim", "seed=1,2", "xpm_sim.updates=2")
    first = start(tmp_path, *words)
    runs, deadline = tmp_path / "sweep" / "runs", time.time() + LIMIT
    while not (done := list(runs.glob("*/report/crossplay.json"))):
        assert first.poll() is None and time.time() < deadline
        time.sleep(0.05)
    os.kill(first.pid, signal.SIGKILL)
    first.communicate()
    before = {path: path.stat().st_mtime_ns for path in done}
    out, err = start(tmp_path, *words).communicate(timeout=LIMIT)
    report = json.loads(out)
    assert len(report["runs"]) == 2 and report["missing"] == [], err
    assert [(group["settings"], group["seeds"]) for group in report["groups"]] == [({}, [1, 2])]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert (tmp_path / "sweep" / "sweep.md").read_text().count("XPM-Sim") >= 1
