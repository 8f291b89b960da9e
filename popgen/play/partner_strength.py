"""What a member's real cross-play says about each partner: the strongest one is trained against."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np


class PartnerStrength:
    """Real returns by partner, from the episodes of B_XP that one member was in.

    rule: `max_window` knows a partner by the mean of its latest window, the episodes last added; `max_buffer` by the
    mean of all. A partner without episodes has no score: it counts as not seen yet.
    """

    def __init__(self, rule: Literal["max_window", "max_buffer"]) -> None:
        self.rule = rule
        self._windows: dict[int, list[float]] = {}
        self._sums: dict[int, list[float]] = {}

    def add(self, partner: int, returns: Sequence[float]) -> None:
        """A window of episodes with `partner`; an empty one says nothing."""
        if not len(returns):
            return
        self._windows[partner] = [float(value) for value in returns]
        total, count = self._sums.get(partner, [0.0, 0])
        self._sums[partner] = [total + float(np.sum(returns)), count + len(returns)]

    def scores(self) -> dict[int, float]:
        """Mean return of every partner seen."""
        if self.rule == "max_window":
            return {partner: float(np.mean(window)) for partner, window in self._windows.items()}
        return {partner: total / count for partner, (total, count) in self._sums.items()}

    def state(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "windows": {str(partner): window for partner, window in self._windows.items()},
            "sums": {str(partner): sums for partner, sums in self._sums.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`."""
        self._windows = {int(partner): list(window) for partner, window in state["windows"].items()}
        self._sums = {int(partner): list(sums) for partner, sums in state["sums"].items()}
