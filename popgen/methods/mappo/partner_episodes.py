"""Which partner a member is trained against: the one with which it earns most."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class PartnerEpisodes:
    """Returns and scores of the latest episodes with each partner, both seatings together.

    Args:
        partners: members.
        window: episodes remembered of each; None remembers all since `forget`.
    """

    def __init__(self, partners: Sequence[int], window: int | None) -> None:
        self.returns: dict[int, deque[float]] = {partner: deque(maxlen=window) for partner in partners}
        self.scores: dict[int, deque[float]] = {partner: deque(maxlen=window) for partner in partners}

    def add(self, partner: int, reward: float, score: float) -> None:
        """Take in an episode: its training reward and its score."""
        self.returns[partner].append(reward)
        self.scores[partner].append(score)

    def forget(self, partner: int) -> None:
        """Only episodes from now on count."""
        self.returns[partner].clear()
        self.scores[partner].clear()

    def strongest(self) -> int:
        """The partner of the highest mean return; one without episodes comes first, the lowest number of equals.

        Raises:
            ValueError: there are no partners.
        """
        return max(
            sorted(self.returns),
            key=lambda k: float(np.mean(self.returns[k])) if self.returns[k] else np.inf,
        )

    def choose(self, random_share: float, rng: np.random.Generator) -> int:
        """The strongest, or now and then any."""
        any_partner = int(rng.choice(sorted(self.returns)))
        return any_partner if rng.random() < random_share else self.strongest()

    def mean_scores(self) -> dict[int, float]:
        """Partner -> mean score of its episodes, of those that have some."""
        return {k: float(np.mean(scores)) for k, scores in self.scores.items() if scores}

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            str(k): {"returns": list(self.returns[k]), "scores": list(self.scores[k])} for k in sorted(self.returns)
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from `state()`."""
        for k in self.returns:
            self.forget(k)
            self.returns[k].extend(state[str(k)]["returns"])
            self.scores[k].extend(state[str(k)]["scores"])
