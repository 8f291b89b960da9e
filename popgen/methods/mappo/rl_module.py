"""A member as RLlib's RLModule: a decentralised actor, and a centralised critic per kind of trajectory and partner."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module import MultiRLModuleSpec, RLModuleSpec
from ray.rllib.core.rl_module.apis import InferenceOnlyAPI, ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor, nn

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.training_job import Job, sizes_of
from popgen.nets.feed_forward import FeedForwardNet, ValueNet, orthogonal

CRITICS = "critics"


class MemberModule(TorchRLModule, InferenceOnlyAPI, ValueFunctionAPI):
    """`actor` and `critics` of one member; a copy for inference alone has no critics.

    Built from `model_config`: view (ViewSpec), actions, players, sizes (Sizes), critics (names), seed.
    """

    model_config: dict[str, Any]

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        config = self.model_config  # initial weights depend on its seed alone
        view, sizes, players = config["view"], config["sizes"], config["players"]
        generator = torch.Generator().manual_seed(config["seed"])
        self.actor = FeedForwardNet(view, config["actions"], players, sizes)
        orthogonal(self.actor, 0.01, generator)
        names = [] if self.inference_only else config[CRITICS]
        self.critics = nn.ModuleDict({name: ValueNet(view, players, sizes, generator) for name in names})

    def get_non_inference_attributes(self) -> list[str]:
        """What acting does not need."""
        return [CRITICS]

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        """Logits of `obs` (R, ...) and `extras` (R, P)."""
        return {Columns.ACTION_DIST_INPUTS: self.actor(batch[Columns.OBS], batch["extras"])}

    def _forward_train(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        """Logits of the policy rows and, by critic, its output on its own rows."""
        return self._forward(batch) | {Columns.VF_PREDS: self.compute_values(batch)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> dict[str, Tensor]:
        """Normalised values (R,) of every critic that has rows in the batch."""
        return {name: self.critics[name](rows.obs, rows.extras).squeeze(-1) for name, rows in batch[CRITICS].items()}


def module_id(member: int) -> str:
    """A member's name in RLlib."""
    return f"member_{member}"


def spaces(job: Job, spec: EnvSpec) -> tuple[gymnasium.Space, gymnasium.Space]:
    """One player's observation and actions."""
    view = spec.views[job.ppo.view]
    dtype = np.dtype(view.dtype).type
    high = view.scale if np.issubdtype(dtype, np.integer) else np.inf
    low = 0 if np.issubdtype(dtype, np.integer) else -np.inf
    return gymnasium.spaces.Box(low, high, view.shape, dtype), gymnasium.spaces.Discrete(spec.num_actions)


def module_spec(job: Job, spec: EnvSpec, *, inference_only: bool) -> MultiRLModuleSpec:
    """All learning members' modules."""
    observation, action = spaces(job, spec)
    common = {
        "view": spec.views[job.ppo.view],
        "actions": spec.num_actions,
        "players": spec.num_players,
        "sizes": sizes_of(job.ppo),
    }
    specs = {
        module_id(member): RLModuleSpec(
            module_class=MemberModule,
            observation_space=observation,
            action_space=action,
            inference_only=inference_only,
            model_config={**common, CRITICS: job.critics(member), "seed": job.seed * 1000 + member},
        )
        for member in job.learning
    }
    return MultiRLModuleSpec(rl_module_specs=specs, inference_only=inference_only)
