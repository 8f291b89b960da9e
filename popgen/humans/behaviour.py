"""What players do in 400 steps: rates of events of people and of clones, and how well these agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from popgen.envs.overcooked.transition_events import EVENTS, find_transition_events
from popgen.humans.recordings import HumanGame, make_human_env
from popgen.play.policy import Policy
from popgen.play.rollout import Transition, play

STEPS = 400
"""Rates are counts in this many steps, an episode."""

MEASURES: dict[str, tuple[str, ...]] = {
    "dishes (team)": ("deliver_soup",),
    "onion pick-ups": ("take_onion_from_dispenser",),
    "dish pick-ups": ("take_dish_from_dispenser",),
    "platings": ("take_soup_from_pot",),
    "moves": ("walk",),
    "actions but stay": tuple(name for name in EVENTS if name not in ("stay", "useful_dish", "walk", "idle_move")),
    "counter pick-ups": tuple(f"take_{thing}_from_counter" for thing in ("onion", "dish", "soup")),
}
"""Name -> the events whose sum it is. Of a player, except what says (team)."""

_COLUMNS = {name: [EVENTS.index(event) for event in events] for name, events in MEASURES.items()}
_IN_TEAM = [name.endswith("(team)") for name in MEASURES]


@dataclass(frozen=True)
class Rates:
    """Rates of each measure in 400 steps: mean and standard deviation over players and games (over games for a team).

    Attributes:
        mean, deviation: (len(MEASURES),) float64.
        games: how many there were.
    """

    mean: np.ndarray
    deviation: np.ndarray
    games: int

    @classmethod
    def of(cls, counts: np.ndarray, steps: np.ndarray) -> Rates:
        """Of event counts (N, 2, T) in games of `steps` (N,)."""
        scaled = counts * (STEPS / np.asarray(steps, float))[:, None, None]
        per_player = np.stack([scaled[..., columns].sum(-1) for columns in _COLUMNS.values()], -1)
        samples = [
            per_player[..., i].sum(1) if team else per_player[..., i].reshape(-1) for i, team in enumerate(_IN_TEAM)
        ]
        ddof = 1 if len(counts) > 1 else 0
        return cls(
            np.array([values.mean() for values in samples]),
            np.array([values.std(ddof=ddof) for values in samples]),
            len(counts),
        )


@dataclass(frozen=True)
class Agreement:
    """How far a clone's mean rates are from people's, in people's standard deviations, measure by measure."""

    distances: np.ndarray

    @property
    def within(self) -> int:
        """Measures at most one standard deviation away."""
        return int((self.distances <= 1.0).sum())

    @property
    def share(self) -> float:
        """The same as a share of all."""
        return self.within / len(self.distances)


def measure_people(games: Sequence[HumanGame]) -> Rates:
    """Rates of the people in recorded games of one layout."""
    env = make_human_env(games[0].layout)
    counts = [find_transition_events(env, game.states[:-1], game.actions).sum(0, dtype=np.int64) for game in games]
    return Rates.of(np.stack(counts), np.array([game.steps for game in games]))


def measure_policies(policies: Sequence[Policy], layout: str, episodes: int, seed: int) -> Rates:
    """Rates of two policies (or one with itself) in full episodes, in both seatings if they differ."""
    env = make_human_env(layout, episodes)
    seats = np.zeros((episodes, 2), int)
    if len(policies) == 2:
        seats[::2], seats[1::2] = (0, 1), (1, 0)
    counts = np.zeros((episodes, 2, len(EVENTS)), np.int64)

    def count(step: Transition) -> None:
        counts[...] += find_transition_events(env, step.states, step.actions)

    play(env, policies, seats, seed=seed, record=count)
    return Rates.of(counts, np.full(episodes, env.spec.horizon))


def compare_rates(people: Rates, clone: Rates) -> Agreement:
    """The distance of the means in people's standard deviations (at least 0.05 events, where all people are alike)."""
    return Agreement(np.abs(clone.mean - people.mean) / np.maximum(people.deviation, 0.05))


def team_dishes(rates: Rates) -> float:
    """Mean dishes of an episode."""
    return float(rates.mean[list(MEASURES).index("dishes (team)")])
