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
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population


@dataclass(frozen=True)
class HeldMember:
    """How a member does.

    Attributes:
        member: from 1.
        sp: score with itself; of one that was trained in a pair with its mate, mean over both seatings.
        xp: score with the earlier member that it does best with, its mate aside, mean over both seatings; None where
            there is none.
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
    mates = zip(numbers, find_mates(population.members), strict=True)
    return HeldScores(episodes, seed, played.steps, tuple(_describe_member(*both, scores) for both in mates))


def _describe_member(member: int, mate: int, scores: dict[tuple[int, int], np.ndarray]) -> HeldMember:
    def beside(other: int) -> Estimate:
        return Estimate.average([Estimate.of(scores[member, other]), Estimate.of(scores[other, member])])

    own = Estimate.of(scores[member, member]) if mate == member else beside(mate)
    others = {k: beside(k) for k in range(1, member) if k != mate}
    if not others:
        return HeldMember(member, own, None, None)
    best = max(others, key=lambda k: others[k].mean)
    return HeldMember(member, own, others[best], best)
