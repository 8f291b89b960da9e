"""How fast XPM-WM's two learners are, what the time goes to, and how near that is to this machine's matrix products."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.imagination import OLD
from popgen.methods.xpm_wm.replay import Query, Replay, Windows
from popgen.methods.xpm_wm.world_model import ModelLearner
from popgen.nets.weights import weights_of
from popgen.play.rollout import Match, Sampler
from popgen.policies.simple_policies import RandomPolicy
from popgen.types import RANDOM_MEMBER, Kind

PARTS: dict[str, tuple[str, ...]] = {
    "products": ("mm", "addmm", "bmm", "baddbmm", "linear", "convolution", "mkldnn"),
    "optimiser": ("fused_adam", "adam", "lerp", "addcdiv", "addcmul", "sqrt", "foreach", "linalg_vector_norm"),
    "casts and copies": ("copy", "clone", "_to_copy", "contiguous"),
    "joining": ("cat", "stack"),
}
"""Kinds of work -> how the names of torch's operators begin (after `aten::` and underscores); all else is `other`."""

SIZES = (512, 1024, 2048)
"""Sides of the square matrices among which the peak is looked for, ascending."""
LONGEST = 2.0
"""Seconds that a product may take by the rate of smaller ones; a format that the processor lacks takes a minute."""


@dataclass(frozen=True)
class Measured:
    """One learner's update: wall milliseconds, floating-point operations, shares of the operators' time by part."""

    milliseconds: float
    operations: float
    shares: dict[str, float]

    def as_row(self, peak: float) -> dict[str, Any]:
        """For the report: milliseconds by part (`python`: in no operator), operations a second, share of the peak."""
        rate = self.operations / (self.milliseconds / 1000.0)
        parts = {name: self.milliseconds * share for name, share in self.shares.items()}
        return {"milliseconds": self.milliseconds, "parts": parts, "flops": rate, "share_of_peak": rate / peak}


def bench_world_model(configs: Mapping[str, XpmWmRun], *, seconds: float) -> dict[str, Any]:
    """Updates of both learners on random play, the agent's as a second member's: self-play and cross-play.

    Args:
        configs: by the name under which the result has them.
        seconds: time per measurement; one update is measured at least.

    Returns:
        sizes: name -> learner (`world_model`, `agent`) -> milliseconds, parts (milliseconds by kind of work), flops
        (achieved, a second), share_of_peak; peaks: float32 and bfloat16 operations a second of this machine's matrix
        products with as many threads; threads.
    """
    threads = next(iter(configs.values())).cluster.threads
    limit_threads(threads)
    peaks = {name: measure_peak(getattr(torch, name), seconds / 4) for name in ("float32", "bfloat16")}
    sizes = {name: _measure_size(config, peaks, seconds) for name, config in configs.items()}
    return {"sizes": sizes, "peaks": peaks, "threads": threads}


def _measure_size(config: XpmWmRun, peaks: Mapping[str, float], seconds: float) -> dict[str, Any]:
    windows = _draw_windows(config)
    model = ModelLearner(config.world_model, build_env(config.env, 1).spec, seed=0)
    model.set_biases(windows)
    agent = _make_agent(config, model, windows)
    dtype = "bfloat16" if agent.dtype is torch.bfloat16 else "float32"
    measured = {
        "world_model": measure_update(lambda: model.update(windows), seconds).as_row(peaks["float32"]),
        "agent": measure_update(agent.update, seconds).as_row(peaks[dtype]),
    }
    return measured | {"precision": {"world_model": "float32", "agent": dtype}}


def _draw_windows(config: XpmWmRun) -> Windows:
    """A batch of windows of random play."""
    env, model = build_env(config.env, 8), config.world_model
    match = Match(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), env.num_envs)
    sampler = Sampler(env, [match], {RANDOM_MEMBER: RandomPolicy(env.spec.num_actions)}, name="bench", seed=0)
    steps = 4 * model.length
    replay = Replay(build_env(config.env, 1), 2 * env.num_envs * steps, 0)
    for segment in sampler.collect(steps)[0]:
        replay.add(segment, 1)
    return replay.windows(replay.sample(model.batch, model.length, Query()), model.length, model.view)


def _make_agent(config: XpmWmRun, model: ModelLearner, windows: Windows) -> AgentLearner:
    """A second member's learner beside a first member."""
    learner = AgentLearner(config.agent, config.world_model, model.spec, 2, 0)
    learner.add_partner(1, weights_of(learner.actor))
    learner.set_model(weights_of(model.model))
    seen = model.posteriors(windows)
    learner.set_starts(model.starts(seen, windows, 4 * config.agent.starts_sp, pool=OLD), 0.0)
    return learner


def measure_peak(dtype: torch.dtype, seconds: float) -> float:
    """The most floating-point operations a second that products of square matrices reach here."""
    best = 0.0
    for size in SIZES:
        if best and 2.0 * size**3 / best > LONGEST:
            break
        left, right = (torch.randn(size, size).to(dtype) for _ in range(2))
        count, took = _repeat_work(lambda a=left, b=right: a @ b, seconds / len(SIZES))
        best = max(best, 2.0 * size**3 * count / took)
    return best


def measure_update(update: Callable[[], Any], seconds: float) -> Measured:
    """Time it without a profiler, then look at one update with one."""
    update()
    count, took = _repeat_work(update, seconds)
    with FlopCounterMode(display=False) as counter:
        update()
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        update()
    busy = dict.fromkeys([*PARTS, "other"], 0.0)
    for event in profiler.key_averages():
        if event.key.startswith("aten::"):
            busy[part_of(event.key)] += event.self_cpu_time_total
    total = sum(busy.values())
    shares = {name: value / total for name, value in busy.items()}
    return Measured(1000.0 * took / count, float(counter.get_total_flops()), shares)


def part_of(operator: str) -> str:
    """Which of the parts an operator such as `aten::addmm` belongs to."""
    name = operator.removeprefix("aten::").strip("_")
    return next((part for part, begins in PARTS.items() if name.startswith(begins)), "other")


def _repeat_work(work: Callable[[], Any], seconds: float) -> tuple[int, float]:
    """How often it was done, once at least, and the processor seconds that took: other work of the machine is not in
    them. With several threads they are those of the wall."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    work()
    count, began = 0, clock()
    while count == 0 or clock() - began < seconds:
        work()
        count += 1
    return count, float(np.maximum(clock() - began, 1e-9))
