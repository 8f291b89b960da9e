"""Random actions of partners, so that an ego meets more than what its partners do in their own games."""

from __future__ import annotations

from typing import Any

import numpy as np


class PartnerNoise:
    """In half of the episodes a partner plays as it is; in the others a share of its actions is random, and this share
    is drawn evenly from 0 to `most` for the episode.

    Args:
        most: largest share. rows: N, environments. actions: how many there are. seed: of all draws.
    """

    def __init__(self, most: float, rows: int, actions: int, seed: int) -> None:
        self._most, self._actions = most, actions
        self._rng = np.random.default_rng(seed)
        self._share = np.zeros(rows)

    def blur_actions(self, actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """(N,) uint8 actions with random ones among them; shares are drawn anew where `is_first`."""
        count = int(is_first.sum())
        if count:
            drawn = self._rng.random(count) * self._most
            self._share[is_first] = np.where(self._rng.random(count) < 0.5, 0.0, drawn)
        random = self._rng.integers(self._actions, size=len(actions), dtype=np.uint8)
        return np.where(self._rng.random(len(actions)) < self._share, random, actions)

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here."""
        return {"share": self._share.copy(), "generator": self._rng.bit_generator.state}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self._share = np.array(state["share"], np.float64).reshape(self._share.shape)
        self._rng.bit_generator.state = state["generator"]
