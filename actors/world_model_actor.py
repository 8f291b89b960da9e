"""World-model learner actor: draws from both replays, updates, publishes weights and start states."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np
import ray

from popgen.actors.actor_setup import build_env, device_of, limit_threads
from popgen.config.run_config import RunConfig
from popgen.methods.xpm_wm.model_report import OPEN_LOOP, model_report
from popgen.methods.xpm_wm.replay import Windows
from popgen.methods.xpm_wm.start_states import OLD, Starts
from popgen.methods.xpm_wm.window_requests import join
from popgen.methods.xpm_wm.windows import Draws, model_batch, start_batch
from popgen.methods.xpm_wm.world_model_learner import ModelLearner
from popgen.nets.weights import Weights, weights_of

CHUNK = 25
"""Updates whose batches are drawn in one call."""


class ModelActor:
    """Thin: every number is made by `ModelLearner`."""

    def __init__(self, config: RunConfig, seed: int, threads: int) -> None:
        limit_threads(threads)
        self.config = config
        self.spec = build_env(config.env, 1).spec
        self.learner = ModelLearner(config.world_model, self.spec, seed, device_of(config.cluster.model_gpus))
        self.member = 1
        self.biased = False

    def connect(self, replay_sp: Any, replay_xp: Any) -> None:
        """The two buffers' handles."""
        self.replays = (replay_sp, replay_xp)

    def begin_member(self, member: int, predecessors: dict[int, Weights]) -> None:
        """Fine-tune for a later member beside the archived filters of those before."""
        self.member = member
        if member > 1:
            self.learner.set_learning_rate(self.config.phase2.model_lr)
        for known in set(predecessors) - set(self.learner.predecessors):
            self.learner.add_predecessor(known, predecessors[known])

    def _draw(self, draws: Draws, length: int, repeats: int) -> list[list[Windows | None]]:
        view = self.config.world_model.view
        refs = [
            replay.draw.remote(requests, length, view, repeats)
            for replay, requests in zip(self.replays, (draws.sp, draws.xp), strict=True)
        ]
        sp, xp = ray.get(refs)
        return [a + b for a, b in zip(sp, xp, strict=True)]

    def train(
        self, updates: int, starts_per_update: int, chosen: bool = True
    ) -> tuple[Weights, Starts | None, dict[str, float]]:
        """`updates` gradient steps; weights, start states from the training windows (with those that were chosen for
        an event or without), mean metrics."""
        began, began_cpu = time.perf_counter(), time.process_time()
        config, learner = self.config.world_model, self.learner
        totals: dict[str, list[float]] = defaultdict(list)
        starts: list[Starts] = []
        for first in range(0, updates, CHUNK):
            chunk = self._draw(model_batch(self.config, self.member), config.length, min(CHUNK, updates - first))
            for parts in chunk:
                windows = join([part for part in parts if part is not None])
                if not self.biased:
                    learner.set_biases(windows)
                    self.biased = True
                metrics, seen = learner.update(windows)
                for name, value in metrics.items():
                    totals[name].append(value)
                if starts_per_update:
                    starts.append(learner.starts(seen, windows, starts_per_update, pool=OLD, chosen=chosen))
        means = {name: float(np.mean(values)) for name, values in totals.items()}
        means["seconds"] = time.perf_counter() - began
        means["cpu_seconds"] = time.process_time() - began_cpu
        means["update_ms"] = 1000.0 * means["seconds"] / max(1, updates)
        return weights_of(learner.model), Starts.concat(starts) if starts else None, means

    def cache_starts(self) -> Starts:
        """A later member's start states, seen through the present world model."""
        length = self.config.world_model.length
        per_window = max(1, length // 2)
        windows = self.config.phase2.cache // per_window
        parts = self._draw(start_batch(self.config, self.spec, self.member, windows), length, 1)[0]
        requests = start_batch(self.config, self.spec, self.member, windows)
        found = []
        for request, part in zip((*requests.sp, *requests.xp), parts, strict=True):
            if part is not None:
                seen = self.learner.posteriors(part)
                count = per_window * len(part.partner)
                found.append(self.learner.starts(seen, part, count, pool=request.pool, skip=length - per_window))
        return Starts.concat(found)

    def report(self) -> dict[str, float]:
        """Event precision and recall at one step and open loop, exact observations: on fresh windows."""
        length = self.config.world_model.length
        parts = self._draw(model_batch(self.config, self.member), length + OPEN_LOOP, 4)
        windows = join([part for update in parts for part in update if part is not None])
        return model_report(self.learner, windows, context=length)

    def weights(self) -> Weights:
        """The whole world model."""
        return weights_of(self.learner.model)

    def state(self) -> dict[str, Any]:
        """Learner state."""
        return {"learner": self.learner.state(), "biased": self.biased}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`."""
        self.learner.load_state(state["learner"])
        self.biased = bool(state["biased"])
