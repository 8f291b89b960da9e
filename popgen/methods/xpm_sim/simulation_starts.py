"""B_SP and B_XP as sources of start states, and what their latest episodes say of each partner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_wm.replay import Query, Replay
from popgen.types import Kind, Segment


class StartStates:
    """One member's two buffers of real states, drawn from by their latest episodes.

    Args:
        env: of any number of environments; only its start state and encodings are used.
        member: whose training it is; cross-play rows are known by the other member in them.
        seed: of the draws.
    """

    def __init__(self, config: XpmSimConfig, env: BatchedEnv, member: int, seed: int) -> None:
        self.config, self.env, self.member = config, env, member
        self.rng = np.random.default_rng(seed)
        self.sp, self.xp = (Replay(env, config.capacity, seed + number) for number in (1, 2))

    def add(self, segments: Sequence[Segment]) -> None:
        """Real self-play into B_SP, cross-play into B_XP."""
        for segment in segments:
            if segment.kind is Kind.SP:
                self.sp.add(segment, self.member)
            elif segment.kind is Kind.XP:
                self.xp.add(segment, self.member)

    def initial(self, count: int) -> np.ndarray:
        """(count, S) states drawn from the environment's start distribution p(s_0)."""
        env = self.env
        rows = np.arange(count) % env.num_envs
        states = np.empty((count, env.spec.state_size), env.spec.state_dtype)
        for first in range(0, count, env.num_envs):
            part = slice(first, first + env.num_envs)
            env.reset()
            states[part] = env.get_state(rows[part])
        return states

    def self_play(self, count: int) -> np.ndarray:
        """(count, S): `starts_initial` of them start states, the others states of B_SP."""
        return self._draw_mixed(count, self.config.starts_initial, self.sp, None)

    def restart(self, count: int) -> np.ndarray:
        """(count, S) states of B_XP, with any partner (paper, eq. XPM-Sim)."""
        return self._draw_mixed(count, 0.0, self.xp, None)

    def cross_play(self, count: int, partner: int) -> np.ndarray:
        """(count, S): `xp_initial` of them start states, the others states of B_XP with that partner."""
        return self._draw_mixed(count, self.config.xp_initial, self.xp, partner)

    def buffered(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, S) states of both buffers, all their rows alike; start states where both are empty."""
        rows = [np.flatnonzero(replay.stream[: replay.size] >= 0) for replay in (self.sp, self.xp)]
        sizes = [len(part) for part in rows]
        if not sum(sizes):
            return self.initial(count)
        chosen = rng.integers(0, sum(sizes), count)
        parts = [self.sp.states[rows[0][chosen[chosen < sizes[0]]]]]
        parts.append(self.xp.states[rows[1][chosen[chosen >= sizes[0]] - sizes[0]]])
        return np.concatenate(parts)

    def _draw_mixed(self, count: int, initial: float, replay: Replay, partner: int | None) -> np.ndarray:
        """Where the buffer has nothing that fits, all are start states."""
        rows = self.recent(replay, partner)
        fresh = self.rng.random(count) < initial if len(rows) else np.ones(count, bool)
        states = np.empty((count, self.env.spec.state_size), self.env.spec.state_dtype)
        states[fresh] = self.initial(int(fresh.sum()))
        states[~fresh] = replay.states[self.rng.choice(rows, int((~fresh).sum()))] if len(rows) else 0
        return states

    def recent(self, replay: Replay, partner: int | None) -> np.ndarray:
        """Rows of the last `recent` episodes' worth of steps that match, terminal states left out."""
        last = self.config.recent * self.env.spec.horizon
        rows = replay.rows(Query(partner=partner, last=last))
        return rows[~replay.terminal[rows]]

    def state(self) -> dict[str, Any]:
        """Both buffers and the generators."""
        return {
            "sp": self.sp.state(),
            "xp": self.xp.state(),
            "rng": self.rng.bit_generator.state,
            "env": self.env.generator_state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        self.sp.load_state(state["sp"])
        self.xp.load_state(state["xp"])
        self.rng.bit_generator.state = state["rng"]
        self.env.load_generator_state(state["env"])
