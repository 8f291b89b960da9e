"""Stepping batched environments: one slot per environment of every match, many members acting in one call each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import BatchedEnv
from popgen.envs.player_events import count_player_events, name_player_events
from popgen.envs.reward import covered_steps, training_reward
from popgen.nets.blocks import DrawnActions, draw_by_gumbel
from popgen.play.episodes import Episode
from popgen.play.rollout import Match, columns_of, match_of_columns
from popgen.types import Kind

Actor = Callable[[Tensor, Tensor], Tensor]
"""(R, *view.shape) observations and (R, P) one-hot seats -> (R, A) logits."""


@dataclass(frozen=True)
class Rollout:
    """T steps of N environments, in the columns of `matches` one after the other.

    Attributes:
        matches: who plays; `envs` columns each.
        obs: (T + 1, N, P, *view.shape); row T is what follows the last step, after any reset.
        cut_at: (K, 2) int, step and column of every truncation.
        cut_obs: (K, P, *view.shape), the observation that the truncated episode ended with, before the reset.
        actions: (T, N, P) uint8.
        log_prob: (T, N, P) float32, of the actions under the policies that took them.
        reward: (T, N) float32, the joint training reward (`popgen.envs.reward`).
        score: (T, N) float32, the environment's score of each step.
        covered: (T, N) float32, steps that each reward stands for (`popgen.envs.reward.covered_steps`).
        terminated, truncated: (T, N) bool.
        seats: (T, N, P) int32, the member who acted.
        episodes: those that ended, in order.
        events: (T, N, P, F) uint8, what each player did (`popgen.envs.player_events`); F = 0 where nobody asked.
    """

    matches: tuple[Match, ...]
    obs: np.ndarray
    cut_at: np.ndarray
    cut_obs: np.ndarray
    actions: np.ndarray
    log_prob: np.ndarray
    reward: np.ndarray
    score: np.ndarray
    covered: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    seats: np.ndarray
    episodes: tuple[Episode, ...]
    events: np.ndarray

    @property
    def steps(self) -> int:
        """Environment steps: T * N."""
        return int(self.reward.size)

    def columns(self, match: int) -> slice:
        """The columns of match number `match`."""
        return columns_of(self.matches)[match]


class SlotPool:
    """Running episodes of all matches; those of a match that is not played wait where they are.

    The fast path of training beside `popgen.play.rollout`: policies are plain networks without memory, all members act
    in one forward pass each, and log-probabilities are kept. Matches and episodes are the same records.

    Args:
        make: (number, seed) -> environments.
        matches: with the environments that this pool steps of each; may be 0.
        view: what the members look at.
        seed: of environments, actions and switch points.
        stagger: spread the first ends of episodes over the horizon.
        once: tell of the first episode of every environment alone. Of all that end within a given time, short ones are
            more than their share.
        events: count what each player does.
    """

    def __init__(
        self,
        make: Callable[[int, int], BatchedEnv],
        matches: Sequence[Match],
        view: str,
        *,
        seed: int,
        stagger: bool = True,
        once: bool = False,
        events: bool = False,
    ) -> None:
        self.make, self.matches, self.view, self.once, self.events = make, tuple(matches), view, once, events
        self._envs: dict[int, BatchedEnv] = {}
        self._rng = np.random.default_rng(seed)
        self._draws = torch.Generator().manual_seed(seed)
        count = sum(match.envs for match in matches)
        env = self.environments(max(1, count))
        env.reset(seed=seed)
        self.spec = env.spec
        self.age = np.zeros(count, np.int64)
        if stagger and count:
            spread = [np.arange(match.envs) * self.spec.horizon // max(1, match.envs) for match in matches]
            self.age[:] = np.concatenate(spread)
            env.set_time(self.age)
        self.states = env.get_state()[:count]
        self.generator = env.generator_state()
        self.whole = self.age == 0
        self.score, self.reward = np.zeros(count), np.zeros(count)
        self.switch = self._rng.integers(0, self.spec.horizon, count)

    def play(self, active: Sequence[int], steps: int, actors: Mapping[int, Actor]) -> Rollout:
        """`steps` steps in the environments of the matches `active`, acting with `actors` by member."""
        run = _SlotRun(self, [index for index in active if self.matches[index].envs], steps)
        with torch.inference_mode():
            for t in range(steps):
                run.step(t, actors)
        return run.finish()

    def rows(self, match: int) -> np.ndarray:
        """Slots of a match."""
        columns = columns_of(self.matches)[match]
        return np.arange(columns.start, columns.stop)

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here, but for matches and actors."""
        return {
            "states": self.states.copy(),
            "age": self.age.copy(),
            "whole": self.whole.copy(),
            "score": self.score.copy(),
            "reward": self.reward.copy(),
            "switch": self.switch.copy(),
            "generator": self.generator,
            "rng": self._rng.bit_generator.state,
            "draws": self._draws.get_state().numpy().copy(),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state()` of a pool of the same matches."""
        self.states[:], self.age[:] = state["states"], state["age"]
        self.whole[:], self.switch[:] = state["whole"], state["switch"]
        self.score[:], self.reward[:] = state["score"], state["reward"]
        self.generator = state["generator"]
        self._rng.bit_generator.state = state["rng"]
        self._draws.set_state(torch.from_numpy(np.array(state["draws"])))

    def environments(self, count: int) -> BatchedEnv:
        """`count` environments, made once; the caller sets their states."""
        if count not in self._envs:
            self._envs[count] = self.make(count, 0)
        return self._envs[count]

    def draw_actions(self, logits: Tensor) -> DrawnActions:
        """Actions (R,) of logits (R, A) and their log-probabilities (R,)."""
        return draw_by_gumbel(logits, self._draws)

    def draw_switches(self, count: int) -> np.ndarray:
        """Steps at which new episodes of mixed play go over to self-play, even over the horizon."""
        return self._rng.integers(0, self.spec.horizon, count)


class _SlotRun:
    """One call of `SlotPool.play`."""

    def __init__(self, pool: SlotPool, active: list[int], steps: int) -> None:
        self.pool, self.matches = pool, tuple(pool.matches[index] for index in active)
        self.rows = np.concatenate([pool.rows(index) for index in active])
        count, spec = len(self.rows), pool.spec
        self.env = pool.environments(count)
        self.env.set_state(pool.states[self.rows])
        self.env.load_generator_state(pool.generator)
        self.number = match_of_columns(self.matches)
        self.members = np.array([match.members for match in self.matches], np.int32)[self.number]
        self.owner = np.array([match.owner for match in self.matches], np.int32)[self.number]
        self.mixed = np.array([match.kind is Kind.MP for match in self.matches])[self.number]
        self.age, self.whole, self.switch = pool.age[self.rows], pool.whole[self.rows], pool.switch[self.rows]
        self.score, self.reward = pool.score[self.rows], pool.reward[self.rows]
        view = spec.views[pool.view]
        shape = (count, spec.num_players, *view.shape)
        self.obs = np.empty((steps + 1, *shape), view.dtype)
        self.obs[0] = self.env.observe(pool.view)
        self.actions = np.empty((steps, count, spec.num_players), np.uint8)
        self.log_prob = np.empty(self.actions.shape, np.float32)
        self.seats = np.empty(self.actions.shape, np.int32)
        self.rewards, self.scores, self.covered = (np.empty((steps, count), np.float32) for _ in range(3))
        self.terminated, self.truncated = np.empty((steps, count), bool), np.empty((steps, count), bool)
        kinds = len(name_player_events(self.env)) if pool.events else 0
        self.events = np.zeros((*self.actions.shape, kinds), np.uint8)
        self.cut_at: list[np.ndarray] = []
        self.cut_obs: list[np.ndarray] = []
        self.episodes: list[Episode] = []
        self.one_hot = torch.eye(spec.num_players).repeat(count, 1)
        self.now = np.zeros((0, 0), np.int32)
        self.acting: list[tuple[int, Tensor | None, Tensor]] = []

    def step(self, t: int, actors: Mapping[int, Actor]) -> None:
        """One step of all environments."""
        self._seat_members()
        flat = torch.from_numpy(self.obs[t]).flatten(0, 1)
        parts = [
            (index, actors[member](flat if index is None else flat[index], seats))
            for member, index, seats in self.acting
        ]
        logits = parts[0][1]
        if parts[0][0] is not None:
            logits = torch.empty(len(flat), logits.shape[-1])
            for index, part in parts:
                logits[index] = part
        actions, log_prob = self.pool.draw_actions(logits)
        self.seats[t] = self.now
        self.actions[t] = actions.view(self.now.shape).numpy()
        self.log_prob[t] = log_prob.view(self.now.shape).numpy()
        states = self.env.get_state() if self.pool.events else None
        result = self.env.step(self.actions[t])
        if states is not None:
            self.events[t] = count_player_events(self.env, states, self.actions[t], result)
        self.rewards[t] = training_reward(self.pool.spec, result)
        self.terminated[t], self.truncated[t] = result.terminated, result.truncated
        self.scores[t] = result.score
        self.score += result.score
        self.reward += self.rewards[t]
        self.age += 1
        self.covered[t] = covered_steps(result.terminated, self.age, self.pool.spec.horizon)
        self.obs[t + 1] = self.env.observe(self.pool.view)
        if result.done.any():
            self._end_episodes(t, np.flatnonzero(result.done))

    def _seat_members(self) -> None:
        """Who acts now; the members' rows are found again only where mixed play has changed them."""
        switched = self.mixed & (self.age >= self.switch)
        now = np.where(switched[:, None], self.owner[:, None], self.members)
        if now.shape == self.now.shape and (now == self.now).all():
            return
        self.now = now
        flat = now.reshape(-1)
        members = np.unique(flat)
        if len(members) == 1:
            self.acting = [(int(members[0]), None, self.one_hot)]
            return
        rows = [(int(member), torch.from_numpy(np.flatnonzero(flat == member))) for member in members]
        self.acting = [(member, index, self.one_hot[index]) for member, index in rows]

    def _end_episodes(self, t: int, columns: np.ndarray) -> None:
        cut = columns[self.truncated[t, columns]]
        self.cut_at.append(np.stack([np.full(len(cut), t), cut], -1))
        self.cut_obs.append(self.obs[t + 1, cut])
        for column in columns[self.whole[columns]]:
            match = self.matches[int(self.number[column])]
            score, reward = float(self.score[column]), float(self.reward[column])
            self.episodes.append(Episode(match.kind, match.members, score, reward, owner=match.owner))
        self.env.reset(indices=columns)
        self.obs[t + 1, columns] = self.env.encode(self.env.get_state(columns), self.pool.view)
        self.age[columns], self.score[columns], self.reward[columns] = 0, 0.0, 0.0
        self.whole[columns] = not self.pool.once
        self.switch[columns] = self.pool.draw_switches(len(columns))

    def finish(self) -> Rollout:
        """Put the running episodes back into the pool."""
        pool = self.pool
        pool.states[self.rows] = self.env.get_state()
        pool.generator = self.env.generator_state()
        pool.age[self.rows], pool.whole[self.rows], pool.switch[self.rows] = self.age, self.whole, self.switch
        pool.score[self.rows], pool.reward[self.rows] = self.score, self.reward
        none = np.zeros((0, *self.obs.shape[2:]), self.obs.dtype)
        return Rollout(
            matches=self.matches,
            obs=self.obs,
            cut_at=np.concatenate([np.zeros((0, 2), np.int64), *self.cut_at]),
            cut_obs=np.concatenate([none, *self.cut_obs]),
            actions=self.actions,
            log_prob=self.log_prob,
            reward=self.rewards,
            score=self.scores,
            covered=self.covered,
            terminated=self.terminated,
            truncated=self.truncated,
            seats=self.seats,
            episodes=tuple(self.episodes),
            events=self.events,
        )
