"""How diverse partners are: BR-Div over what they do, and over what their best responses have to do.

The counts are those of HSP's events of transitions, per episode, as in ZSC-Eval (Wang et al. 2024). In environments
without these the environment's own events take their place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.envs.player_events import count_player_events
from popgen.evaluation.holdout_metrics import Interval
from popgen.evaluation.holdout_players import Player
from popgen.play.event_diversity import Diversity, choose_most_diverse, measure_distances, measure_diversity
from popgen.play.policy import Policy
from popgen.play.rollout import Transition, play


@dataclass(frozen=True)
class PartnerDiversity:
    """BR-Div of some partners.

    Attributes:
        players: K partners.
        counts: (K, F) mean counts of an episode.
        diversity: of all.
        chosen: indices of the most diverse ones that were asked for, ascending.
        chosen_diversity: of these.
        spreads: (group, part) -> mean L1 distance between two members' counts, in which each event's largest count
            over all K partners is 1; `all` of a group, and the members of each skill or role.
        steps: environment steps taken.
    """

    players: tuple[Player, ...]
    counts: np.ndarray
    diversity: Diversity
    chosen: tuple[int, ...]
    chosen_diversity: Diversity
    spreads: Mapping[tuple[str, str], Interval]
    steps: int


class _EventCounter:
    """Sums the events of every row and seat over its episode."""

    def __init__(self, env: BatchedEnv) -> None:
        self.env, self.counts = env, np.zeros(0)

    def __call__(self, step: Transition) -> None:
        events = count_player_events(self.env, step.states, step.actions, step.result) * step.counted[:, None, None]
        self.counts = events if not self.counts.size else self.counts + events


def count_events(
    make: Callable[[int, int], BatchedEnv],
    players: Sequence[Player],
    responses: Sequence[Player] | None,
    episodes: int,
    seed: int,
) -> tuple[np.ndarray, int]:
    """(K, F) mean counts of an episode, and the environment steps taken.

    Args:
        make: (num_envs, seed) -> environment.
        players: K partners.
        responses: their best responses, whose events beside them are counted, in both seats; None counts those of the
            partners in play with themselves, or beside the other of the pair that they were trained in.
        episodes: N for each partner and seat.
        seed: same arguments, same result.
    """
    policies: list[Policy] = [player.make() for player in players]
    beside = [(k, _find_mate(players, k)) for k in range(len(players))]
    if responses is not None:
        beside = [(len(players) + k, k) for k in range(len(players))]
        policies += [player.make() for player in responses]
    # The one whose events count sits in seat 0, then in seat 1.
    matches = [seats for one, other in beside for seats in ((one, other), (other, one))]
    env = make(len(matches) * episodes, 0)
    counter = _EventCounter(env)
    played = play(env, policies, np.repeat(np.array(matches), episodes, axis=0), seed=seed, record=counter)
    table = counter.counts.reshape(len(players), 2, episodes, 2, -1)
    own = np.stack([table[:, seat, :, seat] for seat in (0, 1)], 1)
    return own.mean((1, 2)), played.steps


def _find_mate(players: Sequence[Player], number: int) -> int:
    """Number of the other of a player's pair, its own where there is none."""
    own = players[number]
    for k, other in enumerate(players):
        if own.pair and k != number and (other.source, other.pair) == (own.source, own.pair):
            return k
    return number


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
        ValueError: more are to be chosen than there are.
    """
    counts, steps = count_events(make, players, responses, episodes, seed)
    chosen = choose_most_diverse(counts, len(players) if choose is None else choose)
    return PartnerDiversity(
        players=tuple(players),
        counts=counts,
        diversity=measure_diversity(counts),
        chosen=tuple(chosen),
        chosen_diversity=measure_diversity(counts[chosen]),
        spreads=_measure_spreads(players, counts),
        steps=steps,
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
