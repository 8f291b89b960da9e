"""The constraint that cross-play with every partner is low enough, by one multiplier a partner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from popgen.losses.diversity import next_multiplier


class PartnerConstraint:
    """Maximise J_SP(j) subject to J_XP(j, k) <= `limit` for every partner k (`popgen.losses.diversity`).

    Every multiplier is 1 until its partner has been met, so that the pressure is whole while conventions are chosen.
    Below the limit there is nothing to gain: a member that holds to a convention of its own has no reason to do worse.
    A partner is drawn in proportion to the multipliers: the strongest may be one whose convention has to be shared, as
    there are fewer conventions than members, and under max_k it would take the whole pressure, which only sabotage
    could relieve.

    Args:
        limit: a score; None: there is no constraint, and every multiplier is 1.
        step: of dual ascent, each time that scores with a partner arrive.
    """

    def __init__(self, limit: float | None, step: float) -> None:
        self.limit, self.step = limit, step
        self.multipliers: dict[int, float] = {}

    def add(self, cross_play: Mapping[int, float], self_play: float | None) -> None:
        """New mean scores by partner, and that of the member's own self-play (None: not known yet)."""
        if self.limit is None or self_play is None:
            return
        for partner, score in cross_play.items():
            now = self.multiplier(partner)
            self.multipliers[partner] = next_multiplier(now, score, self_play, limit=self.limit, step=self.step)

    def draw_partner(self, partners: Sequence[int], rng: np.random.Generator) -> int:
        """One of the partners, in proportion to their multipliers; any where all of these are 0."""
        weights = np.array([self.multiplier(partner) for partner in partners])
        total = weights.sum()
        return int(rng.choice(list(partners), p=weights / total if total else None))

    def multiplier(self, partner: int) -> float:
        """m_k in [0, 1]."""
        return self.multipliers.get(partner, 1.0)

    def pressure(self, partners: Sequence[int]) -> float:
        """The largest multiplier of the partners: the share of lambda_XP that one of them, drawn, gets."""
        return max(self.multiplier(partner) for partner in partners)

    def state(self) -> dict[str, float]:
        """JSON-able."""
        return {str(partner): value for partner, value in self.multipliers.items()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the multipliers by those of `state()`."""
        self.multipliers = {int(partner): float(value) for partner, value in state.items()}
