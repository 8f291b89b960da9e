"""Actor on the player-specific latent and centralised critics on the joint one (paper, section 4.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from popgen.methods.xpm_wm.config import AgentConfig, WorldModelConfig
from popgen.methods.xpm_wm.latents import Latent, player_masks
from popgen.nets.blocks import TwoHot, draw_by_inversion, mlp


class Actor(nn.Module):
    """pi(a^i | h, z^i, seat): one network for both seats; seats are told apart by a one-hot.

    `actor_input=latent` drops h, the paper's literal pi(a^i | z^i).
    """

    masks: Tensor
    seats: Tensor

    def __init__(self, config: AgentConfig, model: WorldModelConfig, num_actions: int) -> None:
        super().__init__()
        self.config = config
        self.use_h = config.actor_input == "model"
        size = model.classes * model.groups
        inputs = size + 2 + (model.deter if self.use_h else 0)
        self.net = mlp(
            inputs,
            num_actions,
            units=config.units,
            layers=config.layers,
            activation=config.activation,
            norm=config.norm,
            output_scale=0.01,
        )
        self.register_buffer("masks", player_masks(model.groups, model.joint_groups, model.classes), persistent=False)
        self.register_buffer("seats", torch.eye(2), persistent=False)

    def inputs(self, latent: Latent, seat: Tensor) -> Tensor:
        """Network inputs of the players in `seat` (...,) int64, one per model state (..., .)."""
        dtype = latent.z.dtype  # a mask of more precision would widen the latents, which layers then narrow again
        parts = [latent.z * self.masks.to(dtype)[seat], self.seats.to(dtype)[seat]]
        return torch.cat([latent.h, *parts] if self.use_h else parts, -1)

    def log_probs(self, latent: Latent, seat: Tensor) -> Tensor:
        """(..., A) log-probabilities, mixed with a uniform share so that no action dies."""
        probs = torch.softmax(self.net(self.inputs(latent, seat)).float(), -1)
        uniform = self.config.unimix
        return torch.log(probs * (1.0 - uniform) + uniform / probs.shape[-1])

    @torch.no_grad()
    def sample(self, latent: Latent, seat: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """(...,) int64 actions."""
        return draw_by_inversion(self.log_probs(latent, seat), generator)


class Critic(nn.Module):
    """v(h, z, seat) of one pair of policies as a two-hot distribution over returns.

    The seat of agent j tells the two seatings of a cross-play pair apart; in self-play it is 0.
    """

    seats: Tensor

    def __init__(self, config: AgentConfig, model: WorldModelConfig) -> None:
        super().__init__()
        inputs = model.deter + model.classes * model.groups + 2
        self.net = mlp(
            inputs,
            config.bins,
            units=config.units,
            layers=config.layers,
            activation=config.activation,
            norm=config.norm,
            output_scale=0.0,
        )
        self.two_hot = TwoHot(config.bins)
        self.register_buffer("seats", torch.eye(2), persistent=False)

    def logits(self, latent: Latent, seat: Tensor) -> Tensor:
        """(..., bins)."""
        return self.net(torch.cat([latent.h, latent.z, self.seats.to(latent.z.dtype)[seat]], -1))

    def value(self, latent: Latent, seat: Tensor) -> Tensor:
        """(...) expected return."""
        return self.two_hot.mean(self.logits(latent, seat))

    def loss(self, latent: Latent, seat: Tensor, target: Tensor) -> Tensor:
        """Cross-entropy (...) against the returns `target` (...)."""
        return self.two_hot.loss(self.logits(latent, seat).float(), target)
