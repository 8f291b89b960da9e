"""What policies learn from: returns, surrogates, the signs of the cross-play objectives, schedules of their weights.

Pure functions of tensors; time is the first dimension of trajectories. The only lambda-return, GAE, clipped surrogate
and table of signs of the tree:

    J_XPM-Sim(j) = J_SP(j)                     - lambda_XP max_k J_XP(j, k)     (paper, eq. XPM-Sim)
    J_LIPO(j)    = J_SP(j)                     - lambda_XP max_k J_XP(j, k)     (paper, eq. LIPO)
    J_CoMeDi(j)  = J_SP(j) + lambda_MP J_MP(j) - lambda_XP max_k J_XP(j, k)     (paper, eq. CoMeDi)

A sign is applied to the advantage before any surrogate or clipping; value losses never change sign.

Further options of every such objective, ours:

    a floor       a step of cross-play counts no less than `floor`, an early end so for each step that was left
    a bound       cross-play's advantages count for at most `clip` units of self-play's
    a constraint  maximise J_SP(j) subject to J_XP(j, k) <= limit for every k, by multipliers m_k in [0, 1]: not the
                  strongest partner's J_XP falls, but one that is drawn in proportion to m_k, with lambda_XP max_k m_k
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from popgen.types import Kind

# ---- returns ---------------------------------------------------------------------------------------------------------


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


# ---- signs of the objectives -----------------------------------------------------------------------------------------


SIGN: dict[Kind, float] = {Kind.SP: +1.0, Kind.MP: +1.0, Kind.XP: -1.0}


def signed_advantage(
    kind: Kind, advantage: Float[Tensor, "*rows"], *, weight: float, unit: Float[Tensor, ""] | float
) -> Float[Tensor, "*rows"]:
    """Advantage as it enters the policy gradient: sign x weight x advantage / unit.

    `unit` comes from *self-play* for every kind (the on-policy baselines take the kind's own spread where that is
    larger): cross-play's own, smaller spread would multiply lambda several-fold. Cross-play advantages are centred,
    since pushing all returns down would otherwise reward leaving the states in which they were collected.
    """
    if kind is Kind.XP:
        advantage = advantage - advantage.mean()
    return SIGN[kind] * weight * advantage / unit


def floor_reward(
    reward: Float[Tensor, "*steps"], covered: Float[Tensor, "*steps"], floor: float | None
) -> Float[Tensor, "*steps"]:
    """Cross-play's rewards, none of them below `floor` for each step that it stands for (`covered_steps`); None: as
    they are. What costs the team more than holding to another convention does, such as leaving, is then no gain."""
    return reward if floor is None else torch.maximum(reward, floor * covered)


def bound_advantage(
    advantage: Float[Tensor, "*rows"], *, clip: float, unit: Float[Tensor, ""] | float
) -> Float[Tensor, "*rows"]:
    """Cross-play's advantages, clipped to +-`clip` times `unit`, which comes from self-play (0: as they are): so a
    large loss for the team, such as the penalty of leaving, is no larger gain than holding to another convention."""
    bound = unit * (clip or math.inf)
    return advantage.clamp(-float(bound), float(bound))


def next_multiplier(multiplier: float, cross_play: float, self_play: float, *, limit: float, step: float) -> float:
    """The multiplier m_k in [0, 1] of J_XP(j, k) <= limit after new estimates of both scores.

    Projected dual ascent on the excess of cross-play over the limit, as a share of self-play's excess: m_k rises by
    `step` where cross-play is as good as self-play, and falls as far below the limit as it rises above. A member whose
    self-play is not above the limit has no convention yet, and nothing changes.
    """
    if self_play <= limit:
        return multiplier
    excess = (cross_play - limit) / (self_play - limit)
    return min(1.0, max(0.0, multiplier + step * excess))


# ---- the clipped surrogate -------------------------------------------------------------------------------------------


def clipped_surrogate(
    log_prob: Float[Tensor, "*rows"],
    old_log_prob: Float[Tensor, "*rows"],
    advantage: Float[Tensor, "*#rows"],
    *,
    clip: float,
) -> Float[Tensor, "*rows"]:
    """-min(r A, clip(r, 1 - c, 1 + c) A) with r = pi / pi_old, elementwise, to be minimised.

    The advantage carries the objective's sign already (`signed_advantage`): where cross-play returns
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


# ---- REINFORCE -------------------------------------------------------------------------------------------------------


def reinforce(
    log_prob: Float[Tensor, "*rows"],
    advantage: Float[Tensor, "*#rows"],
    entropy: Float[Tensor, "*rows"],
    weight: Float[Tensor, "*#rows"],
    *,
    entropy_scale: float,
) -> Float[Tensor, ""]:
    """Policy-gradient loss, to be minimised:  -E[w (A log pi(a|z) + eta H[pi])].

    All tensors broadcast to (H, B, ...); `advantage` and `weight` carry no gradient. `weight` is the
    probability that the imagined episode still runs.
    """
    return -(weight.detach() * (advantage.detach() * log_prob + entropy_scale * entropy)).mean()


class ReturnScale(nn.Module):
    """Moving range between two percentiles of the returns, at least 1 (DreamerV3's normaliser)."""

    range: Tensor
    weight: Tensor

    def __init__(self, percentiles: tuple[float, float], decay: float = 0.99) -> None:
        super().__init__()
        self.percentiles, self.decay = percentiles, decay
        self.register_buffer("range", torch.zeros(()))
        self.register_buffer("weight", torch.zeros(()))

    def update(self, returns: Float[Tensor, "*rows"]) -> Float[Tensor, ""]:
        """Take in a batch of returns; the new scale (a scalar, no gradient)."""
        quantiles = torch.tensor(self.percentiles, device=returns.device) / 100.0
        low, high = torch.quantile(returns.detach().float().flatten(), quantiles)
        self.range.mul_(self.decay).add_((1.0 - self.decay) * (high - low))
        self.weight.mul_(self.decay).add_(1.0 - self.decay)
        return self.value()

    def value(self) -> Float[Tensor, ""]:
        """max(1, bias-corrected moving range)."""
        return (self.range / self.weight.clamp(min=1e-8)).clamp(min=1.0)


# ---- schedules -------------------------------------------------------------------------------------------------------


def linear_schedule(start: float, end: float, done: int | float, length: int | float) -> float:
    """From `start` to `end`, even over `length` steps of which `done` are over; `end` at once where `length` is 0."""
    return start + (end - start) * min(1.0, done / length) if length else end


def geometric(start: float, end: float, done: int | float, length: int | float) -> float:
    """From `start` to `end` by the same factor in every step; even where `end` is 0, which no factor reaches."""
    share = min(1.0, done / length)
    return start * (end / start) ** share if end else start * (1.0 - share)


def annealed(start: float, end_share: float, progress: int | float) -> float:
    """From `start` to `end_share` of it, even over the budget of which the share `progress` is used up."""
    left = 1.0 - min(1.0, max(0.0, progress))
    return start * (end_share + (1.0 - end_share) * left)
