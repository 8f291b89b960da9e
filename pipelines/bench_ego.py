"""How fast an ego trains beside fresh partners of each kind, end to end, and what the time goes to."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.envs.contract import EnvSpec
from popgen.methods.ego.config import EgoRun
from popgen.methods.ego.ego_learner import EgoLearner, EgoSetup
from popgen.methods.registry import recipe
from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.play.policy import Policy
from popgen.policies.feed_forward_policy import FeedForwardPolicy


def _make_feed_forward(spec: EnvSpec, seed: int) -> Policy:
    return FeedForwardPolicy(spec.views["features"], spec.num_actions, spec.num_players, seed=seed)


def _make_world_model(spec: EnvSpec, seed: int) -> Policy:
    run = recipe(XpmWmRun.model_fields["method"].default, spec.name)
    assert isinstance(run, XpmWmRun)
    torch.manual_seed(seed)
    return WorldModelPolicy(run.world_model, run.agent, spec)


KINDS: dict[str, Callable[[EnvSpec, int], Policy]] = {
    FeedForwardPolicy.kind: _make_feed_forward,
    WorldModelPolicy.kind: _make_world_model,
}
"""Kind of partners -> one with the sizes of the laptop's recipe, untrained: speed does not depend on its weights."""


def bench_ego(config: EgoRun, *, seconds: float, partners: int) -> dict[str, Any]:
    """Train an ego beside partners of each kind for a while; nothing is written.

    Args:
        config: of a method that has partners, which are not read.
        seconds: time of each measurement, after one iteration that is not counted; one is measured at least.
        partners: of each kind.

    Returns:
        env, method, threads, envs, partners; kinds: by kind of partner steps, seconds, cpu_seconds (of this process),
        steps_per_second, steps_per_cpu_second, and rollout, the share of the time that play takes.
    """
    limit_threads(config.cluster.threads)
    env = build_env(config.env, config.ego.envs, 0)
    kinds = {}
    for kind, make in KINDS.items():
        members = [make(env.spec, seed) for seed in range(partners)]
        kinds[kind] = _measure(EgoLearner(EgoSetup.of_run(config), env, members, 0), seconds)
    about = {"env": env.spec.name, "method": config.method, "threads": config.cluster.threads}
    return {**about, "envs": config.ego.envs, "partners": partners, "kinds": kinds}


def _measure(learner: EgoLearner, seconds: float) -> dict[str, Any]:
    learner.iterate()
    steps, playing = 0, 0.0
    began, cpu = time.perf_counter(), time.process_time()
    while not steps or time.perf_counter() - began < seconds:
        before = time.process_time()
        rollout = learner.sampler.play()
        playing += time.process_time() - before
        learner.learn(rollout)
        steps += rollout.steps
    passed, used = time.perf_counter() - began, time.process_time() - cpu
    return {
        "steps": steps,
        "seconds": round(passed, 2),
        "cpu_seconds": round(used, 2),
        "steps_per_second": round(steps / passed),
        "steps_per_cpu_second": round(steps / used),
        "rollout": round(playing / used, 3),
    }
