"""How fast MAPPO trains, end to end, and what the time goes to."""

from __future__ import annotations

import time
from typing import Any, cast

import ray

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.actors.local_ray import start_ray
from popgen.methods.mappo.algorithm import Mappo, MappoConfig
from popgen.methods.mappo.config import MappoRun
from popgen.methods.mappo.train import check_card
from popgen.methods.mappo.training_job import Job
from popgen.runs.recovery import wait_for_room


def bench_mappo(config: MappoRun, *, seconds: float) -> dict[str, Any]:
    """Train self-play by the config's recipe for a while; nothing is written.

    Args:
        config: a run of method=mappo.
        seconds: time of the measurement, after one iteration that is not counted; one is measured at least.

    Returns:
        env, threads, runners, envs, iterations, steps; seconds and cpu_seconds (of this process and its threads) that
        they took; steps_per_second, steps_per_cpu_second; shares of the time: sampling, pooling (advantages and
        minibatches), gradients (forward, backward, optimiser), rllib (all else that happens in an iteration).

    Raises:
        UserError: no Ray answers, or it has not what the training needs.
    """
    limit_threads(config.cluster.threads)
    spec = build_env(config.env, 1).spec
    job = Job(config.env, config.ppo, None, (1,), seed=config.run.seed)
    mine = start_ray(config)
    try:
        check_card(config.cluster)
        wait_for_room(config, lambda text: None)
        algorithm = cast(Mappo, MappoConfig.of(job, spec, config.cluster).build_algo())
        try:
            measured = _train(algorithm, seconds)
        finally:
            algorithm.stop()
    finally:
        if mine:
            ray.shutdown()
    ppo = config.ppo
    about = {"env": spec.name, "threads": config.cluster.threads, "runners": ppo.runners, "envs": ppo.envs}
    return about | measured


def _train(algorithm: Mappo, seconds: float) -> dict[str, Any]:
    algorithm.train()
    spent = {"sampling": 0.0, "pooling": 0.0, "gradients": 0.0}
    steps, iterations, passed = 0, 0, 0.0
    began, cpu = time.perf_counter(), time.process_time()
    while passed < seconds:
        algorithm.train()
        iterations += 1
        steps += sum(counted.steps for counted in algorithm.report.counted)
        for name in spent:
            spent[name] += algorithm.report.seconds[name]
        passed = time.perf_counter() - began
    used = time.process_time() - cpu
    shares = {name: round(value / passed, 3) for name, value in spent.items()}
    shares["rllib"] = round(1.0 - sum(spent.values()) / passed, 3)
    return {
        "iterations": iterations,
        "steps": steps,
        "seconds": round(passed, 2),
        "cpu_seconds": round(used, 2),
        "steps_per_second": round(steps / passed),
        "steps_per_cpu_second": round(steps / used),
        "shares": shares,
    }
