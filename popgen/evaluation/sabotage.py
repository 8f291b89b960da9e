"""Self-sabotage: how often an agent ends cross-play by leaving the task, instead of holding to another convention.

The measure of the paper's section "Empirical Analysis of Self-Sabotage Behavior" and its table "Results of the MPPMR
environment". It needs an environment with an event that says which player left.

For agent m and each earlier agent k < m that is not its mate, with which it was trained in a pair, both seatings are
played. The paper counts every episode that ended early, whoever ended it (`ended_early`, "any exit"). An agent cannot
help what its partner does, so that `self_sabotage` ("own exit") counts the episodes in which agent m itself left; where
both leave in the same step, both count. Agent 1 has no earlier agents; as in the paper it stands as 0 and counts in the
average.

Not to leave is no merit of members that share one convention: what they share stands beside it. Of two members at one
landmark cross-play is as good as self-play; `xp_apart` is that of the other pairs, and what members get beside a random
and an idle partner tells how much of it is a convention that the partner does not have. Self-play of one that was
trained in a pair is its play with its mate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.evaluation.crossplay import PARTNERS
from popgen.evaluation.estimates import Estimate
from popgen.play.episodes import Episodes
from popgen.play.policy import Policy
from popgen.play.rollout import Transition, play, play_teams
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population

LEAVES = "leaves"
"""How the name of an event begins by which a player leaves the task."""


@runtime_checkable
class Plane(Protocol):
    """An environment whose players move on a plane with a boundary and landmarks."""

    bounds: float
    landmarks: np.ndarray

    def positions(self, states: np.ndarray) -> np.ndarray:
        """Where the players are, (..., P, 2), in states (..., S)."""
        ...


@dataclass(frozen=True)
class Paths:
    """Where the players went, one episode of each ordered pair of M members.

    Attributes:
        positions: (M, M, T + 1, P, 2), NaN after the end of an episode; row = member in seat 0.
        left: (M, M, P) bool, who left the bounds.
        bounds: half side of the square.
        landmarks: (K, 2).
    """

    positions: np.ndarray
    left: np.ndarray
    bounds: float
    landmarks: np.ndarray


@dataclass(frozen=True)
class SabotageResult:
    """What M members do to each other.

    Attributes:
        environment, params: that it was played in.
        event: by which players leave.
        episodes: N, per ordered pair.
        seed: of the evaluation.
        steps: environment steps taken, kind `evaluation`.
        exits: (M, M, N, P) bool, who left; [i, j] is member i + 1 in seat 0 with member j + 1 in seat 1.
        ended: (M, M, N) bool, the episode ended before the horizon.
        scores: (M, M, N), the episodes' scores.
        beside: partner (`random`, `idle`) -> the members' mean score with it, both seatings.
        landmarks: (M, K) how many self-play episodes of a member ended at each landmark; None without landmarks.
        paths: None where players do not move on a plane.
        mates: number of each member's mate, from 1; its own where it has none; empty where nobody has one.
    """

    environment: str
    params: Mapping[str, Any]
    event: str
    episodes: int
    seed: int
    steps: int
    exits: np.ndarray
    ended: np.ndarray
    scores: np.ndarray
    beside: Mapping[str, Estimate]
    landmarks: np.ndarray | None
    paths: Paths | None
    mates: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """M."""
        return len(self.exits)

    def self_sabotage(self, member: int) -> float:
        """Fraction of the episodes with earlier members in which `member` (from 1) itself left; 0 where none are."""
        own, earlier = member - 1, self._list_earlier(member - 1)
        parts = [self.exits[own, k, :, 0] for k in earlier] + [self.exits[k, own, :, 1] for k in earlier]
        return float(np.mean(parts)) if parts else 0.0

    def ended_early(self, member: int) -> float:
        """Fraction of the episodes with earlier members that ended early, whoever ended them: the paper's reading."""
        own, earlier = member - 1, self._list_earlier(member - 1)
        parts = [self.ended[own, k] for k in earlier] + [self.ended[k, own] for k in earlier]
        return float(np.mean(parts)) if parts else 0.0

    @property
    def average(self) -> float:
        """Mean self-sabotage over all members, the first included."""
        return float(np.mean([self.self_sabotage(m + 1) for m in range(self.size)]))

    @property
    def average_ended_early(self) -> float:
        """Mean of `ended_early` over all members, the first included."""
        return float(np.mean([self.ended_early(m + 1) for m in range(self.size)]))

    @property
    def sp(self) -> Estimate:
        """Mean score over members of play with the mate, each in seat 0, or with itself."""
        return Estimate.average([Estimate.of(self.scores[m, self._find_mate(m)]) for m in range(self.size)])

    @property
    def xp(self) -> Estimate:
        """Mean cross-play score over ordered pairs of different members, no mates; NaN where there are none."""
        return self._average_pairs([(i, j) for i in range(self.size) for j in self._list_earlier(i)])

    def _find_mate(self, member: int) -> int:
        """Whom a member plays its own play with, both from 0."""
        return self.mates[member] - 1 if self.mates else member

    def _list_earlier(self, member: int) -> list[int]:
        """Members before it, its mate aside, from 0."""
        return [k for k in range(member) if k != self._find_mate(member)]

    @property
    def xp_apart(self) -> Estimate:
        """Mean cross-play score of the pairs that do not share a landmark; NaN where there is none."""
        shared = set(self.sharing)
        earlier = [(i, j) for i in range(self.size) for j in self._list_earlier(i)]
        return self._average_pairs([(i, j) for i, j in earlier if (j + 1, i + 1) not in shared])

    def _average_pairs(self, pairs: Sequence[tuple[int, int]]) -> Estimate:
        """Mean over pairs, counted from 0, in both seatings."""
        return Estimate.average([Estimate.of(self.scores[seats]) for i, j in pairs for seats in ((i, j), (j, i))])

    @property
    def sharing(self) -> list[tuple[int, int]]:
        """Pairs of members (from 1, the earlier first), no mates, whose self-play ends at the same landmark."""
        used = [self.landmark(member + 1) for member in range(self.size)]
        pairs = [(i, j) for j in range(self.size) for i in self._list_earlier(j)]
        return [(i + 1, j + 1) for i, j in pairs if used[i] is not None and used[i] == used[j]]

    def count_pairs(self) -> int:
        """Pairs of different members, no mates."""
        return sum(len(self._list_earlier(member)) for member in range(self.size))

    def landmark(self, member: int) -> int | None:
        """Landmark (from 1) at which more than half of a member's self-play ends; None where there is none."""
        if self.landmarks is None:
            return None
        counts = self.landmarks[member - 1]
        best = int(np.argmax(counts))
        return best + 1 if counts[best] > self.episodes / 2 else None

    @property
    def used(self) -> list[int]:
        """Landmarks that at least one member uses."""
        found = {self.landmark(member + 1) for member in range(self.size)}
        return sorted(landmark for landmark in found if landmark is not None)


