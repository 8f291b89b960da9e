"""A crew without processes: the actors' objects in this process, called as Ray calls them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import ray

from popgen.actors.agent_actor import AgentActor
from popgen.actors.replay_actor import ReplayActor
from popgen.actors.sampler_actor import SamplerActor
from popgen.actors.world_model_actor import ModelActor
from popgen.config.run_config import RunConfig
from popgen.pipelines.crew import Crew
from popgen.pipelines.sampler_pool import SamplerPool


class Method:
    """`handle.method`, with `remote` and `options`; arguments and results go through the object store."""

    def __init__(self, method: Callable[..., Any], num_returns: int = 1) -> None:
        self.method, self.num_returns = method, num_returns

    def options(self, num_returns: int) -> Method:
        return Method(self.method, num_returns)

    def remote(self, *arguments: Any) -> Any:
        given = [ray.get(x) if isinstance(x, ray.ObjectRef) else x for x in arguments]
        result = self.method(*given)
        return ray.put(result) if self.num_returns == 1 else [ray.put(part) for part in result]


class Handle:
    """Stands in for an actor handle."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def __getattr__(self, name: str) -> Method:
        return Method(getattr(self._actor, name))


class LocalCrew(Crew):
    """`Crew`, hired at once."""

    @staticmethod
    def hire(config: RunConfig, attempt: str) -> LocalCrew:
        seed, env = config.run.seed, config.env
        samplers = [Handle(SamplerActor(env, f"sampler{i}.{attempt}", 1)) for i in range(config.cluster.samplers)]
        crew = LocalCrew(
            players=SamplerPool(samplers),
            replay_sp=Handle(ReplayActor(env, config.replay.capacity, seed * 1000 + 11)),
            replay_xp=Handle(ReplayActor(env, config.replay.capacity, seed * 1000 + 12)),
            model=Handle(ModelActor(config, seed * 1000 + 21, 1)),
            agent=Handle(AgentActor(config, 1)),
        )
        crew.model.connect.remote(crew.replay_sp, crew.replay_xp)
        return crew

    def dismiss(self) -> None:
        """There is nobody to send away."""
