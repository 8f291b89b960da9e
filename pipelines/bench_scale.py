"""How sampling and learning scale: rounds of member 1 with 1, 2, 4 ... samplers on this machine, and a model of more.

Samplers are emulated: they share this machine's cores. What a round costs each of them is therefore measured in
seconds of processor time, from which the model says how long a round takes where each has a core of its own.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import ray

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.config.run_config import RunConfig
from popgen.pipelines.crew import start_ray
from popgen.pipelines.first_member import LEARNERS, FirstMember
from popgen.pipelines.xpm_wm_driver import XpmWm
from popgen.progress import NullReporter
from popgen.runs.recorder import RunRecorder

NODES = (1, 2, 4, 8, 16, 32, 64)
NETWORK = 1.0e9
"""Bytes a second into the node of the replays: ten gigabit Ethernet, less its overheads."""

ASSUMPTIONS = (
    "each sampler and each learner has a processor core of its own, as fast as one here",
    f"segments of all samplers reach the replays' node at {NETWORK / 1e9:g} GB/s; weights are small beside them",
    "a round of a sampler costs what it costs here; one driver takes all segments in, one after the other",
    "samplers wait for the slowest learner (at most one round ahead), learners do not wait for each other",
)


@dataclass(frozen=True)
class Costs:
    """Of one round, in seconds of processor time (bytes for `data`): of one sampler's, of each learner's.

    steps: environment steps of one sampler in a round; sampler; driver: taking one sampler's round in; model, agent;
    data: bytes of one sampler's segments.
    """

    steps: float
    sampler: float
    driver: float
    model: float
    agent: float
    data: float

    def predict(self, samplers: int, overlap: int, cores: float | None = None) -> dict[str, float]:
        """steps_per_second, and idle_LEARNER as shares, with so many samplers; on `cores` that all share, if given."""
        sampling = max(self.sampler, samplers * self.driver, samplers * self.data / NETWORK)
        passed = max(sampling, self.model, self.agent)
        if cores is not None:
            passed = max(passed, (samplers * (self.sampler + self.driver) + self.model + self.agent) / cores)
        # A learner stops only where it is `overlap` rounds ahead of the samplers.
        idle = {f"idle_{name}": max(0.0, 1.0 - overlap * getattr(self, name) / sampling) for name in LEARNERS}
        return {"steps_per_second": samplers * self.steps / passed, **idle}


class Timed(FirstMember):
    """Member 1's rounds for a given time, the first few rounds not counted."""

    WARM = 2

    def measure(self, seconds: float) -> dict[str, Any]:
        """Rounds, steps and processor time since the warm-up."""
        self.seconds, self.mark, self.driver_cpu = seconds, None, 0.0
        self.train(None)
        assert self.mark is not None
        began, rounds, steps, cpu, busy, driver_cpu, done = self.mark
        passed = time.perf_counter() - began
        return {
            "seconds": passed,
            "rounds": self.rounds - rounds,
            "steps": self.driver.steps - steps,
            "cpu": {name: self.cpu[name] - cpu[name] for name in self.cpu},
            "driver_cpu": self.driver_cpu - driver_cpu,
            "idle": {name: max(0.0, 1.0 - (self.busy[name] - busy[name]) / passed) for name in LEARNERS},
            "done": {name: count - done[name] for name, count in self.pace.done.items()},
        }

    def _sampled(self, result: Any) -> None:
        began = time.process_time()
        super()._sampled(result)
        self.driver_cpu += time.process_time() - began

    def _after(self) -> None:
        super()._after()
        if self.rounds == self.WARM:
            spent = (self.cpu.copy(), self.busy.copy(), self.driver_cpu, dict(self.pace.done))
            self.mark = (time.perf_counter(), self.rounds, self.driver.steps, *spent)

    def _stop(self) -> bool:
        return self.mark is not None and time.perf_counter() - self.mark[0] >= self.seconds

    def _save(self) -> None:
        """What is measured are the rounds."""


