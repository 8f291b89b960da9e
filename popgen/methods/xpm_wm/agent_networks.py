"""What one member trains: its actor, a critic for each kind of trajectory, their slow copies and optimisers."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from popgen.losses.policy_losses import ReturnScale, lambda_return
from popgen.methods.xpm_wm.actor_critic import Actor, Critic
from popgen.methods.xpm_wm.config import AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.imagination import Imagined
from popgen.nets import weights as w

SELF = 0
"""Key of the self-play critic among the critics; cross-play critics are keyed by partner."""


class ReturnTargets(NamedTuple):
    """Lambda-returns (H, B) and values (H + 1, B), without gradient."""

    returns: Float[Tensor, "H B"]
    value: Float[Tensor, "T B"]


class AgentNetworks:
    """Fresh networks on `device`; `rollout_actor` is the actor's copy in `dtype`, with which it acts in imagination.

    Args:
        partners: predecessors, each with a critic of its own.
        seed: of the initial weights.
    """

    def __init__(
        self,
        config: AgentConfig,
        model_config: WorldModelConfig,
        num_actions: int,
        partners: Iterable[int],
        seed: int,
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        self.config, self.model_config, self.device, self.dtype = config, model_config, device, dtype
        torch.manual_seed(seed)
        self.actor = Actor(config, model_config, num_actions).to(device)
        self.scale = ReturnScale(config.return_percentiles).to(device)
        self.critics = nn.ModuleDict({str(key): self._fresh_critic() for key in (SELF, *partners)})
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = self._make_optimiser(self.actor, config.actor_lr)
        self.critic_optimiser = self._make_optimiser(self.critics, config.critic_lr)
        self.rollout_actor = copy.deepcopy(self.actor).to(dtype).requires_grad_(False)

    def _fresh_critic(self) -> Critic:
        return Critic(self.config, self.model_config).to(self.device)

    def _make_optimiser(self, module: nn.Module, rate: float) -> torch.optim.Adam:
        return torch.optim.Adam(module.parameters(), lr=rate, eps=self.config.adam_eps, fused=True)

    def add_critic(self, partner: int) -> None:
        """A critic of cross-play with one more partner; the optimisers begin anew."""
        self.critics[str(partner)] = self._fresh_critic()
        self.slow = copy.deepcopy(self.critics).requires_grad_(False)
        self.actor_optimiser = self._make_optimiser(self.actor, self.config.actor_lr)
        self.critic_optimiser = self._make_optimiser(self.critics, self.config.critic_lr)
        self.rollout_actor = copy.deepcopy(self.actor).to(self.dtype).requires_grad_(False)

    def critic(self, key: int, *, slow: bool = False) -> Critic:
        """The critic of a key, or its slow copy."""
        critic = (self.slow if slow else self.critics)[str(key)]
        assert isinstance(critic, Critic)
        return critic

    @torch.no_grad()
    def targets(self, imagined: Imagined, key: int, seat: Int[Tensor, "T B"]) -> ReturnTargets:
        """Lambda-returns under the slow critic of `key`, which is told the agent's seat."""
        value = self.critic(key, slow=True).value(imagined.latent, seat)
        discount = self.config.discount * imagined.keep
        return ReturnTargets(lambda_return(imagined.reward, value, discount, self.config.lam), value)

    def step_actor(self, loss: Tensor) -> None:
        """One step of the actor down the gradient of `loss`."""
        self._step_down(self.actor_optimiser, loss, self.actor.parameters())

    def step_critics(self, loss: Tensor) -> None:
        """The same for the critics."""
        self._step_down(self.critic_optimiser, loss, self.critics.parameters())

    def _step_down(self, optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Iterable[nn.Parameter]) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, self.config.grad_clip)
        optimiser.step()

    @torch.no_grad()
    def update_copies(self) -> None:
        """Slow critics move towards the fast ones; the rollout copy of the actor is refreshed."""
        for slow, fast in zip(self.slow.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast, 1.0 - self.config.slow_critic)
        for rollout, trained in zip(self.rollout_actor.parameters(), self.actor.parameters(), strict=True):
            rollout.copy_(trained)

    def state(self) -> dict[str, Any]:
        """Weights and optimisers."""
        return {
            "actor": w.weights_of(self.actor),
            "critics": w.weights_of(self.critics),
            "slow": w.weights_of(self.slow),
            "scale": w.weights_of(self.scale),
            "actor_optimiser": w.optimiser_state(self.actor_optimiser),
            "critic_optimiser": w.optimiser_state(self.critic_optimiser),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the contents with `state()`; the partners' critics must have been added before."""
        w.load_weights(self.actor, state["actor"])
        w.load_weights(self.critics, state["critics"])
        w.load_weights(self.slow, state["slow"])
        w.load_weights(self.scale, state["scale"])
        w.load_weights(self.rollout_actor, state["actor"], cast=True)
        w.load_optimiser_state(self.actor_optimiser, state["actor_optimiser"])
        w.load_optimiser_state(self.critic_optimiser, state["critic_optimiser"])
