"""Trajectories of the exact dynamics F from given states: self-play, self-play from XP states, cross-play.

row t of a batch:  s_t --a_t--> s_{t+1},  reward[t] of that transition
a trajectory ends where the task terminates, where the environment's horizon cuts it, or after H' steps; the next
row of its column then starts anew. Ends that are not terminal carry the observation of s_{t+1}, to bootstrap from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from popgen.envs.reward import training_reward
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.simulation_starts import StartStates

Logits = Callable[[Tensor, Tensor], Tensor]
"""Observations (R, *view) and one-hot seats (R, P) -> action logits (R, A)."""


@dataclass(frozen=True)
class Layout:
    """Which columns of a batch are what: self-play, self-play restarted from B_XP, cross-play."""

    sp: int
    restart: int
    xp: int

    @property
    def total(self) -> int:
        return self.sp + self.restart + self.xp

    @property
    def both(self) -> slice:
        """All self-play columns."""
        return slice(0, self.sp + self.restart)

    @property
    def start(self) -> slice:
        """Self-play from start states and B_SP."""
        return slice(0, self.sp)

    @property
    def again(self) -> slice:
        """Self-play from B_XP."""
        return slice(self.sp, self.sp + self.restart)

    @property
    def cross(self) -> slice:
        return slice(self.sp + self.restart, self.total)

    @property
    def seats(self) -> np.ndarray:
        """(xp,) the learning member's seat in each cross-play column: half of them each."""
        return (np.arange(self.xp) >= (self.xp + 1) // 2).astype(np.int64)


@dataclass(frozen=True)
class Batch:
    """T steps of N simulated columns.

    Attributes:
        obs: (T, N, P, *view.shape) in the view's dtype, what each seat sees.
        actions: (T, N, P) int64; log_prob: (T, N, P) of the actions under the acting policies.
        reward, score: (T, N) float32.
        terminated: (T, N) bool. cut: (T, N) bool, ended otherwise.
        cut_obs: (K, P, *view.shape) where the K cut trajectories ended, in row-major order of `cut`.
        last_obs: (N, P, *view.shape) after the last row.
        valid: (T, N) bool, the step belongs to a trajectory; False while a column rests after its task terminated.
        trajectories: how many ended or were left at the end.
    """

    layout: Layout
    obs: Tensor
    actions: Tensor
    log_prob: Tensor
    reward: Tensor
    score: Tensor
    terminated: Tensor
    cut: Tensor
    cut_obs: Tensor
    last_obs: Tensor
    valid: Tensor
    trajectories: int

    @property
    def steps(self) -> int:
        """Simulated environment steps: T * N."""
        return self.reward.numel()


class Simulator:
    """Runs the columns of one member's batches; self-play trajectories go on from one batch to the next."""

    def __init__(self, config: XpmSimConfig, starts: StartStates, seed: int) -> None:
        self.config, self.starts, self.env = config, starts, starts.env
        self.seats = torch.eye(self.env.spec.num_players)
        self.generator = torch.Generator().manual_seed(seed)
        self.running: np.ndarray | None = None
        self.age = np.zeros(0, np.int64)

    @torch.no_grad()
    def run(self, layout: Layout, own: Logits, partner: tuple[int, Logits] | None) -> Batch:
        """`unroll` steps of all columns; `partner` is the other member of the cross-play ones and how it acts."""
        config, spec, rows = self.config, self.env.spec, layout.total
        states, age, limit = self._begin(layout, None if partner is None else partner[0])
        time, view = config.unroll, spec.views["features"]
        obs = np.empty((time, rows, spec.num_players, *view.shape), view.dtype)
        actions = np.empty((time, rows, spec.num_players), np.int64)
        log_prob = torch.empty(time, rows, spec.num_players)
        reward, score = np.empty((time, rows), np.float32), np.empty((time, rows), np.float32)
        terminated, cut = np.zeros((time, rows), bool), np.zeros((time, rows), bool)
        valid, resting = np.ones((time, rows), bool), np.zeros(rows, bool)
        ends: list[np.ndarray] = []
        for t in range(time):
            obs[t] = self.env.encode(states)
            actions[t], log_prob[t] = self._act(layout, torch.from_numpy(obs[t]), own, partner)
            states, result = self.env.simulate(states, actions[t])
            reward[t], score[t], terminated[t] = training_reward(spec, result), result.score, result.terminated
            age += 1
            valid[t], terminated[t] = ~resting, terminated[t] | resting
            cut[t] = (result.truncated | (age >= limit)) & ~terminated[t]
            ends.append(states[cut[t]])
            # A column whose task terminated rests for what its trajectory had left: each start weighs the same.
            resting[layout.sp :] = (terminated[t] & (age < limit))[layout.sp :]
            if t == time - 1:
                last = self.env.encode(states)
            if (over := np.flatnonzero((cut[t] | terminated[t]) & ~resting)).size:
                states[over], age[over] = self._anew(layout, over, partner), 0
        self.running, self.age = states[: layout.sp].copy(), age[: layout.sp].copy()
        return Batch(
            layout=layout,
            obs=torch.from_numpy(obs),
            actions=torch.from_numpy(actions),
            log_prob=log_prob,
            reward=torch.from_numpy(reward),
            score=torch.from_numpy(score),
            terminated=torch.from_numpy(terminated),
            cut=torch.from_numpy(cut),
            cut_obs=torch.from_numpy(self.env.encode(np.concatenate(ends))),
            last_obs=torch.from_numpy(last),
            valid=torch.from_numpy(valid),
            trajectories=int((terminated & valid).sum() + cut.sum() + ((age > 0) & ~resting).sum()),
        )

    def _begin(self, layout: Layout, partner: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States, ages and horizons of all columns; self-play goes on, the others start."""
        config = self.config
        if self.running is None or len(self.running) != layout.sp:
            self.running, self.age = self.starts.self_play(layout.sp), np.zeros(layout.sp, np.int64)
            self._stagger(layout.sp)
        parts = [self.running, self.starts.restart(layout.restart)]
        if partner is not None:
            parts.append(self.starts.cross_play(layout.xp, partner))
        age = np.concatenate([self.age, np.zeros(layout.total - layout.sp, np.int64)])
        horizons = (config.horizon, config.restart_horizon, config.xp_horizon)
        return np.concatenate(parts), age, np.repeat(horizons, (layout.sp, layout.restart, layout.xp))

    def _stagger(self, count: int) -> None:
        """Spread the ages, so that trajectories longer than a batch do not all end in the same one."""
        if self.config.horizon > self.config.unroll:
            self.age = np.arange(count, dtype=np.int64) * self.config.horizon // count

    def _anew(self, layout: Layout, over: np.ndarray, partner: tuple[int, Logits] | None) -> np.ndarray:
        """Start states for the columns `over` (ascending), each of its own kind."""
        counts = np.bincount(np.searchsorted([layout.sp, layout.sp + layout.restart], over, side="right"), minlength=3)
        parts = [self.starts.self_play(int(counts[0])), self.starts.restart(int(counts[1]))]
        if partner is not None:
            parts.append(self.starts.cross_play(int(counts[2]), partner[0]))
        return np.concatenate(parts)

    def _act(
        self, layout: Layout, obs: Tensor, own: Logits, partner: tuple[int, Logits] | None
    ) -> tuple[np.ndarray, Tensor]:
        """Actions (N, P) drawn from the own policy, in cross-play's other seats from the partner's; log pi (N, P)."""
        rows, players = obs.shape[:2]
        logits = own(obs.flatten(0, 1), self.seats.repeat(rows, 1)).unflatten(0, (rows, players))
        if partner is not None:
            columns, seats = torch.arange(layout.cross.start, rows), torch.from_numpy(1 - layout.seats)
            logits[columns, seats] = partner[1](obs[columns, seats], self.seats[seats])
        log_probs = torch.log_softmax(logits, -1)
        # The largest of log p + Gumbel noise is a draw from p.
        noise = torch.empty_like(log_probs).exponential_(generator=self.generator).log_()
        chosen = (log_probs - noise).argmax(-1, keepdim=True)
        return chosen.squeeze(-1).numpy(), log_probs.gather(-1, chosen).squeeze(-1)

    @torch.no_grad()
    def score(self, states: np.ndarray, steps: int, own: Logits) -> np.ndarray:
        """(N,) score of self-play from `states` (N, S) over at most `steps` steps, to the episode's end."""
        layout, total = Layout(len(states), 0, 0), np.zeros(len(states))
        going_on = np.ones(len(states), bool)
        for _ in range(steps):
            actions, _ = self._act(layout, torch.from_numpy(self.env.encode(states)), own, None)
            states, result = self.env.simulate(states, actions)
            total += np.where(going_on, result.score, 0.0)
            going_on &= ~result.done
        return total

    def state(self) -> dict[str, Any]:
        """Running self-play trajectories and the generator."""
        running = {} if self.running is None else {"states": self.running, "age": self.age}
        return {"running": running, "generator": self.generator.get_state().numpy()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()`."""
        running = state["running"]
        self.running = np.array(running["states"]) if running else None
        self.age = np.array(running["age"]) if running else np.zeros(0, np.int64)
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))
