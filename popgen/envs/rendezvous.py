"""Multi Particle Point Mass Rendezvous (MPPMR): two point masses meet at one of four landmarks.

The task is LIPO's (Charakorn et al., 2023) with the fixed boundary of the XPM-WM paper (its sections "Empirical
Analysis of Self-Sabotage Behavior" and "Environment description"). The dynamics are linear and exact, so that
`RendezvousEnv.simulate` is the known model F(s, a) of XPM-Sim:

    v' = v (1 - damping) + sensitivity u timestep        u in {(0,0), (-1,0), (1,0), (0,-1), (0,1)}
    p' = p + v' timestep

This is the order of `World.integrate_state` in PettingZoo's MPE core at the time of LIPO; since its pull request 965
(May 2023), and in MPE2, the position moves first, with the old velocity: `integration="position_first"`.

Every player gets the same reward, of the positions after the step:

    full      1 - |nearest landmark - centroid| - |p_0 - p_1|          (the paper's formula)
    centroid  1 - |nearest landmark - centroid| - |p_i - centroid|     (LIPO's code; equal for both players)
"""

from __future__ import annotations

import hashlib
import json
import math
from numbers import Integral, Real
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec, ViewSpec
from popgen.envs.rendezvous_pictures import draw_map, draw_picture
from popgen.errors import UserError
from popgen.types import StepBatch, check

ACTION_NAMES = ("stay", "left", "right", "down", "up")
FORCES = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], dtype=np.float64)
STATE_SIZE = 9
"""(x, y, vx, vy) of player 0, the same of player 1, time step."""
RULES = (
    "timestep",
    "damping",
    "sensitivity",
    "bounds",
    "landmark_distance",
    "start_distance",
    "start_noise",
    "horizon",
    "ending",
    "distance",
    "exit_penalty",
    "exit_reward",
    "integration",
)
"""Parameters that decide what happens: attributes of `RendezvousEnv`, the specification's `params`."""

_TIME = 8
_LANDMARKS = 4
# Features of player 0 -> of player 1: the two bodies and the two landmark blocks change places, time stays.
_SWAP = (*range(4, 8), *range(4), *range(16, 24), *range(8, 16), 24)
_LIMIT = 1e3  # of every length, force and time parameter, so that no reachable number overflows float32


