"""World-model learner actor: draws from both buffers, updates, publishes weights and start states."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np

from popgen.actors.actor_setup import build_env, device_of, limit_threads
from popgen.actors.replay_actor import ReplayActor
from popgen.methods.training import Pending
from popgen.methods.transport import Transport, Worker
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.methods.xpm_wm.model_report import OPEN_LOOP, model_report
from popgen.methods.xpm_wm.replay import Query, Windows
from popgen.methods.xpm_wm.start_states import OLD, Starts
from popgen.methods.xpm_wm.window_requests import Request, join
from popgen.methods.xpm_wm.windows import Draws, model_batch, start_batch
from popgen.methods.xpm_wm.workers import ModelTask, ModelUpdate
from popgen.methods.xpm_wm.world_model_learner import ModelLearner
from popgen.nets.weights import Weights, under, weights_of
from popgen.types import Kind

CHUNK = 25
"""Updates whose batches are drawn in one call."""


class WorldModelActor:
    """Thin: every number is made by `ModelLearner`."""

    def __init__(
        self,
        config: XpmWmRun,
        seed: int,
        threads: int,
        replays: tuple[Worker[ReplayActor], Worker[ReplayActor]],
        transport: Transport,
    ) -> None:
        limit_threads(threads)
        self.config, self.replays, self.transport = config, replays, transport
        self.spec = build_env(config.env, 1).spec
        self.learner = ModelLearner(config.world_model, self.spec, seed, device_of(config.cluster.model_gpus))
        self.member = 1
        self.biased = False

    def begin_member(self, member: int, archive: dict[int, Weights]) -> None:
        """Fine-tune for a later member beside the archived filters of those before (acting weights by member)."""
        self.member = member
        if member > 1:
            self.learner.set_learning_rate(self.config.phase2.model_lr)
        for predecessor in sorted(set(archive) - set(self.learner.predecessors)):
            self.learner.add_predecessor(predecessor, under("filter", archive[predecessor]))

    def _draw_windows(self, draws: Draws, length: int, repeats: int) -> list[list[Windows | None]]:
        view = self.config.world_model.view
        pending = [
            replay.ask(ReplayActor.draw, requests, length, view, repeats)
            for replay, requests in zip(self.replays, (draws.sp, draws.xp), strict=True)
        ]
        sp, xp = (one.result() for one in pending)
        return [a + b for a, b in zip(sp, xp, strict=True)]

    def train(self, task: ModelTask) -> ModelUpdate:
        """Gradient steps; weights, start states from the training windows and mean metrics. Weights and states stay in
        the store."""
        began, began_cpu = time.perf_counter(), time.process_time()
        config, learner, updates = self.config.world_model, self.learner, task.updates
        totals: dict[str, list[float]] = defaultdict(list)
        starts: list[Starts] = []
        for first in range(0, updates, CHUNK):
            chunk = self._draw_windows(
                model_batch(self.config, self.member), config.length, min(CHUNK, updates - first)
            )
            for parts in chunk:
                windows = join([part for part in parts if part is not None])
                if not self.biased:
                    learner.set_biases(windows)
                    self.biased = True
                metrics, seen = learner.update(windows)
                for name, value in metrics.items():
                    totals[name].append(value)
                if count := task.starts_per_update:
                    starts.append(learner.starts(seen, windows, count, pool=OLD, chosen=task.chosen, rare=task.rare))
        recent = self._recent_starts(task.recent_rows)
        means = {name: float(np.mean(values)) for name, values in totals.items()}
        means["seconds"] = time.perf_counter() - began
        means["cpu_seconds"] = time.process_time() - began_cpu
        means["update_ms"] = 1000.0 * means["seconds"] / max(1, updates)
        stored = self.transport.put(Starts.concat(starts)) if starts else None
        return ModelUpdate(self.weights(), stored, means, recent)

    def _recent_starts(self, rows: int) -> Pending[Starts] | None:
        """Start states of the last so many rows of this member's self-play, none of them chosen; None where there are
        none."""
        if not rows:
            return None
        length, count = self.config.world_model.length, self.config.discovery.trust_starts
        per_window = max(1, length // 2)
        query = Query(owner=self.member, kind=Kind.SP, last=rows)
        part = self._draw_windows(Draws(sp=(Request(query, -(-count // per_window)),)), length, 1)[0][0]
        if part is None:
            return None
        seen = self.learner.posteriors(part)
        return self.transport.put(self.learner.starts(seen, part, count, pool=OLD, skip=length - per_window))

    def cache_starts(self) -> Starts:
        """A later member's start states, seen through the present world model."""
        length = self.config.world_model.length
        per_window = max(1, length // 2)
        draws = start_batch(self.config, self.spec, self.member, self.config.phase2.cache // per_window)
        parts = self._draw_windows(draws, length, 1)[0]
        starts = []
        for request, part in zip((*draws.sp, *draws.xp), parts, strict=True):
            if part is not None:
                seen = self.learner.posteriors(part)
                count = per_window * len(part.partner)
                starts.append(self.learner.starts(seen, part, count, pool=request.pool, skip=length - per_window))
        return Starts.concat(starts)

    def report(self) -> dict[str, float]:
        """Event precision and recall at one step and open loop, exact observations: on fresh windows."""
        length = self.config.world_model.length
        parts = self._draw_windows(model_batch(self.config, self.member), length + OPEN_LOOP, 4)
        windows = join([part for update in parts for part in update if part is not None])
        return model_report(self.learner, windows, context=length)

    def weights(self) -> Pending[Weights]:
        """The whole world model, in the store."""
        return self.transport.put(weights_of(self.learner.model))

    def state(self) -> dict[str, Any]:
        """Learner state."""
        return {"learner": self.learner.state(), "biased": self.biased}

    def load_state(self, state: Pending[dict[str, Any]]) -> None:
        """Continue from `state()`."""
        contents = state.result()
        self.learner.load_state(contents["learner"])
        self.biased = bool(contents["biased"])
