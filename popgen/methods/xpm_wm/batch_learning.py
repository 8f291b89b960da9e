"""Several passes over what was imagined: gradient steps of actor and critics on its minibatches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from popgen.methods.xpm_wm.agent_networks import SELF, AgentNetworks
from popgen.methods.xpm_wm.agent_targets import sample_losses
from popgen.methods.xpm_wm.policy_samples import Samples


def cast_automatically(networks: AgentNetworks) -> torch.autocast:
    """Products in bfloat16 where the networks' rollouts are."""
    return torch.autocast(networks.device.type, torch.bfloat16, enabled=networks.dtype is torch.bfloat16)


def learn_batch(networks: AgentNetworks, samples: Sequence[Samples], generator: torch.Generator) -> dict[str, float]:
    """`epochs` passes over the batch in `minibatches`, of every kind of samples its share; mean figures."""
    config, totals = networks.config, []
    for _ in range(config.epochs):
        parts = [part.minibatches(config.minibatches, generator) for part in samples]
        totals += [step_networks(networks, together) for together in zip(*parts, strict=True)]
    return {name: float(np.mean([figures[name] for figures in totals])) for name in totals[0]}


def step_networks(networks: AgentNetworks, parts: Sequence[Samples]) -> dict[str, float]:
    """One step of the actor and of the critics that the samples are of."""
    with cast_automatically(networks):
        losses = [sample_losses(networks, part) for part in parts]
    zero = torch.zeros((), device=networks.device)
    networks.step_actor(sum((loss.policy for loss in losses), zero))
    networks.step_critics(sum((loss.critic for loss in losses), zero))
    figures = losses[0].figures  # of the policy in self-play
    for part, loss in zip(parts, losses, strict=True):
        figures["critic_loss_sp" if part.key == SELF else "critic_loss_xp"] = float(loss.critic.detach())
    return figures