class RendezvousEnv(BatchedEnv):
    """B rendezvous tasks in float64.

    A state is (x, y, vx, vy) of player 0, the same of player 1, and the time step: S = 9, float64.
    The only view, `features`, shows each player 25 float32 numbers, itself first: own position and velocity,
    the other's, the four landmarks relative to itself, relative to the other, and time / horizon.

    Args:
        variant: `mppmr`, the only one.
        num_envs: B.
        seed: of the generator behind `start_noise`.
        timestep: time between two steps, in (0, 1000].
        damping: share of the velocity lost per step, in [0, 1].
        sensitivity: force of one action on a unit mass, in [0, 1000].
        bounds: half side of the square; a player with |x| or |y| above it has left.
        landmark_distance: the landmarks stand at (+-this, +-this), inside the bounds.
        start_distance: player 0 starts at (this, 0), player 1 at (-this, 0), at rest: LIPO's `easy` start.
        start_noise: half side of the square, around each start, from which the start is drawn; 0 as in LIPO.
        horizon: steps after which an episode ends.
        ending: what the horizon is. `terminal`: the task itself ends there, as the paper's return is a sum over the
            horizon's steps, the features show how much of it is over and an exit costs no step beyond it. `truncated`:
            the episode is cut, and a critic adds what it expects of steps that are never played.
        distance: `full` or `centroid`, see the module.
        exit_penalty: `absorbing` charges a leaver's team `exit_reward` for each step that the episode still had,
            added, undiscounted, to the reward of the last step; `none` ends the episode without it. Rewards are
            mostly negative, so that plain termination raises a bad return.
        exit_reward: reward per remaining step, at most 0; None takes the worst reward that positions in bounds can
            give (`worst_reward`), -4.303 with the other defaults.
        integration: `velocity_first` or `position_first`, see the module.

    Raises:
        UserError: unknown variant or choice, or a number outside its range.
    """

    def __init__(
        self,
        variant: str = "mppmr",
        num_envs: int = 1,
        *,
        seed: int = 0,
        timestep: float = 0.1,
        damping: float = 0.25,
        sensitivity: float = 5.0,
        bounds: float = 1.5,
        landmark_distance: float = 0.75,
        start_distance: float = 0.3,
        start_noise: float = 0.0,
        horizon: int = 50,
        ending: str = "terminal",
        distance: str = "full",
        exit_penalty: str = "absorbing",
        exit_reward: float | None = None,
        integration: str = "velocity_first",
    ) -> None:
        _check_choice("name", variant, ("mppmr",))
        self.timestep = _check_number("timestep", timestep, 0.0, _LIMIT, above=True)
        self.damping = _check_number("damping", damping, 0.0, 1.0)
        self.sensitivity = _check_number("sensitivity", sensitivity, 0.0, _LIMIT)
        self.bounds = _check_number("bounds", bounds, 0.0, _LIMIT, above=True)
        self.landmark_distance = _check_number("landmark_distance", landmark_distance, 0.0, self.bounds)
        self.start_distance = _check_number("start_distance", start_distance, 0.0, self.bounds)
        self.start_noise = _check_number("start_noise", start_noise, 0.0, self.bounds - self.start_distance)
        self.horizon = _check_integer("horizon", horizon, 1, 1_000_000)
        self.ending = _check_choice("ending", ending, ("terminal", "truncated"))
        self.distance = _check_choice("distance", distance, ("full", "centroid"))
        self.exit_penalty = _check_choice("exit_penalty", exit_penalty, ("absorbing", "none"))
        self.integration = _check_choice("integration", integration, ("velocity_first", "position_first"))
        self.exit_reward = _resolve_exit_reward(
            exit_reward, self.exit_penalty, worst_reward(self.bounds, self.landmark_distance, self.distance)
        )
        self.num_envs = _check_integer("num_envs", num_envs, 1, 2**31)
        corner = self.landmark_distance
        self.landmarks = np.array([(x, y) for x in (-corner, corner) for y in (-corner, corner)])
        self.spec = make_spec(variant, {name: getattr(self, name) for name in RULES})
        self._states = np.zeros((self.num_envs, STATE_SIZE))
        self._rng = np.random.default_rng(_check_integer("seed", seed, 0, 2**63))
        self.reset()

    def reset(self, seed: int | None = None, indices: np.ndarray | None = None) -> None:
        """Put the players at their starts, at rest, at time 0; rows draw noise in the order of `indices`."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        rows = np.arange(self.num_envs)[slice(None) if indices is None else indices]
        states = np.zeros((rows.size, STATE_SIZE))
        states[:, [0, 4]] = self.start_distance, -self.start_distance
        if self.start_noise:
            shift = self._rng.uniform(-self.start_noise, self.start_noise, size=(rows.size, 2, 2))
            states[:, :_TIME].reshape(-1, 2, 4)[..., :2] += shift
        self._states[rows] = states

    def step(self, actions: np.ndarray) -> StepBatch:
        """Play joint actions (B, P); a player found outside the bounds ends the episode."""
        self._states, batch = self.simulate(self._states, actions)
        return batch

    def simulate(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, StepBatch]:
        """F(s, a): states (..., S) and actions (..., P) to the next states (..., S) and what the step gave.

        Pure: neither the arguments nor this environment's own states change. The arrays of the StepBatch have the
        same leading shape as the states.

        Raises:
            ValueError: wrong shape or dtype, or an action outside 0..4.
        """
        states, actions = _checked_states(states), np.asarray(actions)
        check(actions, (*states.shape[:-1], 2), "actions")
        known = np.issubdtype(actions.dtype, np.integer) and ((actions >= 0) & (actions < len(ACTION_NAMES))).all()
        if not known:
            raise ValueError("actions: expected whole numbers from 0 to 4")
        following = states.copy(order="C")
        bodies = following[..., :_TIME].reshape(*states.shape[:-1], 2, 4)  # a view: C order
        self._move_bodies(bodies[..., :2], bodies[..., 2:], FORCES[actions])
        following[..., _TIME] += 1
        return following, self._find_outcome(bodies[..., :2], following[..., _TIME])

    def _move_bodies(self, position: np.ndarray, velocity: np.ndarray, force: np.ndarray) -> None:
        """Advance both players of all environments in place; every argument is (..., P, 2)."""
        if self.integration == "position_first":
            position += velocity * self.timestep
        velocity *= 1.0 - self.damping
        velocity += self.sensitivity * force * self.timestep
        if self.integration == "velocity_first":
            position += velocity * self.timestep

    def _find_outcome(self, position: np.ndarray, time: np.ndarray) -> StepBatch:
        """What it gives to arrive at `position` (..., P, 2) at `time` (...)."""
        left = np.asarray((np.abs(position) > self.bounds).any(axis=-1))
        exited, over = np.asarray(left.any(axis=-1)), time >= self.horizon
        terminated = exited | over if self.ending == "terminal" else exited
        penalty = np.where(exited, np.maximum(self.horizon - time, 0.0) * self.exit_reward, 0.0)
        reward = np.asarray(reward_positions(position, self.landmarks, self.distance) + penalty, dtype=np.float32)
        return StepBatch(
            reward=reward,
            score=reward.copy(),
            events=left[..., None].astype(np.uint8),
            terminated=terminated,
            truncated=over & ~terminated,
        )

    def get_state(self, indices: np.ndarray | None = None) -> np.ndarray:
        """Copy of the states (B, S) float64, of all environments or of `indices`."""
        return self._states.copy() if indices is None else self._states[indices].copy()

    def set_state(self, states: np.ndarray, indices: np.ndarray | None = None) -> None:
        """Continue from `states`; raises ValueError on a wrong shape or dtype or a number that is not finite."""
        rows = np.arange(self.num_envs)[slice(None) if indices is None else indices]
        states = _checked_states(states)
        check(states, (rows.size, STATE_SIZE), "states")
        self._states[rows] = states

    def generator_state(self) -> dict[str, Any]:
        """Of the generator of start positions."""
        return dict(self._rng.bit_generator.state)

    def load_generator_state(self, state: dict[str, Any]) -> None:
        """Draw on from `generator_state()`."""
        self._rng.bit_generator.state = state

    def encode(self, states: np.ndarray, view: str = "features") -> np.ndarray:
        """Features (..., P, 25) float32 of states (..., S); raises ValueError on another view."""
        if view not in self.spec.views:
            raise ValueError(f"view: {view!r} is unknown, this environment has {', '.join(self.spec.views)}")
        return encode_features(states, self.landmarks, self.horizon)

    def time(self, states: np.ndarray) -> np.ndarray:
        """Time steps (...) int64 of states (..., S)."""
        return np.asarray(states)[..., _TIME].astype(np.int64)

    def positions(self, states: np.ndarray) -> np.ndarray:
        """Where the players are, (..., P, 2) float64, in any states (..., S)."""
        states = np.asarray(states)
        check(states, (*states.shape[:-1], STATE_SIZE), "states")
        return states[..., :_TIME].reshape(*states.shape[:-1], 2, 4)[..., :2].copy()

    def set_time(self, time: np.ndarray) -> None:
        """Overwrite the time steps (B,)."""
        time = np.asarray(time)
        check(time, (self.num_envs,), "time")
        self._states[:, _TIME] = time

    def render_text(self, index: int = 0) -> str:
        """A map, 31 columns by 15 rows (L landmark, 0 and 1 players, 8 both), and a line of figures."""
        figures = f"step {int(self._states[index, _TIME])}/{self.horizon}"
        return draw_map(self._find_bodies(index)[:, :2], self.landmarks, self.bounds, figures)

    def render_rgb(self, index: int = 0) -> np.ndarray:
        """A picture (256, 256, 3) uint8: blue landmarks, a red player 0 and a green player 1, y upwards."""
        return draw_picture(self._find_bodies(index)[:, :2], self.landmarks, self.bounds)

    def _find_bodies(self, index: int) -> np.ndarray:
        return self._states[index, :_TIME].reshape(2, 4)


def encode_features(states: np.ndarray, landmarks: np.ndarray, horizon: int) -> np.ndarray:
    """Features (..., P, 25) float32 of states (..., S), see `RendezvousEnv`; landmarks are (4, 2)."""
    states = np.asarray(states)
    check(states, (*states.shape[:-1], STATE_SIZE), "states")
    lead = states.shape[:-1]
    bodies = states[..., :_TIME].reshape(*lead, 2, 4)
    relative = (landmarks - bodies[..., None, :2]).reshape(*lead, 2, 2 * _LANDMARKS)
    features = np.empty((*lead, 2, len(_SWAP)), dtype=np.float32)
    features[..., 0:4] = bodies
    features[..., 4:8] = bodies[..., ::-1, :]
    features[..., 8:16] = relative
    features[..., 16:24] = relative[..., ::-1, :]
    features[..., 24] = states[..., _TIME, None] / horizon
    return features


def reward_positions(position: np.ndarray, landmarks: np.ndarray, distance: str) -> np.ndarray:
    """Joint reward (...) float64 of positions (..., P, 2), without the exit penalty; landmarks are (4, 2)."""
    first, second = position[..., 0, :], position[..., 1, :]
    centroid = (first + second) / 2.0
    nearest = _measure_length(landmarks - centroid[..., None, :]).min(axis=-1)
    apart = _measure_length(first - second) if distance == "full" else _measure_length(first - centroid)
    return 1.0 - nearest - apart


def largest_feature(rules: dict[str, Any]) -> float:
    """Bound on every feature's magnitude in an episode: speed, overshoot at the exit, relative landmarks."""
    kept = 1.0 - rules["damping"]
    steps = rules["horizon"] if rules["damping"] == 0.0 else (1.0 - kept ** rules["horizon"]) / rules["damping"]
    speed = rules["sensitivity"] * rules["timestep"] * steps
    return max(1.0, speed, rules["bounds"] + speed * rules["timestep"] + rules["landmark_distance"])


