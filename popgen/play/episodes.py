"""Finished episodes: one by one as they end in training, and as columns for statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

import numpy as np

from popgen.types import RANDOM_MEMBER, Kind

if TYPE_CHECKING:
    import pandas as pd


def _no_events() -> np.ndarray:
    return np.zeros((2, 0), np.int64)


@dataclass(frozen=True)
class Episode:
    """One whole finished episode of a match.

    Attributes:
        kind, members, owner: of its match.
        score: sum of the environment's score (dishes in Overcooked).
        shaped: sum of the training reward, undiscounted (`popgen.envs.reward`).
        events: (P, E) int64, how often each player caused each event; without columns where nobody counted them.
    """

    kind: Kind
    members: tuple[int, int]
    score: float
    shaped: float
    events: np.ndarray = field(default_factory=_no_events, compare=False)
    owner: int = RANDOM_MEMBER

    def partner_of(self, member: int) -> int:
        """Who played with `member` (itself in self-play)."""
        first, second = self.members
        return second if first == member else first


@dataclass(frozen=True, repr=False)
class Episodes:
    """N full episodes, one per row. Score, reward and shaped return are different figures.

    Attributes:
        seats: (N, P) int, index of the policy in each seat.
        score: (N,) float64, sum of the environment's score (dishes in Overcooked).
        reward: (N,) float64, sum of the environment's own reward.
        events: (N, P, E) int64, how often each player caused each event.
        shaped: (N, P) float64, the events weighted by `EnvSpec.event_weights`, per seat.
        length: (N,) int64, steps of the episode.
        terminated: (N,) bool, the task itself ended, early or with a horizon that is its end.
        steps: environment steps taken in all, those of rows that waited for longer episodes included.
    """

    seats: np.ndarray
    score: np.ndarray
    reward: np.ndarray
    events: np.ndarray
    shaped: np.ndarray
    length: np.ndarray
    terminated: np.ndarray
    steps: int

    def __repr__(self) -> str:
        score = (
            f"score {self.score.mean():.2f} (from {self.score.min():g} to {self.score.max():g})" if len(self) else ""
        )
        return f"<{len(self)} episodes: {score}, {self.steps:,} environment steps>"

    def __len__(self) -> int:
        return len(self.score)

    def to_frame(self) -> pd.DataFrame:
        """An episode a row: seats, score, reward, length, whether the task itself ended, shaped return of each seat."""
        import pandas as pd  # samplers, which import this module, do without

        columns: dict[str, np.ndarray] = {}
        for seat in range(self.seats.shape[1]):
            columns |= {f"seat_{seat}": self.seats[:, seat], f"shaped_{seat}": self.shaped[:, seat]}
        columns |= {name: getattr(self, name) for name in ("score", "reward", "length", "terminated")}
        return pd.DataFrame(columns)

    @staticmethod
    def concat(parts: Sequence[Episodes]) -> Episodes:
        """All parts in order."""
        names = [column.name for column in fields(Episodes) if column.name != "steps"]
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return Episodes(**arrays, steps=sum(part.steps for part in parts))
