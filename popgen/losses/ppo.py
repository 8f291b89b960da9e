"""The clipped surrogate of proximal policy optimisation (Schulman et al. 2017), the only one of the tree."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def clipped_surrogate(
    log_prob: Float[Tensor, "*rows"],
    old_log_prob: Float[Tensor, "*rows"],
    advantage: Float[Tensor, "*#rows"],
    *,
    clip: float,
) -> Float[Tensor, "*rows"]:
    """-min(r A, clip(r, 1 - c, 1 + c) A) with r = pi / pi_old, elementwise, to be minimised.

    The advantage carries the objective's sign already (`losses.diversity.signed_advantage`): where cross-play returns
    are minimised, -A stands here, so that the clipping bounds the step that lowers them. It carries no gradient.
    """
    ratio = torch.exp(log_prob - old_log_prob.detach())
    advantage = advantage.detach()
    return -torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage)


def clipped_loss(
    log_prob: Float[Tensor, "*rows"],
    old_log_prob: Float[Tensor, "*rows"],
    advantage: Float[Tensor, "*#rows"],
    entropy: Float[Tensor, "*rows"],
    weight: Float[Tensor, "*#rows"],
    *,
    clip: float,
    entropy_scale: float,
) -> Float[Tensor, ""]:
    """Policy loss with the entropy bonus, to be minimised: the mean of w (surrogate - eta H[pi])."""
    surrogate = clipped_surrogate(log_prob, old_log_prob, advantage, clip=clip)
    return (weight * (surrogate - entropy_scale * entropy)).mean()


def negated_surrogate(
    log_prob: Float[Tensor, "*rows"],
    old_log_prob: Float[Tensor, "*rows"],
    advantage: Float[Tensor, "*#rows"],
    *,
    clip: float,
) -> Float[Tensor, "*rows"]:
    """+min(r A, clip(r) A): what two published code bases minimise for cross-play, kept to reproduce their numbers.

    Its improving direction is not clipped: for A > 0 the ratio can fall to 0 within one batch, for A < 0 it can grow
    without bound.
    """
    return -clipped_surrogate(log_prob, old_log_prob, advantage, clip=clip)
