"""The signs of the cross-play objectives: one table for every method.

    J_XPM-Sim(j) = J_SP(j)                     - lambda_XP max_k J_XP(j, k)     (paper, eq. XPM-Sim)
    J_LIPO(j)    = J_SP(j)                     - lambda_XP max_k J_XP(j, k)     (paper, eq. LIPO)
    J_CoMeDi(j)  = J_SP(j) + lambda_MP J_MP(j) - lambda_XP max_k J_XP(j, k)     (paper, eq. CoMeDi)

A sign is applied to the advantage before any surrogate or clipping; value losses never change sign.

Two further options of every such objective, ours:

    a bound       cross-play's advantages count for at most `clip` spreads of self-play's
    a constraint  maximise J_SP(j) subject to J_XP(j, k) <= limit for every k, by multipliers m_k in [0, 1]: not the
                  strongest partner's J_XP falls, but one that is drawn in proportion to m_k, with lambda_XP max_k m_k
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from popgen.types import Kind

SIGN: dict[Kind, float] = {Kind.SP: +1.0, Kind.MP: +1.0, Kind.XP: -1.0}


def signed_advantage(
    kind: Kind, advantage: Float[Tensor, "*rows"], *, weight: float, scale: Float[Tensor, ""] | float
) -> Float[Tensor, "*rows"]:
    """Advantage as it enters the policy gradient: sign x weight x advantage / scale.

    `scale` comes from *self-play* for every kind (the on-policy baselines take the kind's own spread where that is
    larger): cross-play's own, smaller spread would multiply lambda several-fold. Cross-play advantages are centred,
    since pushing all returns down would otherwise reward leaving the states in which they were collected.
    """
    if kind is Kind.XP:
        advantage = advantage - advantage.mean()
    return SIGN[kind] * weight * advantage / scale


def bound_advantage(
    advantage: Float[Tensor, "*rows"], *, clip: float, spread: Float[Tensor, ""] | float
) -> Float[Tensor, "*rows"]:
    """Cross-play's advantages, at most `clip` spreads of self-play's in size (0: as they are): so a large loss for the
    team, such as the penalty of leaving, is no larger gain than holding to another convention."""
    bound = spread * (clip or math.inf)
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
