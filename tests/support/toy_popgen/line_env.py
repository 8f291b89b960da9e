"""Two players on a line of cells, one at each end, who are paid for every step that they spend on the same cell."""

from __future__ import annotations

import hashlib

import numpy as np

from popgen.envs import BatchedEnv, EnvSpec, ViewSpec
from popgen.errors import UserError
from popgen.types import StepBatch

LENGTHS = {"short": 3, "long": 7}
MOVES = np.array([-1, 0, 1])


class LineEnv(BatchedEnv):
    """A state is (cell of player 0, cell of player 1, time); the dynamics draw nothing."""

    def __init__(self, variant: str, num_envs: int = 1, *, seed: int = 0, horizon: int = 10) -> None:
        if not 1 <= horizon <= 255:
            raise UserError("env.horizon", f"must be 1 to 255, got {horizon}", "choose 10")
        self.length, self.num_envs, self.horizon = LENGTHS[variant], num_envs, horizon
        self.states = np.zeros((num_envs, 3), np.uint8)
        rules = f"line {self.length} {horizon}"
        self.spec = EnvSpec(
            name=f"line/{variant}",
            horizon=horizon,
            num_actions=3,
            action_names=("left", "stay", "right"),
            state_size=3,
            state_dtype="uint8",
            views={"features": ViewSpec((2,), "uint8", binary=False, scale=float(self.length - 1), swap=(1, 0))},
            event_names=("meets",),
            event_weights=(0.5,),
            score_name="meetings",
            params={"horizon": horizon},
            fingerprint=hashlib.sha256(rules.encode()).hexdigest(),
        )
        self.reset(seed=seed)

    def reset(self, seed: int | None = None, indices: np.ndarray | None = None) -> None:
        """To both ends."""
        self.states[slice(None) if indices is None else indices] = (0, self.length - 1, 0)

    def simulate(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, StepBatch]:
        """Move both players; a wall stops."""
        if actions.shape != (*states.shape[:-1], 2) or actions.min() < 0 or actions.max() > 2:
            raise ValueError(f"actions {actions.shape} do not fit states {states.shape}, or are none of 0, 1, 2")
        following = states.copy()
        moved = states[..., :2].astype(np.int64) + MOVES[actions]
        following[..., :2] = np.clip(moved, 0, self.length - 1)
        following[..., 2] += 1
        met = following[..., 0] == following[..., 1]
        reward = met.astype(np.float32)
        return following, StepBatch(
            reward=reward,
            score=reward.copy(),
            events=np.repeat(met[..., None, None], 2, axis=-2).astype(np.uint8),
            terminated=np.zeros_like(met),
            truncated=following[..., 2] >= self.horizon,
        )

    def step(self, actions: np.ndarray) -> StepBatch:
        """See `simulate`."""
        self.states, batch = self.simulate(self.states, np.asarray(actions))
        return batch

    def get_state(self, indices: np.ndarray | None = None) -> np.ndarray:
        """A copy."""
        return self.states[slice(None) if indices is None else indices].copy()

    def set_state(self, states: np.ndarray, indices: np.ndarray | None = None) -> None:
        """Continue from them."""
        if states.shape[-1] != 3 or states.dtype != np.uint8:
            raise ValueError(f"states must be (..., 3) uint8, got {states.shape} {states.dtype}")
        self.states[slice(None) if indices is None else indices] = states

    def encode(self, states: np.ndarray, view: str = "features") -> np.ndarray:
        """Own cell, then the other's."""
        if view not in self.spec.views:
            raise ValueError(f"no view {view!r}")
        return np.stack([states[..., :2], states[..., 1::-1]], axis=-2)

    def time(self, states: np.ndarray) -> np.ndarray:
        """The last number of a state."""
        return states[..., 2].astype(np.int64)

    def set_time(self, time: np.ndarray) -> None:
        """Overwrite it."""
        self.states[:, 2] = time

    def render_text(self, index: int = 0) -> str:
        """Such as `0.1`, or `X` where both are."""
        cells, (first, second) = ["."] * self.length, self.states[index, :2].tolist()
        cells[first], cells[second] = "0", "1"
        return "".join(cells) if first != second else "".join("X" if i == first else "." for i in range(self.length))

    def render_rgb(self, index: int = 0) -> np.ndarray:
        """Eight pixels a cell, a primary colour for each player."""
        picture = np.full((8, 8 * self.length, 3), 255, np.uint8)
        for player, cell in enumerate(self.states[index, :2].tolist()):
            picture[4 * player : 4 * player + 4, 8 * cell : 8 * cell + 8] = np.eye(3, dtype=np.uint8)[player] * 255
        return picture
