"""Start states of self-play beside the environment's own: states of earlier play, moved on at random.

Most failures in cross-play are states that self-play never shows (Gessler et al. 2025, OvercookedV2): an agent that has
learned from many of them fails less with strangers, without any partner to learn with.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.methods.ego.config import AugmentConfig


class AugmentedStarts:
    """An even sample of all states that were played through, and the starts made of them.

    Args:
        config: share, random steps and size of the sample.
        env: the batch whose episodes begin here.
        whole: time steps are rounded down to multiples of it, so that episodes end where rollouts do.
        seed: of all draws.
    """

    def __init__(self, config: AugmentConfig, env: BatchedEnv, whole: int, seed: int) -> None:
        self._config, self._env, self._whole = config, env, whole
        self._rng = np.random.default_rng(seed)
        spec = env.spec
        self._kept = np.zeros((config.kept, spec.state_size), np.dtype(spec.state_dtype))
        self._seen = self._simulated = 0

    def see(self, states: np.ndarray) -> None:
        """One state of this step, drawn from the batch (N, S), enters the sample (reservoir sampling)."""
        state = states[self._rng.integers(len(states))]
        place = self._seen if self._seen < len(self._kept) else int(self._rng.integers(self._seen + 1))
        if place < len(self._kept):
            self._kept[place] = state
        self._seen += 1

    def begin(self, rows: np.ndarray) -> np.ndarray:
        """Give a share of these rows, which were just reset, another start; (R,) bool, which of them."""
        chosen = self._rng.random(len(rows)) < self._config.share
        if not self._seen or not chosen.any():
            return np.zeros(len(rows), bool)
        count, env = int(chosen.sum()), self._env
        states = self._kept[self._rng.integers(min(self._seen, len(self._kept)), size=count)]
        steps = self._rng.integers(self._config.random_steps + 1, size=count)
        for step in range(int(steps.max(initial=0))):
            actions = self._rng.integers(env.spec.num_actions, size=(count, env.spec.num_players), dtype=np.uint8)
            following, result = env.simulate(states, actions)
            asked = step < steps
            self._simulated += int(asked.sum())
            goes_on = asked & ~result.done
            states = np.where(goes_on[:, None], following, states)
        env.set_state(states, rows[chosen])
        time = env.time(env.get_state())
        time[rows[chosen]] -= time[rows[chosen]] % self._whole
        env.set_time(time)
        return chosen

    def take_simulated(self) -> int:
        """Simulated steps of the starts since the last call."""
        taken, self._simulated = self._simulated, 0
        return taken

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here."""
        return {"kept": self._kept.copy(), "seen": self._seen, "generator": self._rng.bit_generator.state}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self._kept = np.array(state["kept"], self._kept.dtype).reshape(self._kept.shape)
        self._seen = int(state["seen"])
        self._rng.bit_generator.state = state["generator"]
