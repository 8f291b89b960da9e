"""Learner actor of XPM-Sim: both buffers, the exact dynamics F and one member's learner in one process."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from popgen.actors.actor_setup import build_env, limit_threads
from popgen.config.run_config import RunConfig
from popgen.methods.xpm_sim.agent import XpmSimLearner
from popgen.methods.xpm_sim.restart_check import restart_check
from popgen.nets.weights import Weights, weights_of
from popgen.types import Segment

ENVS = 64
"""Environments from which start states are drawn at once."""


@dataclass(frozen=True)
class Learned:
    """What a call of `train` gave: acting weights, mean figures, simulated steps and trajectories of the call."""

    acting: Weights
    metrics: dict[str, float]
    steps: int
    trajectories: int


class ExactLearnerActor:
    """Thin: every number is made by `XpmSimLearner`."""

    def __init__(self, config: RunConfig, threads: int) -> None:
        limit_threads(threads)
        self.config = config
        self.env = build_env(config.env, ENVS, config.run.seed)

    def begin_member(
        self, member: int, seed: int, partners: dict[int, Weights], encoder: dict[str, Any] | None
    ) -> Weights:
        """Fresh networks and buffers beside frozen predecessors (weights by member), on the shared encoder if there is
        one; the fresh acting weights."""
        self.env.reset(seed=seed)
        self.learner = XpmSimLearner(self.config.xpm_sim, self.env, member, seed, partners, encoder)
        return self.learner.actor.weights()

    def add(self, segments: list[Segment], partner_scores: dict[int, float]) -> None:
        """Real episodes into the buffers, and each partner's latest cross-play return."""
        self.learner.starts.add(segments)
        self.learner.partner_scores = dict(partner_scores)

    def train(self, updates: int) -> Learned:
        """Simulate and update `updates` times."""
        began, cpu, learner = time.perf_counter(), time.process_time(), self.learner
        steps, trajectories = learner.simulated, learner.trajectories
        totals: dict[str, list[float]] = defaultdict(list)
        for _ in range(updates):
            for name, value in learner.update().items():
                totals[name].append(value)
        means = {name: float(np.mean(values)) for name, values in totals.items()}
        means["update_ms"] = 1e3 * (time.perf_counter() - began) / updates
        means["cpu_seconds"] = time.process_time() - cpu
        return Learned(learner.actor.weights(), means, learner.simulated - steps, learner.trajectories - trajectories)

    def check(self) -> tuple[dict[str, float], int]:
        """See `restart_check`."""
        return restart_check(self.learner, self.config.xpm_sim.check_pairs)

    def encoder(self) -> dict[str, Any] | None:
        """The shared encoder for the next member, None without one."""
        return None if self.learner.encoder is None else self.learner.encoder.state()

    def critics(self) -> Weights:
        """The critics' weights, which a member keeps beside its policy."""
        return weights_of(self.learner.critics)

    def state(self) -> dict[str, Any]:
        """Of the learner, its buffers and running trajectories."""
        return self.learner.state()

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`, after `begin_member` with the same partners."""
        self.learner.load_state(state)