def make_spec(variant: str, rules: dict[str, Any]) -> EnvSpec:
    """The record that the rest of popgen works with."""
    facts = json.dumps({"family": "rendezvous", "version": 1, **rules}, sort_keys=True)
    return EnvSpec(
        name=f"rendezvous/{variant}",
        horizon=rules["horizon"],
        num_actions=len(ACTION_NAMES),
        action_names=ACTION_NAMES,
        state_size=STATE_SIZE,
        state_dtype="float64",
        views={"features": ViewSpec((len(_SWAP),), "float32", binary=False, scale=largest_feature(rules), swap=_SWAP)},
        event_names=("leaves_bounds",),
        event_weights=(0.0,),
        score_name="return",
        params=rules,
        fingerprint=hashlib.sha256(facts.encode()).hexdigest(),
    )


def worst_reward(bounds: float, landmark_distance: float, distance: str = "full") -> float:
    """Lowest reward of one step that two players inside the bounds can get.

    With the centroid at distances (u, v) from the axes, the players can be at most 2 (bounds - u) and
    2 (bounds - v) apart along them, and the nearest landmark is |(u, v) - (L, L)| away. The sum of both lengths is
    convex in (u, v), so that its maximum over [0, bounds]^2 lies in a corner. With the defaults this is (0, 0), the
    players in opposite corners of the square: 1 - 0.75 sqrt(2) - 3 sqrt(2) = -4.303.
    """
    share = 2.0 if distance == "full" else 1.0  # |p_i - centroid| is half of |p_0 - p_1|
    loss = max(
        math.hypot(u - landmark_distance, v - landmark_distance) + share * math.hypot(bounds - u, bounds - v)
        for u, v in ((0.0, 0.0), (bounds, 0.0), (bounds, bounds))
    )
    return 1.0 - loss


