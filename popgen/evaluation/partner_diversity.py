"""How diverse partners are: BR-Div over what they do, and over what their best responses have to do.

BR-Div is that of ZSC-Eval (Wang et al. 2024): mean counts per episode of its 14 kinds
(`popgen.envs.player_events.BR_DIV_EVENTS`), those in seat 0 and those in seat 1 as different ones. Counts and spreads
beside it are of all of HSP's 17 events, over both seats. In environments without these the environment's own events
take their place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.envs.player_events import (
    count_diversity_events,
    count_player_events,
    name_diversity_events,
    name_player_events,
)
from popgen.errors import UserError
from popgen.evaluation.holdout_metrics import Interval
from popgen.evaluation.holdout_players import Player, list_distinct, seat_mates
from popgen.play.event_diversity import Diversity, choose_most_diverse, measure_distances, measure_diversity
from popgen.play.policy import Policy
from popgen.play.rollout import Transition, play


@dataclass(frozen=True)
class PartnerDiversity:
    """BR-Div of some partners.

    Attributes:
        players: K partners.
        counts: (K, F) mean counts of an episode, over both seats.
        kinds: (K, 2 F') mean counts of what BR-Div is of, those in seat 0 and then those in seat 1.
        count_names, kind_names: of the F events, and of the 2 F' kinds, with the seat.
        diversity: of all.
        chosen: indices of the most diverse ones that were asked for, ascending.
        chosen_diversity: of these.
        spreads: (group, part) -> mean L1 distance between two members' counts, in which each event's largest count
            over all K partners is 1; `all` of a group, and the members of each skill or role.
        steps: environment steps taken.
    """

    players: tuple[Player, ...]
    counts: np.ndarray
    kinds: np.ndarray
    count_names: tuple[str, ...]
    kind_names: tuple[str, ...]
    diversity: Diversity
    chosen: tuple[int, ...]
    chosen_diversity: Diversity
    spreads: Mapping[tuple[str, str], Interval]
    steps: int


class _EventCounter:
    """Sums the events of every row and seat over its episode, and what BR-Div is of."""

    def __init__(self, env: BatchedEnv) -> None:
        self.env, self.counts, self.kinds = env, np.zeros(()), np.zeros(())

    def __call__(self, step: Transition) -> None:
        taken = (self.env, step.states, step.actions, step.result)
        counted = step.counted[:, None, None]
        self.counts = self.counts + count_player_events(*taken) * counted
        self.kinds = self.kinds + count_diversity_events(*taken) * counted


class _Counts(NamedTuple):
    """(K, 2, F) and (K, 2, F') mean counts of an episode by seat: HSP's events, and what BR-Div is of; their names."""

    events: np.ndarray
    kinds: np.ndarray
    event_names: tuple[str, ...]
    kind_names: tuple[str, ...]
    steps: int


def count_events(
    make: Callable[[int, int], BatchedEnv],
    players: Sequence[Player],
    responses: Sequence[Player] | None,
    episodes: int,
    seed: int,
) -> tuple[np.ndarray, int]:
    """(K, F) mean counts of an episode over both seats, and the environment steps taken; copies of one policy are
    played once, so that chance does not make them different.

    Args:
        make: (num_envs, seed) -> environment.
        players: K partners.
        responses: their best responses, whose events beside them are counted, in both seats; None counts those of the
            partners in play with themselves, or beside the other of the pair that they were trained in.
        episodes: N for each partner and seat.
        seed: same arguments, same result.
    """
    counts = _count_by_seat(make, players, responses, episodes, seed)
    return counts.events.mean(1), counts.steps


def _count_by_seat(
    make: Callable[[int, int], BatchedEnv],
    players: Sequence[Player],
    responses: Sequence[Player] | None,
    episodes: int,
    seed: int,
) -> _Counts:
    everybody, mates = seat_mates(players)
    beside = list(enumerate(mates))
    if responses is not None:
        everybody = [*players, *responses]
        beside = [(len(players) + k, k) for k in range(len(players))]
    policies: list[Policy] = [player.make() for player in everybody]
    kept = list_distinct(players)
    # The one whose events count sits in seat 0, then in seat 1.
    matches = [seats for k in kept for seats in (beside[k], beside[k][::-1])]
    env = make(len(matches) * episodes, 0)
    counter = _EventCounter(env)
    played = play(env, policies, np.repeat(np.array(matches), episodes, axis=0), seed=seed, record=counter)
    rows = _find_rows(players, kept)
    tables = (counts.reshape(len(kept), 2, episodes, 2, -1) for counts in (counter.counts, counter.kinds))
    events, kinds = (np.stack([table[:, seat, :, seat].mean(1) for seat in (0, 1)], 1)[rows] for table in tables)
    return _Counts(events, kinds, name_player_events(env), name_diversity_events(env), played.steps)


def _find_rows(players: Sequence[Player], kept: Sequence[int]) -> list[int]:
    """For each player the row of `kept` that is the same policy."""
    rows = {players[place].identity: row for row, place in enumerate(kept)}
    own = {place: row for row, place in enumerate(kept)}
    return [own.get(place, rows[player.identity]) for place, player in enumerate(players)]


def measure_partners(
    make: Callable[[int, int], BatchedEnv],
    players: Sequence[Player],
    responses: Sequence[Player] | None,
    episodes: int,
    seed: int,
    *,
    choose: int | None = None,
) -> PartnerDiversity:
    """BR-Div of partners, and of the `choose` most diverse ones (all without it); see `count_events`.

    Raises:
        UserError: more are to be chosen than are linearly independent, so that every choice has the determinant 0.
        ValueError: more are to be chosen than there are.
    """
    counted = _count_by_seat(make, players, responses, episodes, seed)
    counts, kinds = counted.events.mean(1), counted.kinds.reshape(len(players), -1)
    diversity = measure_diversity(kinds)
    chosen = list(range(len(players))) if choose is None else choose_most_diverse(kinds, choose)
    if choose is not None and choose > diversity.rank:
        whose = "their own events" if responses is None else "their best responses' events"
        problem = (
            f"is {choose}, but by {whose} only {diversity.rank} of {len(players)} partners are linearly independent"
        )
        fix = f"choose {diversity.rank} or fewer" if diversity.rank else "give partners that do something"
        raise UserError("--choose", problem, fix)
    return PartnerDiversity(
        players=tuple(players),
        counts=counts,
        kinds=kinds,
        count_names=counted.event_names,
        kind_names=tuple(f"{name}_seat_{seat}" for seat in (0, 1) for name in counted.kind_names),
        diversity=diversity,
        chosen=tuple(chosen),
        chosen_diversity=measure_diversity(kinds[chosen]),
        spreads=_measure_spreads(players, counts),
        steps=counted.steps,
    )


def _measure_spreads(players: Sequence[Player], counts: np.ndarray) -> dict[tuple[str, str], Interval]:
    distances, rows = measure_distances(counts), dict[tuple[str, str], list[int]]()
    for k, player in enumerate(players):
        for part in ("all", player.part) if player.part else ("all",):
            rows.setdefault((player.group, part), []).append(k)
    return {key: _mean_distance(distances[np.ix_(own, own)]) for key, own in rows.items() if len(own) > 1}


def _mean_distance(distances: np.ndarray) -> Interval:
    """Mean over pairs of (K, K) distances; the interval is two jackknife standard errors, for other members."""
    size, total = len(distances), float(distances.sum())
    mean = total / (size * (size - 1))
    if size < 3:
        return Interval(mean, 0.0, math.inf)
    without = (total - 2.0 * distances.sum(1)) / ((size - 1) * (size - 2))
    error = math.sqrt((size - 1) / size * float(((without - without.mean()) ** 2).sum()))
    return Interval(mean, mean - 2.0 * error, mean + 2.0 * error)
