"""The rules of XPM-Sim's training loop as pure functions: who plays, how well, how many updates; and its progress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from popgen.methods.training import State
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.play.episodes import Episode
from popgen.play.rollout import Match
from popgen.types import Kind


@dataclass
class MemberProgress:
    """How far a member's training has come.

    Attributes:
        rounds: of real episodes and updates.
        updates: of actor and critics.
        steps, simulated: environment steps, real and of F.
        scores: the latest real mean scores: `sp`, `xp/K` with each partner, `xp` with the strongest.
    """

    rounds: int = 0
    updates: int = 0
    steps: int = 0
    simulated: int = 0
    scores: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def from_state(state: State) -> MemberProgress:
        """Of a checkpoint."""
        counts = {name: int(state[name]) for name in ("rounds", "updates", "steps", "simulated")}
        return MemberProgress(**counts, scores={str(name): float(value) for name, value in state["scores"].items()})


# ---- who plays, and how well ----------------------------------------------------------------------------------------


def seatings(member: int, partners: Sequence[int], seed: int) -> list[tuple[int, int]]:
    """Both seatings with all partners, in an order of the member's own."""
    order = np.random.default_rng(seed).permutation(partners)
    return [pair for k in order.tolist() for pair in ((member, k), (k, member))]


def round_matches(config: XpmSimConfig, member: int, pairs: Sequence[tuple[int, int]], number: int) -> list[Match]:
    """Self-play, and cross-play with as many pairs as there are episodes; rounds take the pairs in turn."""
    matches = [Match(Kind.SP, (member, member), config.episodes_sp)]
    episodes, count = config.episodes_xp, min(len(pairs), config.episodes_xp)
    for index in range(count):
        pair = pairs[(number * count + index) % len(pairs)]
        matches.append(Match(Kind.XP, pair, episodes // count + (index < episodes % count)))
    return matches


def updates_of_round(config: XpmSimConfig, updates: int) -> int:
    """Updates of the next round after so many; 0 where all are done."""
    return min(config.updates_per_round, config.updates - updates)


def score_round(scores: dict[str, float], episodes: Sequence[Episode], partners: Sequence[int]) -> dict[str, float]:
    """`MemberProgress.scores` after a round, those of partners that it did not meet being the old ones."""
    scores = scores | {"sp": _mean_score(episodes, Kind.SP)}
    met = {k: [e for e in episodes if e.kind is Kind.XP and k in e.members] for k in partners}
    scores |= {f"xp/{k}": _mean_score(played, Kind.XP) for k, played in met.items() if played}
    cross = [value for name, value in scores.items() if name.startswith("xp/")]
    return scores | ({"xp": max(cross)} if cross else {})


def _mean_score(episodes: Sequence[Episode], kind: Kind) -> float:
    return float(np.mean([episode.score for episode in episodes if episode.kind is kind]))
