"""An environment whose figures can be worked out by hand, and players that follow a script."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec, ViewSpec
from popgen.population.manifest import EnvironmentInfo
from popgen.types import StepBatch

STAY, ONE, TWO, QUIT = range(4)
HORIZON = 6


class TallyEnv(BatchedEnv):
    """The score of a step is a_0 + 10 a_1 (quitting counts 0), the reward twice that; `quit` ends the episode.

    Events are `one` and `two`, by who played them, with weights 1 and 5. A state is (time, a number drawn at reset).
    """

    spec = EnvSpec(
        name="tally/hand",
        horizon=HORIZON,
        num_actions=4,
        action_names=("stay", "one", "two", "quit"),
        state_size=2,
        state_dtype="int64",
        views={"features": ViewSpec((2,), "float32", False), "clock": ViewSpec((1,), "float32", False)},
        event_names=("one", "two"),
        event_weights=(1.0, 5.0),
        score_name="points",
        fingerprint="f" * 64,
    )

    def __init__(self, num_envs: int, seed: int = 0) -> None:
        self.num_envs, self._rng = num_envs, np.random.default_rng(seed)
        self._state, self._over = np.zeros((num_envs, 2), np.int64), np.zeros(num_envs, bool)
        self.reset()

    def reset(self, seed: int | None = None, indices: np.ndarray | None = None) -> None:
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        rows = np.arange(self.num_envs) if indices is None else indices
        self._state[rows, 0], self._over[rows] = 0, False
        self._state[rows, 1] = self._rng.integers(1000, size=len(rows))

    def step(self, actions: np.ndarray) -> StepBatch:
        assert not self._over.any(), "a finished row was not reset"
        self._state, result = self.simulate(self._state, actions)
        self._over = result.done
        return result

    def simulate(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, StepBatch]:
        following = states + np.array([1, 0])
        points = np.where(actions == QUIT, 0, actions)
        score = (points[..., 0] + 10 * points[..., 1]).astype(np.float32)
        events = np.stack([actions == ONE, actions == TWO], -1).astype(np.uint8)
        terminated = (actions == QUIT).any(-1)
        truncated = ~terminated & (following[..., 0] == HORIZON)
        return following, StepBatch(2 * score, score, events, terminated, truncated)

    def get_state(self, indices: np.ndarray | None = None) -> np.ndarray:
        return self._state.copy() if indices is None else self._state[indices].copy()

    def set_state(self, states: np.ndarray, indices: np.ndarray | None = None) -> None:
        self._state[slice(None) if indices is None else indices] = states

    def encode(self, states: np.ndarray, view: str = "features") -> np.ndarray:
        one = states if view == "features" else states[..., :1]
        return np.stack([one, one], -2).astype(np.float32)

    def time(self, states: np.ndarray) -> np.ndarray:
        return states[..., 0].astype(np.int64)

    def set_time(self, time: np.ndarray) -> None:
        self._state[:, 0] = time

    def render_text(self, index: int = 0) -> str:
        return str(self._state[index])

    def render_rgb(self, index: int = 0) -> np.ndarray:
        return np.zeros((1, 1, 3), np.uint8)


class Script:
    """Plays actions[time % len], the same in both seats unless `other` gives those of seat 1; keeps what it saw."""

    kind = "script"

    def __init__(self, actions: Sequence[int], other: Sequence[int] | None = None, view: str = "features") -> None:
        self.view, self._actions = view, (list(actions), list(other or actions))
        self.resets: list[tuple[int, int]] = []
        self.calls: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def reset(self, batch: int, seed: int) -> None:
        self.resets.append((batch, seed))

    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        self.calls.append((obs.copy(), previous_actions.copy(), is_first.copy()))
        time = obs[:, 0, 0].astype(int)
        columns = [np.asarray(actions)[time % len(actions)] for actions in self._actions]
        return np.stack(columns, 1).astype(np.uint8)

    def config(self) -> dict[str, Any]:
        return {}

    def weights(self) -> dict[str, np.ndarray]:
        return {}


class Cast:
    """As much of a population as an evaluation needs, with given members in TallyEnv.

    `pairs`: number of the pair that each was trained in, 0 for none; all of them for no pairs."""

    path = "cast"

    def __init__(self, *members: Script, pairs: Sequence[int] = ()) -> None:
        self._members, self.spec, self.env_info = members, TallyEnv.spec, EnvironmentInfo.of(TallyEnv.spec)
        numbers = pairs or [0] * len(members)
        extras = [{"role": "partner", "pair": pair} if pair else {} for pair in numbers]
        self.members = tuple(type("MemberInfo", (), {"extra": extra})() for extra in extras)
        self.manifest = type("Manifest", (), {"method": "by_hand", "seed": 0})()

    def __len__(self) -> int:
        return len(self._members)

    def __getitem__(self, member: int) -> Script:
        return self._members[member - 1]

    def make_env(self, num_envs: int = 1, seed: int = 0) -> TallyEnv:
        return TallyEnv(num_envs, seed)
