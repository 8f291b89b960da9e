"""The constraint that cross-play with every partner is low enough, by one multiplier a partner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from popgen.losses.diversity import next_multiplier


class PartnerConstraint:
    """Maximise J_SP(j) subject to J_XP(j, k) <= `limit` for every partner k (`popgen.losses.diversity`).

    Every multiplier is 1 until its partner has been met, so that the pressure is whole while conventions are chosen.
    Below the limit there is nothing to gain: a member that holds to a convention of its own has no reason to do worse.

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

    def multiplier(self, partner: int) -> float:
        """m_k in [0, 1]."""
        return self.multipliers.get(partner, 1.0)

    def state(self) -> dict[str, float]:
        """JSON-able."""
        return {str(partner): value for partner, value in self.multipliers.items()}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the multipliers by those of `state()`."""
        self.multipliers = {int(partner): float(value) for partner, value in state.items()}
