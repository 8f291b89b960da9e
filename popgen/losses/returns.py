"""Returns of trajectories: the only lambda-return and the only GAE of the tree. Time is the first dimension."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def lambda_return(
    reward: Float[Tensor, "H B"], value: Float[Tensor, "H+1 B"], discount: Float[Tensor, "H B"], lam: float
) -> Float[Tensor, "H B"]:
    """Recursive lambda-target (paper, appendix D.1; Dreamer).

        R_t = r_{t+1} + gamma_{t+1} ((1 - lambda) v_{t+1} + lambda R_{t+1}),   R_H = v_H

    Args:
        reward: (H, B), r_{t+1}, what step t earned.
        value: (H + 1, B), v_0 .. v_H.
        discount: (H, B), gamma times the probability that the episode continues after step t.
        lam: lambda in [0, 1].

    Returns:
        (H, B), R_0 .. R_{H-1}.
    """
    if value.shape[0] != reward.shape[0] + 1 or reward.shape != discount.shape:
        raise ValueError(f"shapes: reward {tuple(reward.shape)}, value {tuple(value.shape)}, {tuple(discount.shape)}")
    following = value[-1]
    returns: list[Tensor] = []
    for t in reversed(range(reward.shape[0])):
        following = reward[t] + discount[t] * ((1.0 - lam) * value[t + 1] + lam * following)
        returns.append(following)
    return torch.stack(returns[::-1])


def gae(
    reward: Float[Tensor, "H B"], value: Float[Tensor, "H+1 B"], discount: Float[Tensor, "H B"], lam: float
) -> Float[Tensor, "H B"]:
    """Generalised advantage estimation (Schulman et al. 2016): the lambda-return less the value.

    Args as in `lambda_return`. Returns (H, B) advantages.
    """
    return lambda_return(reward, value, discount, lam) - value[:-1]