def bench_scale(
    config: RunConfig, *, samplers: Sequence[int], seconds: float, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Measure rounds of member 1 with each number of samplers, with schedule=async.

    Args:
        config: sizes and rates; environments are `phase1.envs` for each sampler.
        samplers: how many, one measurement each.
        seconds: of each measurement, after its warm-up.
        tell: gets a line before each.

    Returns:
        env; measured: for each number of samplers steps_per_second, idle (by learner), rounds, seconds, and what the
        model says for this machine's cores; costs: see `Costs`, from the first measurement; model: samplers ->
        steps_per_second and idle_learners on as many nodes; assumptions; cores; network_bytes_per_second.

    Raises:
        UserError: see `popgen.runs.preflight`.
    """
    limit_threads(config.cluster.threads)
    rows, costs, overlap = [], None, config.run.overlap
    cores = float(len(os.sched_getaffinity(0)))
    mine = start_ray(config)
    try:
        for count in samplers:
            tell(f"{count} samplers of {config.phase1.envs} environments for {seconds:g} s")
            seen, data = _measure(_config(config, count), seconds)
            costs = costs or _costs(seen, data)
            told = costs.predict(count, overlap, cores)["steps_per_second"]
            row = {"samplers": count, "steps_per_second": seen["steps"] / seen["seconds"], "idle": seen["idle"]}
            rows.append(row | {"rounds": seen["rounds"], "seconds": seen["seconds"], "model_steps_per_second": told})
    finally:
        if mine:
            ray.shutdown()
    assert costs is not None
    return {
        "env": config.env.name,
        "measured": rows,
        "costs": asdict(costs),
        "model": {str(nodes): costs.predict(nodes, overlap) for nodes in NODES},
        "assumptions": list(ASSUMPTIONS),
        "cores": cores,
        "network_bytes_per_second": NETWORK,
    }


def _config(config: RunConfig, samplers: int) -> RunConfig:
    """`config` with so many samplers, little random play, and no end of its own."""
    envs = config.phase1.envs * samplers
    prefill = envs * max(100, config.world_model.length + 8)
    phase = config.phase1.model_copy(
        update={
            **{"envs": envs, "prefill_steps": prefill, "pretrain_updates": 2, "check_every": 10**6},
            **{"max_steps": 10**12, "target_score": 1e9, "patience": 10**9},
        }
    )
    cluster = config.cluster.model_copy(update={"samplers": samplers, "sampler_cpus": 0.01})
    run = config.run.model_copy(update={"schedule": "async", "checkpoint_seconds": 1e9, "id": None})
    tracking = config.tracking.model_copy(update={"enabled": False})
    return config.model_copy(update={"phase1": phase, "cluster": cluster, "run": run, "tracking": tracking})


def _measure(config: RunConfig, seconds: float) -> tuple[dict[str, Any], int]:
    """What `Timed` saw, and the bytes of a segment file of one round of one sampler."""
    root = Path(tempfile.mkdtemp(prefix="popgen-bench-"))
    config = config.model_copy(update={"run": config.run.model_copy(update={"root": str(root)})})
    spec = build_env(config.env, 1).spec
    recorder = RunRecorder(config, spec)
    driver = XpmWm(config, spec, recorder, NullReporter())
    try:
        driver.checkpoints.begin(None)
        seen = Timed(driver, config.run.seed).measure(seconds)
        last = max((recorder.dir / "checkpoints").glob("segments_*"))
        return seen, last.stat().st_size
    finally:
        driver.crew.dismiss()
        recorder.close("KILLED")
        shutil.rmtree(root, ignore_errors=True)


def _costs(seen: dict[str, Any], data: int) -> Costs:
    """A round of each learner is one of its tasks."""
    done = seen["done"]
    tasks = max(1, sum(count for name, count in done.items() if name.startswith("sampler")))
    share = {name: seen["cpu"][name] / max(1, done[name]) for name in LEARNERS}
    return Costs(
        steps=seen["steps"] / tasks,
        sampler=seen["cpu"]["sampler"] / tasks,
        driver=seen["driver_cpu"] / tasks,
        model=share["model"],
        agent=share["agent"],
        data=float(data),
    )
