"""How much of what people do a population covers: the distance of every person to the nearest member."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from popgen.evaluation.played_games import PlayedGame

LEAST_SPREAD = 1.0
"""Events in 400 steps: the unit of what all people do alike, or never."""


@dataclass(frozen=True)
class Coverage:
    """Distances in people's standard deviations, root mean square over events, medians over people.

    Attributes:
        people, members: how many points of each.
        nearest: of a person to the nearest member.
        shuffled: the same of people made up of others' event rates, each event's drawn apart: as near as this comes a
            population that has the ranges of what people do, but not what goes together.
        average: of a person to the average person: a population covers people only where `nearest` is below.
    """

    people: int
    members: int
    nearest: float
    shuffled: float
    average: float


def measure_coverage(
    people: Sequence[PlayedGame], members: Sequence[PlayedGame], *, seed: int, shuffles: int = 20
) -> Coverage:
    """Of games in one layout; members' games are averaged by who played and in which seat.

    Raises:
        ValueError: no games of people or of members.
    """
    if not people or not members:
        raise ValueError("people and members: both need games")
    rates = np.concatenate([game.rates[np.array(game.judged, bool)] for game in people])
    used = rates.std(0) > 0
    centre, scale = rates[:, used].mean(0), np.maximum(rates[:, used].std(0), LEAST_SPREAD)
    points = (rates[:, used] - centre) / scale
    own = (_average_members(members)[:, used] - centre) / scale
    rng = np.random.default_rng(seed)
    made_up = [_nearest_distance(rng.permuted(points, axis=0), own) for _ in range(shuffles)]
    return Coverage(
        people=len(points),
        members=len(own),
        nearest=_nearest_distance(points, own),
        shuffled=float(np.mean(made_up)),
        average=_nearest_distance(points, np.zeros((1, points.shape[1]))),
    )


def _average_members(games: Sequence[PlayedGame]) -> np.ndarray:
    """(m, events) mean rates of each player in each seat."""
    found: dict[tuple[str, int], list[np.ndarray]] = {}
    for game in games:
        for seat, participant in enumerate(game.participants):
            found.setdefault((game.players[seat] or participant, seat), []).append(game.rates[seat])
    return np.stack([np.mean(rates, 0) for rates in found.values()])


def _nearest_distance(points: np.ndarray, own: np.ndarray) -> float:
    """Median over points of the root mean square difference to the nearest of `own`."""
    squares = ((points[:, None] - own[None]) ** 2).mean(-1)
    return float(np.median(np.sqrt(squares.min(1))))
