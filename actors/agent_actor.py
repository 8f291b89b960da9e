"""Agent learner actor: one member at a time learns in imagination."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np

from popgen.actors.actor_setup import build_env, device_of, limit_threads
from popgen.methods.transport import Transport
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.member_progress import MemberWeights
from popgen.methods.xpm_wm.workers import AgentTask, AgentUpdate
from popgen.nets.weights import Weights, prefixed, under, weights_of


class AgentActor:
    """Thin: every number is made by `AgentLearner`."""

    def __init__(self, config: XpmWmRun, threads: int, transport: Transport) -> None:
        limit_threads(threads)
        self.config, self.transport = config, transport
        self.spec = build_env(config.env, 1).spec
        self.learner = self._fresh_learner(1, 0)

    def _fresh_learner(self, member: int, seed: int) -> AgentLearner:
        config, device = self.config, device_of(self.config.cluster.agent_gpus)
        return AgentLearner(config.agent, config.world_model, self.spec, member, seed, device, config.discovery)

    def begin_member(self, member: int, seed: int, partners: dict[int, Weights]) -> None:
        """A fresh actor and critics beside frozen predecessors (acting weights by member)."""
        self.learner = self._fresh_learner(member, seed)
        for partner, weights in partners.items():
            self.learner.add_partner(partner, under("actor", weights))

    def restart(self, seed: int) -> None:
        """Fresh actor and critics on the same world model."""
        self.learner.restart(seed)

    def train(self, task: AgentTask) -> AgentUpdate:
        """Imagine and update; what comes of it stays in the store."""
        began, began_cpu = time.perf_counter(), time.process_time()
        model = task.model.result()
        self.learner.set_model(model)
        self.learner.set_starts(task.starts.result(), task.new_share)
        self.learner.partner_scores, self.learner.plays = dict(task.partner_scores), task.plays
        rates: dict[str, float] = {}
        if task.tally is not None:
            recent = None if task.recent is None else task.recent.result()
            rates = self.learner.compare_with_real_play(task.tally, recent)
        totals: dict[str, list[float]] = defaultdict(list)
        for _ in range(task.updates):
            for name, value in self.learner.update().items():
                totals[name].append(value)
        means = {name: float(np.mean(values)) for name, values in totals.items()} | rates
        means["seconds"] = time.perf_counter() - began
        means["cpu_seconds"] = time.process_time() - began_cpu
        means["update_ms"] = 1000.0 * means["seconds"] / task.updates
        acting, critics = self.acting_weights(model), weights_of(self.learner.critics)
        return AgentUpdate(MemberWeights(self.transport.put(acting), self.transport.put(critics), task.model), means)

    def acting_weights(self, model: Weights) -> Weights:
        """Policy weights: the filter of `model` and this member's actor."""
        return prefixed("filter", under("filter", model)) | prefixed("actor", self.learner.actor_weights())

    def state(self) -> dict[str, Any]:
        """Of the learner: everything but the world model and the start states, which come with every task."""
        return self.learner.state()

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`, after `begin_member` with the same partners."""
        self.learner.load_state(state)
