"""How sampling and learning scale: rounds of member 1 with 1, 2, 4 ... samplers on this machine, and a model of more.

Samplers are emulated: they share this machine's cores. What a round costs each of them is therefore measured in
seconds of processor time, from which the model says how long a round takes where each has a core of its own.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import ray

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.actors.local_ray import start_ray
from popgen.actors.ray_transport import RayTransport
from popgen.methods.training import Round, Work
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.train import LEARNERS
from popgen.pipelines.population import open_checkpoints, open_training
from popgen.pipelines.training_driver import TrainingDriver
from popgen.progress import NullReporter
from popgen.runs.recorder import RunRecorder

NODES = (1, 2, 4, 8, 16, 32, 64)
NETWORK = 1.0e9
"""Bytes a second into the node of the replays: ten gigabit Ethernet, less its overheads."""

ASSUMPTIONS = (
    "each sampler and each learner has a processor core of its own, as fast as one here",
    f"segments of all samplers reach the replays' node at {NETWORK / 1e9:g} GB/s; weights are small beside them",
    "a round of a sampler costs what it costs here; one driver takes all counts in, one after the other",
    "samplers wait for the slowest learner (at most one round ahead), learners do not wait for each other",
)


@dataclass(frozen=True)
class Costs:
    """Of one round, in seconds of processor time (bytes for `data`): of one sampler's, of each learner's.

    steps: environment steps of one sampler in a round; sampler; driver: its share of one sampler's round; model, agent;
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


WARM = 2
"""Rounds that are not counted."""


@dataclass(frozen=True)
class Moment:
    """How far the rounds have come: time, rounds, environment steps, the driver's processor time, and the work of each
    kind."""

    clock: float
    rounds: int
    steps: int
    driver_cpu: float
    work: Mapping[str, Work]

    @staticmethod
    def after(record: Round) -> Moment:
        """Now, `record` having just ended."""
        return Moment(time.perf_counter(), record.number, record.steps, time.process_time(), record.work)


@dataclass(frozen=True)
class Measured:
    """What went on between two moments."""

    first: Moment
    last: Moment

    @property
    def seconds(self) -> float:
        """Between them."""
        return self.last.clock - self.first.clock

    @property
    def steps(self) -> int:
        """Environment steps."""
        return self.last.steps - self.first.steps

    def work(self, kind: str) -> Work:
        """Of one kind: a learner, or the sum of all samplers."""
        total = Work()
        for name, last in self.last.work.items():
            if name == kind or (kind == "sampler" and name not in LEARNERS):
                first = self.first.work[name]
                total = Work(
                    total.tasks + last.tasks - first.tasks,
                    total.seconds + last.seconds - first.seconds,
                    total.cpu_seconds + last.cpu_seconds - first.cpu_seconds,
                )
        return total

    def idle(self) -> dict[str, float]:
        """Share of the time in which each learner was not at work."""
        return {name: max(0.0, 1.0 - self.work(name).seconds / self.seconds) for name in LEARNERS}


def measure_rounds(driver: TrainingDriver, seconds: float) -> Measured:
    """Member 1's rounds for a given time, the first few not counted."""
    driver.checkpoints.begin(None)
    driver.running = driver.training.begin(1)
    loop, first = driver.training.train(), None
    for record in loop:
        driver.take_in(record)
        if not isinstance(record, Round) or record.number < WARM:
            continue
        if first is None:
            first = Moment.after(record)
        elif (now := Moment.after(record)).clock - first.clock >= seconds:
            loop.close()
            return Measured(first, now)
    raise RuntimeError("the rounds ended by themselves")


def bench_scale(
    config: XpmWmRun, *, samplers: Sequence[int], seconds: float, tell: Callable[[str], None]
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
            measured, data = _measure_once(_endless_config(config, count), seconds)
            costs = costs or costs_of(measured, data)
            predicted = costs.predict(count, overlap, cores)["steps_per_second"]
            rows.append(_row_of(count, measured, predicted))
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


def _row_of(samplers: int, measured: Measured, predicted: float) -> dict[str, Any]:
    return {
        "samplers": samplers,
        "steps_per_second": measured.steps / measured.seconds,
        "idle": measured.idle(),
        "rounds": measured.last.rounds - measured.first.rounds,
        "seconds": measured.seconds,
        "model_steps_per_second": predicted,
    }


def _endless_config(config: XpmWmRun, samplers: int) -> XpmWmRun:
    """`config` with so many samplers, little random play, and no end of its own."""
    envs = config.phase1.envs * samplers
    prefill = envs * max(100, config.world_model.length + 8)
    endless = {"max_steps": 10**12, "target_score": 1e9, "patience": 10**9, "check_every": 10**6}
    phase = config.phase1.model_copy(update={"envs": envs, "prefill_steps": prefill, "pretrain_updates": 2, **endless})
    cluster = config.cluster.model_copy(update={"samplers": samplers, "sampler_cpus": 0.01})
    run = config.run.model_copy(update={"schedule": "async", "checkpoint_seconds": 1e9, "id": None})
    tracking = config.tracking.model_copy(update={"enabled": False})
    return config.model_copy(update={"phase1": phase, "cluster": cluster, "run": run, "tracking": tracking})


def _measure_once(config: XpmWmRun, seconds: float) -> tuple[Measured, int]:
    """What was measured, and the bytes of a segment file of one round of one sampler."""
    root = Path(tempfile.mkdtemp(prefix="popgen-bench-"))
    config = config.model_copy(update={"run": config.run.model_copy(update={"root": str(root)})})
    spec = build_env(config.env, 1).spec
    recorder = RunRecorder(config, spec)
    transport = RayTransport(config.cluster)
    training = open_training(config, spec, f"{recorder.run_id}.{recorder.attempt}", transport)
    checkpoints = open_checkpoints(config, recorder.dir, training, transport)
    try:
        driver = TrainingDriver(config, recorder, NullReporter(), training, checkpoints)
        measured = measure_rounds(driver, seconds)
        last = max((recorder.dir / "checkpoints").glob("segments_*"))
        return measured, last.stat().st_size
    finally:
        checkpoints.close()
        training.close()
        recorder.close("KILLED")
        shutil.rmtree(root, ignore_errors=True)


def costs_of(measured: Measured, data: int) -> Costs:
    """A round of each learner is one of its tasks."""
    sampling = measured.work("sampler")
    tasks = max(1, sampling.tasks)
    learning = {name: measured.work(name) for name in LEARNERS}
    share = {name: work.cpu_seconds / max(1, work.tasks) for name, work in learning.items()}
    return Costs(
        steps=measured.steps / tasks,
        sampler=sampling.cpu_seconds / tasks,
        driver=(measured.last.driver_cpu - measured.first.driver_cpu) / tasks,
        model=share["model"],
        agent=share["agent"],
        data=float(data),
    )
