"""Whole games by what each player did in them: of recorded people, and of the members of populations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.transition_events import EVENTS, find_transition_events
from popgen.errors import UserError
from popgen.humans.behaviour import STEPS
from popgen.humans.record_tables import TableGame
from popgen.humans.recordings import HumanGame, make_human_env
from popgen.play.rollout import Transition, play
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population


class PlayedGame(NamedTuple):
    """One game of two players.

    Attributes:
        layout: its environment's name without the family.
        participants: who answers for seat 0 and seat 1: games of one participant are not independent.
        steps: of the game.
        dishes: of the team.
        counts: (2, len(EVENTS)) float64, each player's events.
        judged: whose play is to be judged, by seat: of a person and an ego the person's alone.
        players: who plays in each seat, where several are one participant; "" where participants are players.
    """

    layout: str
    participants: tuple[str, str]
    steps: int
    dishes: float
    counts: np.ndarray
    judged: tuple[bool, bool] = (True, True)
    players: tuple[str, str] = ("", "")

    @property
    def rates(self) -> np.ndarray:
        """(2, len(EVENTS)) events in 400 steps."""
        return self.counts * (STEPS / self.steps)

    @property
    def dish_rate(self) -> float:
        """Dishes in 400 steps."""
        return self.dishes * STEPS / self.steps


def count_people(games: Sequence[HumanGame]) -> list[PlayedGame]:
    """Recorded games; the two people of a pair are one participant, since they only ever played with each other."""
    envs = {layout: make_human_env(layout) for layout in {game.layout for game in games}}
    played = []
    for game in games:
        counts = find_transition_events(envs[game.layout], game.states[:-1], game.actions).sum(0, dtype=np.float64)
        pair = f"{game.half} pair {game.pair}"
        played.append(PlayedGame(game.layout, (pair, pair), game.steps, float(game.dishes.sum()), counts))
    return played


def count_table_games(games: Sequence[TableGame]) -> dict[str, list[PlayedGame]]:
    """Finished games of a table by whom people played with: `people`, or `people with` the other player's name.

    Two people are one participant, whoever has which seat."""
    found: dict[str, list[PlayedGame]] = {}
    for game in games:
        if not any(game.people) or not game.finished:
            continue
        label = "people" if all(game.people) else f"people with {game.players[game.people.index(False)]}"
        counts = find_transition_events(game.env, game.states, game.actions).sum(0, dtype=np.float64)
        together = " and ".join(sorted(game.players))
        names = (together, together) if all(game.people) else game.players
        played = PlayedGame(game.layout, names, len(game.actions), float(game.dishes.sum()), counts, game.people)
        found.setdefault(label, []).append(played)
    return found


def count_members(population: Population, episodes: int, seed: int) -> list[PlayedGame]:
    """Games of every member with itself, or with its mate where it was trained in a pair: what it does beside a partner
    that shares its conventions.

    The two of a pair play as many games in each seating. They share their dishes, so that they are one participant.

    Args:
        population: of members in Overcooked.
        episodes: N of each member.
        seed: same arguments, same result.

    Raises:
        UserError: the population does not play Overcooked, or has no members.
    """
    size = len(population)
    if not size:
        raise UserError("population", f"{population.path} has no members yet", "train one first")
    mates = np.array(find_mates(population.members)) - 1
    seats = np.stack([np.arange(size), mates], 1).repeat(episodes, 0)
    env = population.make_env(len(seats))
    if not isinstance(env, OvercookedEnv):
        raise UserError("population", f"{population.path} plays {env.spec.name}, not Overcooked", "give another one")
    counts, steps = np.zeros((len(seats), 2, len(EVENTS))), np.zeros(len(seats), np.int64)

    def count(step: Transition) -> None:
        counts[...] += find_transition_events(env, step.states, step.actions) * step.counted[:, None, None]
        steps[...] += step.counted

    members = [population[member] for member in range(1, size + 1)]
    result = play(env, members, seats, seed=seed, record=count)
    layout = env.spec.name.rpartition("/")[2]
    return [
        PlayedGame(
            layout,
            participants=(_name_members(both), _name_members(both)),
            steps=int(steps[row]),
            dishes=float(result.score[row]),
            counts=counts[row],
            players=(f"member {both[0] + 1}", f"member {both[1] + 1}"),
        )
        for row, both in enumerate(seats)
    ]


def _name_members(seats: np.ndarray) -> str:
    """One member, or the two of a pair in the same order in both seatings."""
    numbers = sorted({int(member) + 1 for member in seats})
    return f"member{'s' * (len(numbers) > 1)} {' and '.join(map(str, numbers))}"
