"""The states from which imagination starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

OLD, NEW_SP, NEW_XP = 0, 1, 2


@dataclass(frozen=True)
class Starts:
    """Posteriors of real states. h (N, D) float32; z (N, G) uint8 class indices; pool (N,) uint8: OLD data of
    earlier members and random play, NEW_SP, NEW_XP; partner (N,) int16 of cross-play rows, 0 elsewhere.
    """

    h: np.ndarray
    z: np.ndarray
    pool: np.ndarray
    partner: np.ndarray

    def __len__(self) -> int:
        return len(self.pool)

    @staticmethod
    def concat(parts: list[Starts]) -> Starts:
        """All parts in order."""
        columns = ("h", "z", "pool", "partner")
        return Starts(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


def draw_self_play(
    starts: Starts, count: int, new_share: float, from_xp: float, rng: np.random.Generator
) -> np.ndarray:
    """Rows for imagined self-play: SP *and* XP states (paper, eq. XPM-Sim), which makes mixed play unnecessary.

    `new_share` of them come from this member's own data if there is any, of which `from_xp` from cross-play.
    """
    pools = [np.flatnonzero(starts.pool == pool) for pool in (OLD, NEW_SP, NEW_XP)]
    shares = np.array([1.0 - new_share, new_share * (1.0 - from_xp), new_share * from_xp])
    return _draw_mixture(pools, shares, count, rng)


def draw_cross_play(
    starts: Starts, count: int, new_share: float, partner: int | None, rng: np.random.Generator
) -> np.ndarray:
    """Rows for imagined cross-play with `partner`: XP states recorded with that partner (None: any partner).

    Until such states exist, and for the share of old data, the kept buffer stands in (Algorithm 1 fills
    B_XP with random episodes before anything else).
    """
    own = starts.pool == NEW_XP
    if partner is not None:
        own = own & (starts.partner == partner)
    pools = [np.flatnonzero(starts.pool == OLD), np.flatnonzero(own)]
    return _draw_mixture(pools, np.array([1.0 - new_share, new_share]), count, rng)


def _draw_mixture(pools: list[np.ndarray], shares: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    shares = np.where([len(pool) > 0 for pool in pools], np.maximum(shares, 1e-9), 0.0)
    if not shares.any():
        raise LookupError("there are no states to start imagination from")
    sizes = rng.multinomial(count, shares / shares.sum())
    return np.concatenate([rng.choice(pool, size) for pool, size in zip(pools, sizes, strict=True) if size])
