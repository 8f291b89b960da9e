"""A sweep on Ray Tune, killed and continued."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import ray  # noqa: F401  (marks this file)
from conftest import ROOT

SETTINGS = ("scale=smoke", "population.size=1", "evaluation.episodes=1", "run.transport=inline", "tracking=off")
LIMIT = 240.0  # seconds, of a busy machine


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "popgen", "sweep", *words, *SETTINGS, "--out", "sweep", "--json", "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


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