def _resolve_exit_reward(value: float | None, penalty: str, worst: float) -> float:
    """The reward per remaining step that a rule of exits charges; `worst` where none is given."""
    if penalty == "none":
        if value:
            raise UserError("env.exit_reward", "has no meaning with exit_penalty=none", "use exit_penalty=absorbing")
        return 0.0
    return worst if value is None else _check_number("exit_reward", value, -_LIMIT, 0.0)


def _checked_states(states: np.ndarray) -> np.ndarray:
    """The states (..., S) themselves; ValueError unless they are finite float64."""
    states = np.asarray(states)
    check(states, (*states.shape[:-1], STATE_SIZE), "states")
    if states.dtype != np.float64:
        raise ValueError(f"states: expected float64, got {states.dtype}")
    if not np.isfinite(states).all():
        raise ValueError("states: every number must be finite")
    return states


def _measure_length(vectors: np.ndarray) -> np.ndarray:
    """Euclidean length (...) of vectors (..., 2)."""
    return np.sqrt(vectors[..., 0] * vectors[..., 0] + vectors[..., 1] * vectors[..., 1])


def _check_number(name: str, value: Any, low: float, high: float, *, above: bool = False) -> float:
    """`value` as a float in [low, high], or in (low, high] with `above`; else UserError."""
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise UserError(f"env.{name}", f"must be a finite number, got {value!r}")
    number = float(value)
    if not low <= number <= high or (above and number == low):
        limits = f"above {low:g} and at most {high:g}" if above else f"from {low:g} to {high:g}"
        raise UserError(f"env.{name}", f"must be {limits}, got {value!r}")
    return number


def _check_integer(name: str, value: Any, low: int, high: int) -> int:
    """`value` as an int in [low, high]; else UserError."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
        raise UserError(f"env.{name}", f"must be a whole number from {low} to {high}, got {value!r}")
    return int(value)


def _check_choice(name: str, value: Any, choices: tuple[str, ...]) -> str:
    if value not in choices:
        raise UserError(f"env.{name}", f"{value!r} is unknown", f"choose one of {', '.join(choices)}")
    return value
