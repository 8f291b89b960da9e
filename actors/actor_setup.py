"""What every actor does first, and the options the driver creates it with."""

from __future__ import annotations

import os
from typing import Any

from popgen.config.sections import ClusterConfig, EnvConfig
from popgen.envs import BatchedEnv, make_env
from popgen.errors import UserError


def limit_threads(threads: int) -> None:
    """Bound the threads of this process: several actors share the machine's cores."""
    import torch

    torch.set_num_threads(threads)
    os.environ["OMP_NUM_THREADS"] = str(threads)


def device_of(gpus: float) -> str:
    """Where a learner's tensors are: "cuda", which Ray makes the card that it assigned, if it asks for `gpus`.

    Raises:
        UserError: this node's torch has no use for the card.
    """
    import torch

    if gpus <= 0.0:
        return "cpu"
    if not torch.cuda.is_available():
        problem = "Ray assigned a GPU, but torch sees none on that node"
        raise UserError("cluster", problem, "install a CUDA build of torch, or set model_gpus and agent_gpus to 0")
    return "cuda"


def build_env(config: EnvConfig, num_envs: int, seed: int = 0) -> BatchedEnv:
    """The run's environment."""
    return make_env(config.name, num_envs, seed=seed, **config.params)


def options(cluster: ClusterConfig, cpus: float, gpus: float = 0.0, restarts: int = 0) -> dict[str, Any]:
    """Ray actor options: resources by name from conf/cluster."""
    return {"num_cpus": cpus, "num_gpus": gpus, "resources": dict(cluster.resources) or None, "max_restarts": restarts}
