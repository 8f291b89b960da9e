"""MEP (Zhao et al. 2023) in a world model: a later member is paid for what the population seldom does.

    J(j) = J_SP(j) + alpha E[ sum over steps and seats of -ln mean_{k <= j} pi_k(a | h, z) ]

Members learn one after the other: the population is those before and the one that learns, where the paper trains all
together. All of them act on the latents of the present world model, as partners in imagined cross-play do; in real play
each acts on those of its own archived filter.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from popgen.losses.population_diversity import population_surprise
from popgen.methods.xpm_wm.actor_critic import Actor
from popgen.methods.xpm_wm.config import AgentConfig
from popgen.methods.xpm_wm.imagination import Imagined


@torch.no_grad()
def joint_log_probs(actors: Sequence[Actor], imagined: Imagined) -> Tensor:
    """(K, H, B, P) float32: what each actor would have given the actions that were imagined."""
    states = imagined.latent[:-1].expand_players()
    seats = torch.arange(2, device=imagined.actions.device).expand(imagined.actions.shape)
    taken = imagined.actions.unsqueeze(-1)
    return torch.stack([actor.log_probs(states, seats).gather(-1, taken).squeeze(-1) for actor in actors])


def surprise_bonus(config: AgentConfig, actors: Sequence[Actor], imagined: Imagined) -> Tensor:
    """(H, B) alpha times the population's surprise at each imagined joint action, both seats' added up."""
    surprise = population_surprise(joint_log_probs(actors, imagined), config.surprise_floor)
    return config.surprise * surprise.sum(-1)
