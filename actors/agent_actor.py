"""Agent learner actor: one member at a time learns in imagination."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np

from popgen.actors.actor_setup import build_env, device_of, limit_threads
from popgen.config.run_config import RunConfig
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.methods.xpm_wm.start_states import Starts
from popgen.nets.weights import Weights, prefixed, under, weights_of


class AgentActor:
    """Thin: every number is made by `AgentLearner`."""

    def __init__(self, config: RunConfig, threads: int) -> None:
        limit_threads(threads)
        self.config = config
        self.spec = build_env(config.env, 1).spec
        self.model: Weights = {}

    def begin_member(self, member: int, seed: int, partners: dict[int, Weights]) -> None:
        """A fresh actor and critics beside frozen predecessors (actor weights by member)."""
        config, device = self.config, device_of(self.config.cluster.agent_gpus)
        self.learner = AgentLearner(config.agent, config.world_model, self.spec, member, seed, device)
        for partner, weights in partners.items():
            self.learner.add_partner(partner, weights)

    def restart(self, seed: int) -> None:
        """Fresh actor and critics on the same world model."""
        self.learner.restart(seed)

    def train(
        self,
        updates: int,
        model: Weights,
        starts: Starts,
        new_share: float,
        partner_scores: dict[int, float],
        plays: bool,
    ) -> tuple[Weights, Weights, dict[str, float]]:
        """Imagine and update `updates` times; acting weights (filter and actor), critics and mean metrics."""
        began, began_cpu = time.perf_counter(), time.process_time()
        self.learner.set_model(model)
        self.learner.set_starts(starts, new_share)
        self.learner.partner_scores, self.learner.plays = dict(partner_scores), plays
        totals: dict[str, list[float]] = defaultdict(list)
        for _ in range(updates):
            for name, value in self.learner.update().items():
                totals[name].append(value)
        means = {name: float(np.mean(values)) for name, values in totals.items()}
        means["seconds"] = time.perf_counter() - began
        means["cpu_seconds"] = time.process_time() - began_cpu
        means["update_ms"] = 1000.0 * means["seconds"] / updates
        return self.acting_weights(model), weights_of(self.learner.critics), means

    def acting_weights(self, model: Weights) -> Weights:
        """Policy weights: the filter of `model` and this member's actor."""
        return prefixed("filter", under("filter", model)) | prefixed("actor", self.learner.actor_weights())

    def state(self) -> dict[str, Any]:
        """Of the learner: everything but the world model and the start states, which come with every call."""
        return self.learner.state()

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`, after `begin_member` with the same partners."""
        self.learner.load_state(state)