def leave_event(spec: EnvSpec) -> str:
    """Name of the event by which a player leaves the task.

    Raises:
        UserError: the environment has none, or several.
    """
    found = [name for name in spec.event_names if name.startswith(LEAVES)]
    if len(found) != 1:
        have = ", ".join(spec.event_names)
        problem = f"{spec.name} has {'several events' if found else 'no event'} by which a player leaves ({have})"
        raise UserError("env.name", problem, "choose an environment like rendezvous/mppmr")
    return found[0]


def measure_sabotage(
    population: Population, episodes: int, seed: int, params: Mapping[str, Any] | None = None
) -> SabotageResult:
    """Play every ordered pair of members and see who leaves.

    Args:
        population: of at least one member.
        episodes: N, per ordered pair.
        seed: same arguments, same result.
        params: parameters of the environment that are to differ from those the members were trained with, such as
            the rule by which an exit is paid. The same seed gives the same actions as long as observations are equal.

    Raises:
        UserError: no members, less than one episode, or an environment without an event of leaving.
    """
    if not len(population):
        raise UserError(str(population.path), "has no members yet", "train at least one first")
    if episodes < 1:
        raise UserError("episodes", f"must be at least 1, got {episodes}")
    info, count = population.env_info, len(population)
    matches = np.array([(i, j) for i in range(count) for j in range(count)])
    env = make_env(info.name, len(matches) * episodes, seed=0, **{**info.params, **(params or {})})
    event = env.spec.event_names.index(leave_event(env.spec))
    policies: list[Policy] = [population[member + 1] for member in range(count)]
    recorder = _PositionRecorder(env)
    played = play(env, policies, np.repeat(matches, episodes, axis=0), seed=seed, record=recorder)
    besides = _play_beside(population, policies, episodes, seed, env.spec.params)
    shape, mates = (count, count, episodes), find_mates(population.members)
    exits = (played.events[..., event] > 0).reshape(*shape, -1)
    return SabotageResult(
        environment=info.name,
        params=dict(env.spec.params),
        event=env.spec.event_names[event],
        episodes=episodes,
        seed=seed,
        steps=played.steps + besides.steps,
        exits=exits,
        ended=(played.length < env.spec.horizon).reshape(shape),
        scores=played.score.reshape(shape),
        beside=_estimate_beside(besides.score.reshape(len(PARTNERS), 2 * count, episodes)),
        landmarks=_count_landmarks(env, recorder, played, shape, mates),
        paths=_first_paths(env, recorder, exits, shape),
        mates=mates,
    )


