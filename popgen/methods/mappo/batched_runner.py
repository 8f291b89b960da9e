"""RLlib's EnvRunner around `SlotPool`: many environments stepped in one call, their arrays handed on as they are."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any

import numpy as np
import ray
import torch
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.env.env_runner import EnvRunner

from popgen.envs import BatchedEnv, make_env
from popgen.methods.mappo.noisy_actor import mix_with_random
from popgen.methods.mappo.rl_module import module_id, module_spec, spaces
from popgen.methods.mappo.slots import Actor, Rollout, SlotPool
from popgen.methods.mappo.training_job import Job, sizes_of
from popgen.nets.feed_forward import FeedForwardNet
from popgen.nets.weights import load_weights
from popgen.play.rollout import Match, share_of_each
from popgen.types import Weights


@dataclass(frozen=True)
class Failure:
    """What went wrong in a runner. At an exception RLlib would end the process after a minute, and start it again."""

    text: str


def never_raises(method: Callable[..., Any]) -> Callable[..., Any]:
    """The method, which answers with a `Failure` where it would raise an exception."""

    @wraps(method)
    def call(*arguments: Any, **keywords: Any) -> Any:
        try:
            return method(*arguments, **keywords)
        except Exception:
            return Failure(traceback.format_exc())

    return call


class BatchedRunner(EnvRunner):
    """Steps its share of every match's environments; the local runner is number 0, remote ones count from 1.

    The learners' weights come with each request, so that a runner that was restarted, or missed one, is never stale.
    """

    config: Any  # a MappoConfig
    module: Any  # a MultiRLModule

    def __init__(self, *, config: Any, **kwargs: Any) -> None:
        super().__init__(config=config, **kwargs)
        job: Job = self.config.job
        torch.set_num_threads(self.config.runner_threads)
        self.job, self.spec = job, self.config.env_spec
        self.parts = max(1, self.num_workers)
        self.part = max(0, (self.worker_index or 0) - 1)
        idle = self.num_workers > 0 and not self.worker_index  # beside remote runners the local one has nothing to do
        matches = job.matches()
        mine = [replace(match, envs=0) for match in matches] if idle else share_of_each(matches, self.parts, self.part)
        seed = np.random.SeedSequence([job.seed, self.part, int(_was_restarted())])
        drawn, events = int(seed.generate_state(1)[0]), bool(job.utilities)
        self.pool = SlotPool(self._make_envs, mine, job.ppo.view, seed=drawn, events=events)
        self.module = module_spec(job, self.spec, inference_only=True).build()
        self.frozen: dict[int, Actor] = {member: self._frozen_actor(weights) for member, weights in job.frozen.items()}

    @never_raises
    def sample(
        self,
        *,
        weights: Mapping[int, Weights] | None = None,
        active: Sequence[int] = (),
        steps: int = 0,
        **kwargs: Any,
    ) -> Rollout | None:
        """`steps` steps of this runner's environments of the matches `active`, with the learners' `weights`; None where
        it has none of them."""
        if not any(self.pool.matches[index].envs for index in active):
            return None
        return self.pool.play(active, steps, self._load_actors(weights or {}))

    @never_raises
    def episodes(
        self, *, weights: Mapping[int, Weights], matches: Sequence[Match], seed: int, **kwargs: Any
    ) -> Rollout | None:
        """An episode from the start in each of this runner's share of the environments of `matches`, all of which are
        stepped for one horizon; None where it has no share."""
        mine = [match for match in share_of_each(matches, self.parts, self.part) if match.envs]
        if not mine:
            return None
        drawn = int(np.random.SeedSequence([seed, self.part]).generate_state(1)[0])
        pool = SlotPool(self._make_envs, mine, self.job.ppo.view, seed=drawn, stagger=False, once=True)
        return pool.play(range(len(mine)), self.spec.horizon, self._load_actors(weights))

    def _load_actors(self, weights: Mapping[int, Weights]) -> dict[int, Actor]:
        actors = dict(self.frozen)
        for member in self.job.learning:
            actor = self.module[module_id(member)].unwrapped().actor
            if member in weights:
                load_weights(actor, weights[member])
            actors[member] = actor
            if self.job.is_noisy(member):
                actors[-member] = mix_with_random(actor, self.job.noise)
        return actors

    def _frozen_actor(self, weights: Weights) -> FeedForwardNet:
        spec = self.spec
        view = spec.views[self.job.ppo.view]
        net = FeedForwardNet(view, spec.num_actions, spec.num_players, sizes_of(self.job.ppo))
        load_weights(net, weights)
        return net.requires_grad_(False)

    def _make_envs(self, count: int, seed: int) -> BatchedEnv:
        return make_env(self.job.env.name, count, seed=seed, **self.job.env.params)

    # ---- what RLlib asks for -------------------------------------------------------------------------------------

    @never_raises
    def snapshot(self) -> dict[str, Any]:
        """The running episodes and generators."""
        return self.pool.state()

    @never_raises
    def restore(self, *, state: Mapping[str, Any]) -> None:
        """Continue from `snapshot()` of this runner."""
        self.pool.load_state(state)

    def get_spaces(self) -> dict[str, Any]:
        """Observation and action space by module."""
        return {module_id(member): spaces(self.job, self.spec) for member in self.job.learning}

    def get_state(self, *arguments: Any, **kwargs: Any) -> dict[str, Any]:
        """RLlib's own copies of an EnvRunner's state: the modules."""
        return {COMPONENT_RL_MODULE: self.module.get_state(inference_only=True)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """See `get_state`; other components of RLlib's have no use here."""
        if COMPONENT_RL_MODULE in state:
            modules = state[COMPONENT_RL_MODULE]
            self.module.set_state(ray.get(modules) if isinstance(modules, ray.ObjectRef) else modules)

    def get_metrics(self) -> dict[str, Any]:
        """Nothing: rollouts carry their episodes."""
        return {}

    def assert_healthy(self) -> None:
        """The constructor made everything."""
        assert self.pool is not None


def _was_restarted() -> bool:
    """Whether Ray has started this actor again: it must not draw what its first life drew."""
    context = ray.get_runtime_context() if ray.is_initialized() else None
    if context is None or context.get_actor_id() is None:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it asks for its own id by a deprecated name
        return bool(context.was_current_actor_reconstructed)
