"""Held evaluation of finished members: fresh episodes of the very policies that a population holds.

Scores in training are windows over several policies, or the ones by which a policy was chosen; neither says how good
the chosen policy is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from popgen.errors import UserError
from popgen.evaluation.estimates import Estimate
from popgen.play.policy import Policy
from popgen.play.rollout import play_teams
from popgen.population.store import Population


@dataclass(frozen=True)
class HeldMember:
    """How a member does.

    Attributes:
        member: from 1.
        sp: score with itself.
        xp: score with the earlier member that it does best with, mean over both seatings; None for the first.
        partner: that member.
    """

    member: int
    sp: Estimate
    xp: Estimate | None
    partner: int | None


@dataclass(frozen=True)
class HeldScores:
    """All members of a population.

    Attributes:
        episodes, seed: for each member alone, and for each pair and seating.
        steps: environment steps taken, kind `evaluation`.
        members: in order.
    """

    episodes: int
    seed: int
    steps: int
    members: tuple[HeldMember, ...]


def hold_members(population: Population, episodes: int, seed: int) -> HeldScores:
    """Play each member with itself and, in both seatings, with each earlier one.

    Args:
        population: of at least one member.
        episodes: N for each of these.
        seed: same arguments, same result.

    Raises:
        UserError: no members, or less than one episode.
    """
    if not len(population):
        raise UserError(str(population.path), "has no members yet", "train at least one first")
    if episodes < 1:
        raise UserError("episodes", f"must be at least 1, got {episodes}")
    numbers = range(1, len(population) + 1)
    policies: list[Policy] = [population[member] for member in numbers]
    matches = [(a, b) for m in numbers for k in range(1, m + 1) for a, b in dict.fromkeys([(m, k), (k, m)])]
    seats = [(a - 1, b - 1) for a, b in matches]
    played = play_teams(population.make_env, policies, seats, episodes, seed=seed)
    scores = dict(zip(matches, played.score.reshape(len(matches), episodes), strict=True))
    return HeldScores(episodes, seed, played.steps, tuple(_describe_member(member, scores) for member in numbers))


def _describe_member(member: int, scores: dict[tuple[int, int], np.ndarray]) -> HeldMember:
    alone = Estimate.of(scores[member, member])
    beside = [
        Estimate.average([Estimate.of(scores[member, k]), Estimate.of(scores[k, member])]) for k in range(1, member)
    ]
    if not beside:
        return HeldMember(member, alone, None, None)
    best = int(np.argmax([one.mean for one in beside]))
    return HeldMember(member, alone, beside[best], best + 1)
