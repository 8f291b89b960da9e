"""Episodes of chosen players, state by state: what replays are made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.errors import UserError
from popgen.evaluation.crossplay import PARTNERS, RANDOM
from popgen.play.policy import Policy
from popgen.play.rollout import Transition, play
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population
from popgen.reports.crossplay_report import name_pairing


@dataclass(frozen=True)
class RecordedGame:
    """One whole episode.

    Attributes:
        players: label of the player in each seat: a member's number as text, `random` or `idle`.
        seed: of the recording that the game belongs to.
        states: (T + 1, S), the start among them.
        actions: (T, P) uint8.
        scores: (T,) what each step added to the score.
        events: (T, P, E) uint8.
        mates: label of each member of a pair -> that of its mate.
    """

    players: tuple[str, str]
    seed: int
    states: np.ndarray
    actions: np.ndarray
    scores: np.ndarray
    events: np.ndarray
    mates: Mapping[str, str] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """SP, XP, random, idle or itself, as in the SP/XP matrix."""
        return name_pairing(self.players, self.mates)

    @property
    def score(self) -> float:
        """Of the whole episode."""
        return float(self.scores.sum())

    @property
    def steps(self) -> int:
        """T."""
        return len(self.actions)

    def cut(self, steps: int) -> RecordedGame:
        """The first `steps` steps of it."""
        kept = {"states": self.states[: steps + 1], "actions": self.actions[:steps], "scores": self.scores[:steps]}
        return replace(self, **kept, events=self.events[:steps])


def record_games(population: Population, matches: Sequence[tuple[str, str]], seed: int) -> list[RecordedGame]:
    """Play one episode of each match, in one batch: the same arguments give the same games.

    Args:
        population: of the members.
        matches: who sits in seat 0 and seat 1: a member's number as text, `random` or `idle`.
        seed: decides all draws.

    Raises:
        UserError: no matches, or a player that is not there.
    """
    labels = list(dict.fromkeys(label for match in matches for label in match))
    policies = [choose_player(population, label) for label in labels]
    if not matches:
        raise UserError("watch", "there is nobody to watch", "name two players")
    seats = np.array([[labels.index(label) for label in match] for match in matches])
    steps: list[Transition] = []
    env = population.make_env(len(matches))
    play(env, policies, seats, seed=seed, record=steps.append)
    counted = np.stack([step.counted for step in steps])
    mates, games = {str(n): str(mate) for n, mate in enumerate(find_mates(population.members), start=1)}, []
    for row, match in enumerate(matches):
        own = steps[: int(counted[:, row].sum())]
        games.append(
            RecordedGame(
                players=match,
                seed=seed,
                states=np.stack([own[0].states[row], *(step.next_states[row] for step in own)]),
                actions=np.stack([step.actions[row] for step in own]),
                scores=np.array([step.result.score[row] for step in own], np.float64),
                events=np.stack([step.result.events[row] for step in own]),
                mates=mates,
            )
        )
    return games


def choose_player(population: Population, label: str) -> Policy:
    """The policy behind a label; a fresh object each time.

    Raises:
        UserError: there is no such player.
    """
    spec = population.spec
    if label in PARTNERS:
        return RandomPolicy(spec.num_actions) if label == RANDOM else IdlePolicy(spec.action_names)
    if not label.isdecimal() or not 1 <= int(label) <= len(population):
        fix = f"choose among 1 to {len(population)}, random and idle" if len(population) else "train one first"
        raise UserError("player", f"{population.path} has no member {label!r}", fix)
    return population[int(label)]


def draw_states(env: BatchedEnv, states: np.ndarray) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8 of states (T, S); the environment's first row is overwritten."""
    pictures = []
    for state in states:
        env.set_state(state[None], indices=np.array([0]))
        pictures.append(env.render_rgb(0))
    return pictures
