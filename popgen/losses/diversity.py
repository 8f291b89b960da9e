"""The signs of the cross-play objectives: one table for every method.

    J_XPM-Sim(j) = J_SP(j)                     - lambda_XP max_k J_XP(j, k)     (paper, eq. XPM-Sim)
    J_LIPO(j)    = J_SP(j)                     - lambda_XP max_k J_XP(j, k)     (paper, eq. LIPO)
    J_CoMeDi(j)  = J_SP(j) + lambda_MP J_MP(j) - lambda_XP max_k J_XP(j, k)     (paper, eq. CoMeDi)

A sign is applied to the advantage before any surrogate or clipping; value losses never change sign.
"""

from __future__ import annotations

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