def _play_beside(
    population: Population, policies: Sequence[Policy], episodes: int, seed: int, params: Mapping[str, Any]
) -> Episodes:
    """Every member in both seats with each of PARTNERS: rows by partner, member, seat and episode."""
    info, count = population.env_info, len(policies)
    spec = population.spec
    others: list[Policy] = [RandomPolicy(spec.num_actions), IdlePolicy(spec.action_names)]
    numbers = range(count, count + len(PARTNERS))
    matches = [pair for k in numbers for member in range(count) for pair in ((member, k), (k, member))]
    rules = dict(params)
    return play_teams(
        lambda size, first: make_env(info.name, size, seed=first, **rules),
        [*policies, *others],
        matches,
        episodes,
        seed=seed,
    )


def _estimate_beside(scores: np.ndarray) -> dict[str, Estimate]:
    """Of scores (partners, pairs, N)."""
    means = [Estimate.average([Estimate.of(pair) for pair in part]) for part in scores]
    return dict(zip(PARTNERS, means, strict=True))


class _PositionRecorder:
    """Keeps the positions of all rows, step by step."""

    def __init__(self, env: BatchedEnv) -> None:
        self.env = env if isinstance(env, Plane) else None
        self.positions: list[np.ndarray] = []

    def __call__(self, step: Transition) -> None:
        if self.env is None:
            return
        if not self.positions:
            self.positions.append(self.env.positions(step.states))
        here = self.env.positions(step.next_states)
        self.positions.append(np.where(step.counted[:, None, None], here, np.nan))

    def stack_positions(self) -> np.ndarray:
        """(B, T + 1, P, 2), NaN after the end of an episode."""
        return np.stack(self.positions, axis=1)


def _count_landmarks(
    env: BatchedEnv,
    recorder: _PositionRecorder,
    played: Episodes,
    shape: tuple[int, int, int],
    mates: Sequence[int],
) -> np.ndarray | None:
    """(M, K): episodes of each member with its mate or itself that ran to the horizon and ended with both players'
    centre at a landmark.

    At a landmark is nearer than a quarter of the least distance between two of them, so that no place belongs to two.
    """
    if not isinstance(env, Plane) or len(env.landmarks) < 2:
        return None
    rows = np.arange(len(played.length))
    last = recorder.stack_positions()[rows, played.length].mean(axis=1)  # (B, 2)
    between = np.linalg.norm(env.landmarks[:, None] - env.landmarks[None], axis=-1)
    reach = between[~np.eye(len(between), dtype=bool)].min() / 4
    near = np.linalg.norm(last[:, None] - env.landmarks[None], axis=-1) < reach  # (B, K)
    near &= (played.length == env.spec.horizon)[:, None]
    return near.reshape(*shape, -1)[np.arange(shape[0]), np.array(mates) - 1].sum(axis=1)


def _first_paths(
    env: BatchedEnv, recorder: _PositionRecorder, exits: np.ndarray, shape: tuple[int, int, int]
) -> Paths | None:
    """The first episode of each pair."""
    if not isinstance(env, Plane):
        return None
    positions = recorder.stack_positions()
    first = positions.reshape(*shape, *positions.shape[1:])[:, :, 0]
    return Paths(first, exits[:, :, 0], float(env.bounds), np.asarray(env.landmarks))


def to_dict(result: SabotageResult) -> dict[str, Any]:
    """The JSON-able figures; null stands for what is unknown."""
    members = range(1, result.size + 1)
    return {
        "environment": {"name": result.environment, "params": dict(result.params)},
        "event": result.event,
        "episodes": result.episodes,
        "seed": result.seed,
        "steps": {"evaluation": result.steps},
        "members": list(members),
        "self_sabotage": [result.self_sabotage(m) for m in members],
        "average": result.average,
        "ended_early": [result.ended_early(m) for m in members],
        "average_ended_early": result.average_ended_early,
        "sp": result.sp.to_dict(),
        "xp": result.xp.to_dict(),
        "xp_apart": result.xp_apart.to_dict(),
        "pairs": {"all": result.count_pairs(), "sharing": [list(pair) for pair in result.sharing]},
        "beside": {partner: mean.to_dict() for partner, mean in result.beside.items()},
        "matrix": result.scores.mean(axis=-1).tolist(),
        "exits": result.exits.mean(axis=2).tolist(),
        "landmarks": _describe_landmarks(result),
    }


def _describe_landmarks(result: SabotageResult) -> dict[str, Any] | None:
    if result.landmarks is None:
        return None
    members = [result.landmark(m) for m in range(1, result.size + 1)]
    return {
        "used": result.used,
        "of": result.landmarks.shape[1],
        "members": members,
        "counts": result.landmarks.tolist(),
    }
