"""The actors of a run and the calls the driver makes to them."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import ray

from popgen.actors.actor_setup import options
from popgen.actors.agent_actor import AgentActor
from popgen.actors.replay_actor import ReplayActor
from popgen.actors.sampler_actor import SamplerActor
from popgen.actors.world_model_actor import ModelActor
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.pipelines.sampler_pool import SamplerPool
from popgen.runs.resources import demands, total

STARTS = 4
LATE = "timed out during startup"


def start_ray(config: RunConfig) -> bool:
    """Connect to a cluster or start a local one; True if this call did it."""
    if ray.is_initialized():
        return False
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Quiet: Ray warns once about the accelerator variable it will stop overriding.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    cluster, asked = config.cluster, total(demands(config)).get("CPU", 0.0)
    local = cluster.address is None
    limits = {"object_store_memory": cluster.object_store_bytes} if local and cluster.object_store_bytes else {}
    arguments = {
        # Without an address Ray would look for a running cluster before it starts a local one.
        "address": "local" if local else cluster.address,
        # On fewer cores than the actors ask for they take turns.
        "num_cpus": cluster.num_cpus or max(os.cpu_count() or 1, math.ceil(asked)) if local else None,
        "include_dashboard": False if local else None,
        "log_to_driver": False,
        "logging_level": "ERROR",
    }
    try:
        _init(arguments | limits)
    except ConnectionError as error:
        raise UserError("cluster.address", f"no Ray answers ({error})", "start it, or use cluster=laptop") from None
    return True


def _init(arguments: dict[str, Any]) -> None:
    """`ray.init`, again where Ray gave up on its own processes: it waits half a minute, too short on a busy machine.

    Raises:
        UserError: it gave up `STARTS` times.
    """
    for _ in range(STARTS):
        try:
            ray.init(**arguments)
            return
        except Exception as error:  # Ray raises that very class
            if LATE not in str(error):
                raise
        ray.shutdown()
    problem = f"Ray did not come up in {STARTS} tries, the machine is too busy"
    raise UserError("cluster", problem, "end other work; the same run.id goes on")


@dataclass
class Crew:
    """Handles of one run's actors."""

    players: SamplerPool
    replay_sp: Any
    replay_xp: Any
    model: Any
    agent: Any

    @staticmethod
    def hire(config: RunConfig, attempt: str) -> Crew:
        """Create all actors. Sampler names carry the run and its attempt: replays and ledger know a segment by them."""
        cluster, seed = config.cluster, config.run.seed
        sampler = ray.remote(SamplerActor).options(**options(cluster, cluster.sampler_cpus))
        replay = ray.remote(ReplayActor).options(**options(cluster, cluster.replay_cpus))
        model = ray.remote(ModelActor).options(**options(cluster, cluster.model_cpus, cluster.model_gpus))
        agent = ray.remote(AgentActor).options(**options(cluster, cluster.agent_cpus, cluster.agent_gpus))
        crew = Crew(
            players=SamplerPool(
                [
                    sampler.remote(config.env, f"sampler{index}.{attempt}", cluster.threads)
                    for index in range(cluster.samplers)
                ]
            ),
            replay_sp=replay.remote(config.env, config.replay.capacity, seed * 1000 + 11),
            replay_xp=replay.remote(config.env, config.replay.capacity, seed * 1000 + 12),
            model=model.remote(config, seed * 1000 + 21, cluster.threads),
            agent=agent.remote(config, cluster.threads),
        )
        ray.get(crew.model.connect.remote(crew.replay_sp, crew.replay_xp))
        return crew

    def dismiss(self) -> None:
        """End all actors."""
        for actor in (*self.players.samplers, self.replay_sp, self.replay_xp, self.model, self.agent):
            ray.kill(actor)
