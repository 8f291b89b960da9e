"""A policy that takes a random action now and then."""

from __future__ import annotations

import torch
from torch import Tensor

from popgen.methods.mappo.slots import Actor


def mix_with_random(actor: Actor, share: float) -> Actor:
    """The policy (1 - share) pi(a | o) + share / A, as an actor whose logits are its log-probabilities.

    Args:
        actor: pi.
        share: of the random actions, in [0, 1].
    """

    def mixed(obs: Tensor, seats: Tensor) -> Tensor:
        probabilities = torch.softmax(actor(obs, seats), -1)
        return torch.log((1.0 - share) * probabilities + share / probabilities.shape[-1])

    return mixed
