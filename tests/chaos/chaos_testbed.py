"""Where the campaign's runs take place: a Ray cluster on this machine, and drivers as processes of their own."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from ray.cluster_utils import Cluster

from popgen.population import load_population
from popgen.runs.ledger import Ledger

ROOT = Path(__file__).resolve().parent.parent.parent
HEAD, SECOND = "near", "far"
"""Custom resources: of the head, where actors run, and of a second node, which is there when one is to be lost."""

QUICK_HEALTH_CHECKS = {
    "health_check_initial_delay_ms": 2000,
    "health_check_period_ms": 1000,
    "health_check_failure_threshold": 5,
    "worker_register_timeout_seconds": 300,
}
"""A dead node is noticed in some five seconds instead of fifteen, on a busy machine too."""

SMOKE = (
    *("scale=smoke", "population.size=2", "env.params.horizon=40", "seed=3", "evaluation.episodes=1"),
    *("phase1.max_steps=3200", "phase2.rounds=3", "cluster.sampler_cpus=0.05", "cluster.samplers=2"),
)
DRIVER_SECONDS = 600.0
"""Seconds that a driver may take."""


@dataclass
class Outcome:
    """What one call of `popgen run` gave."""

    code: int
    error: str
    result: dict[str, Any] | None


@dataclass
class Testbed:
    """The cluster, and the folder of all runs."""

    folder: Path
    cluster: Cluster
    node: Any = None
    drivers: list[psutil.Process] = field(default_factory=list)

    @staticmethod
    def open() -> Testbed:
        """Start the head."""
        folder = Path(tempfile.mkdtemp(prefix="pg-chaos-", dir="/tmp"))  # Ray's sockets need a short path
        # A folder of its own: another cluster's address, which Ray keeps in the usual one, stays what it is.
        arguments = {"num_cpus": 4, "resources": {HEAD: 100}, "temp_dir": str(folder), "include_dashboard": False}
        arguments["_system_config"] = QUICK_HEALTH_CHECKS
        cluster = retry_start(lambda: Cluster(initialize_head=True, head_node_args=arguments))
        return Testbed(folder, cluster)

    def add_node(self) -> None:
        """A second node."""
        self.node = retry_start(lambda: self.cluster.add_node(num_cpus=4, resources={SECOND: 100}))

    def remove_node(self) -> None:
        """kill -9 of all processes of the second node."""
        self.cluster.remove_node(self.node, allow_graceful=False)
        self.node = None

    def close(self, keep: bool = False) -> None:
        """End everything that was started here, and remove the folder unless there is something to look at in it."""
        for process in self.drivers:
            send_signal(process)
        self.cluster.shutdown()
        if keep:
            print(f"kept: {self.folder}", flush=True)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)

    # ---- drivers ---------------------------------------------------------------------------------------------------

    def list_settings(self, run: str, *more: str, root: Path | None = None, place: tuple[str, ...] = ()) -> list[str]:
        """Of a small run, in this cluster if no other `place` is given."""
        place = place or (f"cluster.address={self.cluster.address}", f"cluster.resources.{HEAD}=1")
        return [*SMOKE, *place, f"run.root={root or self.folder / 'runs'}", f"run.id={run}", *more]

    def start(self, overrides: list[str], log: Path) -> subprocess.Popen[bytes]:
        """`popgen run` as a process of its own."""
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as out, log.with_suffix(".err").open("wb") as errors:
            command = [sys.executable, "-m", "popgen", "run", "--json", "--quiet", *overrides]
            process = subprocess.Popen(
                command, stdout=out, stderr=errors, env=environment, cwd=ROOT, start_new_session=True
            )
        self.drivers.append(psutil.Process(process.pid))
        return process

    def finish(self, process: subprocess.Popen[bytes], log: Path) -> Outcome:
        """Wait for a driver's end."""
        code = process.wait(timeout=DRIVER_SECONDS)
        text = log.with_suffix(".err").read_text(errors="replace")
        error_lines = [line for line in text.splitlines() if line.startswith("popgen: ")]
        if "Traceback (most recent call last)" in text:
            error_lines.insert(0, "TRACEBACK " + text.strip().splitlines()[-1])
        answer = [line for line in log.read_text(errors="replace").splitlines() if line.startswith("{")]
        return Outcome(code, " / ".join(error_lines), json.loads(answer[-1]) if code == 0 and answer else None)

    def find_actors(self, pattern: str) -> list[psutil.Process]:
        """Actor processes whose title matches, below this process or a driver of ours."""
        found = []
        for process in psutil.Process().children(recursive=True):
            try:
                title = " ".join(process.cmdline())
            except psutil.Error:
                continue
            if title.startswith("ray::") and not title.startswith("ray::IDLE") and re.search(pattern, title):
                found.append(process)
        return sorted(found, key=lambda process: process.pid)


def retry_start(act: Callable[[], Any], tries: int = 4) -> Any:
    """Ray gives its processes half a minute to start, which on a busy machine may be too short."""
    for left in reversed(range(tries)):
        try:
            return act()
        except Exception:  # Ray raises that very class
            if not left:
                raise
    return None


def send_signal(process: psutil.Process, number: int = signal.SIGKILL) -> None:
    """Send a signal to a process that may be gone."""
    try:
        process.send_signal(number)
    except psutil.Error:
        return


def wait_until(ask: Callable[[], Any], process: subprocess.Popen[bytes]) -> Any:
    """The first true answer; None if the driver ends before."""
    while process.poll() is None:
        if answer := ask():
            return answer
        time.sleep(0.005)
    return None


def count_events(run: Path) -> int:
    """Lines of the run's log: how far it has come, over all attempts."""
    path = run / "run.log"
    return path.read_bytes().count(b"\n") if path.exists() else 0


@dataclass(frozen=True)
class RunFigures:
    """What must be the same, whatever happened: weights, entries and totals of the ledger."""

    weights: tuple[str, ...]
    entries: Counter[tuple[Any, ...]]
    totals: dict[str, Any]

    @staticmethod
    def read(run: Path) -> RunFigures:
        ledger = Ledger(run / "ledger.jsonl")
        entries = Counter((e.member, str(e.kind), e.sampler.partition(".")[0], e.steps, e.episodes) for e in ledger)
        members = load_population(run / "population").members
        return RunFigures(tuple(info.policy_sha256 for info in members), entries, ledger.table())


def count_repeated_steps(run: Path) -> int:
    """Environment steps that were done again."""
    aside = run / "ledger.lost.jsonl"
    return sum(entry.steps for entry in Ledger(aside)) if aside.exists() else 0
