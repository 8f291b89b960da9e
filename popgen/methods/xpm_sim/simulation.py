"""Trajectories of the exact dynamics F from given states: self-play, self-play from XP states, cross-play.

row t of a batch:  s_t --a_t--> s_{t+1},  reward[t] of that transition
a trajectory ends where the task terminates, where the environment's horizon cuts it, or after H' steps; the next
row of its column then starts anew. Ends that are not terminal carry the observation of s_{t+1}, to bootstrap from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from popgen.envs.reward import covered_steps, training_reward
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.simulation_starts import StartStates
from popgen.nets.blocks import DrawnActions, draw_by_gumbel
from popgen.play.trajectories import Trajectories

Logits = Callable[[Tensor, Tensor], Tensor]
"""Observations (R, *view) and one-hot seats (R, P) -> action logits (R, A)."""


class Partner(NamedTuple):
    """The other member of the cross-play columns, and how it acts."""

    member: int
    logits: Logits


@dataclass(frozen=True)
class BatchColumns:
    """Which columns of a batch are what: self-play, self-play restarted from B_XP, cross-play."""

    sp: int
    restart: int
    xp: int

    @property
    def total(self) -> int:
        """All columns."""
        return self.sp + self.restart + self.xp

    @property
    def self_play(self) -> slice:
        """All self-play columns."""
        return slice(0, self.sp + self.restart)

    @property
    def started(self) -> slice:
        """Self-play from start states and B_SP."""
        return slice(0, self.sp)

    @property
    def restarted(self) -> slice:
        """Self-play from B_XP."""
        return slice(self.sp, self.sp + self.restart)

    @property
    def cross_play(self) -> slice:
        """Cross-play, half of the columns with the member in each seat."""
        return slice(self.sp + self.restart, self.total)

    @property
    def seats(self) -> np.ndarray:
        """(xp,) the learning member's seat in each cross-play column: half of them each."""
        return (np.arange(self.xp) >= (self.xp + 1) // 2).astype(np.int64)


@dataclass(frozen=True)
class SimulatedBatch(Trajectories):
    """T steps of N simulated columns.

    Attributes:
        columns: which they are.
        score: (T, N) float32.
        covered: (T, N) float32, steps that each reward stands for (`popgen.envs.reward.covered_steps`).
        valid: (T, N) bool, the step belongs to a trajectory; False while a column rests after its task terminated.
        count: trajectories that ended or were left at the end.
    """

    columns: BatchColumns
    score: Tensor
    covered: Tensor
    valid: Tensor
    count: int


class Simulator:
    """Runs the columns of one member's batches; self-play trajectories continue from one batch to the next.

    The rollout of `popgen.play` with `env.simulate` as the dynamics: columns start in any state and end where their
    trajectory does, which a rollout of whole episodes cannot, and give the same record, `Trajectories`.
    """

    def __init__(self, config: XpmSimConfig, starts: StartStates, seed: int) -> None:
        self.config, self.starts, self.env = config, starts, starts.env
        self.seats = torch.eye(self.env.spec.num_players)
        self.generator = torch.Generator().manual_seed(seed)
        self.running: np.ndarray | None = None
        self.age = np.zeros(0, np.int64)

    @torch.no_grad()
    def run(self, columns: BatchColumns, own: Logits, partner: Partner | None) -> SimulatedBatch:
        """`unroll` steps of all columns; `partner` is the other member of the cross-play ones."""
        spec, rows, time = self.env.spec, columns.total, self.config.unroll
        states, age, limit = self._begin_columns(columns, partner)
        view = spec.views["features"]
        obs = np.empty((time + 1, rows, spec.num_players, *view.shape), view.dtype)
        actions = np.empty((time, rows, spec.num_players), np.int64)
        log_prob = torch.empty(time, rows, spec.num_players)
        reward, score = np.empty((time, rows), np.float32), np.empty((time, rows), np.float32)
        covered = np.ones((time, rows), np.float32)
        terminated, cut = np.zeros((time, rows), bool), np.zeros((time, rows), bool)
        valid, resting = np.ones((time, rows), bool), np.zeros(rows, bool)
        ends: list[np.ndarray] = []
        for t in range(time):
            obs[t] = self.env.encode(states)
            drawn = self._draw_actions(columns, torch.from_numpy(obs[t]), own, partner)
            actions[t], log_prob[t] = drawn.action.numpy(), drawn.log_prob
            states, result = self.env.simulate(states, actions[t])
            reward[t], score[t], terminated[t] = training_reward(spec, result), result.score, result.terminated
            covered[t] = covered_steps(result.terminated, self.env.time(states), spec.horizon)
            age += 1
            valid[t], terminated[t] = ~resting, terminated[t] | resting
            cut[t] = (result.truncated | (age >= limit)) & ~terminated[t]
            ends.append(states[cut[t]])
            # A column whose task ended early rests for what its trajectory had left: each start weighs the same.
            early = terminated[t] & (self.env.time(states) < spec.horizon) | resting
            resting[columns.sp :] = (early & (age < limit))[columns.sp :]
            if t == time - 1:
                obs[time] = self.env.encode(states)
            if (over := np.flatnonzero((cut[t] | terminated[t]) & ~resting)).size:
                states[over], age[over] = self._start_again(columns, over, partner), 0
        self.running, self.age = states[: columns.sp].copy(), age[: columns.sp].copy()
        return SimulatedBatch(
            obs=torch.from_numpy(obs),
            cut_at=torch.from_numpy(np.argwhere(cut)),
            cut_obs=torch.from_numpy(self.env.encode(np.concatenate(ends))),
            actions=torch.from_numpy(actions),
            log_prob=log_prob,
            reward=torch.from_numpy(reward),
            terminated=torch.from_numpy(terminated),
            cut=torch.from_numpy(cut),
            columns=columns,
            score=torch.from_numpy(score),
            covered=torch.from_numpy(covered),
            valid=torch.from_numpy(valid),
            count=int((terminated & valid).sum() + cut.sum() + ((age > 0) & ~resting).sum()),
        )

    def _begin_columns(self, columns: BatchColumns, partner: Partner | None) -> _Beginning:
        """States, ages and horizons of all columns; self-play continues, the others start."""
        config = self.config
        if self.running is None or len(self.running) != columns.sp:
            self.running, self.age = self.starts.self_play(columns.sp), np.zeros(columns.sp, np.int64)
            self._stagger_ages(columns.sp)
        parts = [self.running, self.starts.restart(columns.restart)]
        if partner is not None:
            parts.append(self.starts.cross_play(columns.xp, partner.member))
        age = np.concatenate([self.age, np.zeros(columns.total - columns.sp, np.int64)])
        horizons = (config.horizon, config.restart_horizon, config.xp_horizon)
        limit = np.repeat(horizons, (columns.sp, columns.restart, columns.xp))
        return _Beginning(np.concatenate(parts), age, limit)

    def _stagger_ages(self, count: int) -> None:
        """Spread the ages, so that trajectories longer than a batch do not all end in the same one."""
        if self.config.horizon > self.config.unroll:
            self.age = np.arange(count, dtype=np.int64) * self.config.horizon // count

    def _start_again(self, columns: BatchColumns, over: np.ndarray, partner: Partner | None) -> np.ndarray:
        """Start states for the columns `over` (ascending), each of its own kind."""
        kinds = np.searchsorted([columns.sp, columns.sp + columns.restart], over, side="right")
        counts = np.bincount(kinds, minlength=3)
        parts = [self.starts.self_play(int(counts[0])), self.starts.restart(int(counts[1]))]
        if partner is not None:
            parts.append(self.starts.cross_play(int(counts[2]), partner.member))
        return np.concatenate(parts)

    def _draw_actions(self, columns: BatchColumns, obs: Tensor, own: Logits, partner: Partner | None) -> DrawnActions:
        """Actions (N, P) drawn from the own policy, in cross-play's other seats from the partner's; log pi (N, P)."""
        rows, players = obs.shape[:2]
        logits = own(obs.flatten(0, 1), self.seats.repeat(rows, 1)).unflatten(0, (rows, players))
        if partner is not None:
            index, seats = torch.arange(columns.cross_play.start, rows), torch.from_numpy(1 - columns.seats)
            logits[index, seats] = partner.logits(obs[index, seats], self.seats[seats])
        return draw_by_gumbel(logits, self.generator)

    @torch.no_grad()
    def score(self, states: np.ndarray, steps: int, own: Logits) -> np.ndarray:
        """(N,) score of self-play from `states` (N, S) over at most `steps` steps, to the episode's end."""
        columns, total = BatchColumns(len(states), 0, 0), np.zeros(len(states))
        going_on = np.ones(len(states), bool)
        for _ in range(steps):
            drawn = self._draw_actions(columns, torch.from_numpy(self.env.encode(states)), own, None)
            states, result = self.env.simulate(states, drawn.action.numpy())
            total += np.where(going_on, result.score, 0.0)
            going_on &= ~result.done
        return total

    def state(self) -> dict[str, Any]:
        """Running self-play trajectories and the generator."""
        running = {} if self.running is None else {"states": self.running, "age": self.age}
        return {"running": running, "generator": self.generator.get_state().numpy()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        running = state["running"]
        self.running = np.array(running["states"]) if running else None
        self.age = np.array(running["age"]) if running else np.zeros(0, np.int64)
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))


class _Beginning(NamedTuple):
    """What columns begin with: states (N, S), steps taken (N,) and most steps of a trajectory (N,)."""

    states: np.ndarray
    age: np.ndarray
    limit: np.ndarray
