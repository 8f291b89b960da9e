"""Which partner plays in which seat of which environment: cells (partner, seat), drawn evenly or by priority."""

from __future__ import annotations

from typing import Any

import numpy as np

FORGETS = 0.05
"""Share of a cell's running mean that a new return replaces (MEP)."""


class PartnerSeats:
    """The cell of each of N environments; cell c is partner c // P in seat c % P.

    Evenly, the cells are dealt out in turn and every environment goes N cells on at the end of an episode: all partners
    have equally many episodes in each seat, and where the cells divide N nobody ever moves. By priority the next cell
    is drawn with p proportional to rank(1 / running mean return) ** `priority`, the worst cell having the highest rank.

    Args:
        partners: K. rows: N. players: P.
        priority: exponent, None for evenly.
        seed: of the deal and the draws.
    """

    def __init__(self, partners: int, rows: int, players: int, priority: float | None, seed: int) -> None:
        self._priority, self._rng = priority, np.random.default_rng(seed)
        self._players, self.cells = players, partners * players
        self.cell = np.arange(rows) % self.cells
        self.mean = np.full(self.cells, np.nan)

    @property
    def partner(self) -> np.ndarray:
        """(N,) int64, who plays with the ego."""
        return self.cell // self._players

    @property
    def seat(self) -> np.ndarray:
        """(N,) int64, where that partner sits."""
        return self.cell % self._players

    def note_returns(self, rows: np.ndarray, returns: np.ndarray) -> None:
        """Returns of episodes that ended in these rows."""
        for cell, value in zip(self.cell[rows], returns, strict=True):
            before = self.mean[cell]
            self.mean[cell] = value if np.isnan(before) else before + FORGETS * (value - before)

    def move_on(self, rows: np.ndarray) -> None:
        """New episodes begin in these rows."""
        if self._priority is None:
            self.cell[rows] = (self.cell[rows] + len(self.cell)) % self.cells
        else:
            self.cell[rows] = self._rng.choice(self.cells, len(rows), p=self.probabilities())

    def probabilities(self) -> np.ndarray:
        """(2 K,) of the cells; those without a return yet count as the worst, equal ones share their rank."""
        badness = -np.where(np.isnan(self.mean), -np.inf, self.mean)
        _, which, counts = np.unique(badness, return_inverse=True, return_counts=True)
        ranks = (counts.cumsum() - (counts - 1) / 2)[which]
        weights = ranks ** (self._priority or 0.0)
        return weights / weights.sum()

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here."""
        return {"cell": self.cell.copy(), "mean": self.mean.copy(), "generator": self._rng.bit_generator.state}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.cell = np.array(state["cell"], np.int64).reshape(self.cell.shape)
        self.mean = np.array(state["mean"], np.float64).reshape(self.mean.shape)
        self._rng.bit_generator.state = state["generator"]
