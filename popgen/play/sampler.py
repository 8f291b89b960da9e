"""Sampling real environments: a batch of matches stepped together, handed on as segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.play.policy import Policy
from popgen.play.seating import Seating
from popgen.types import Kind, Segment


@dataclass(frozen=True)
class Match:
    """`envs` environments in which `members` (seat 0, seat 1) play; the steps count as `kind`."""

    kind: Kind
    members: tuple[int, int]
    envs: int


def split_matches(matches: list[Match], parts: int) -> list[list[Match]]:
    """Cut the batch of environments that the matches fill into `parts`, as even as possible and in order.

    Sizes differ by one at most, the larger ones first; with fewer environments than parts the last ones are empty.
    """
    total = sum(match.envs for match in matches)
    bounds = np.cumsum([0] + [total // parts + (part < total % parts) for part in range(parts)])
    shares: list[list[Match]] = [[] for _ in range(parts)]
    begin = 0
    for match in matches:
        end = begin + match.envs
        for share, low, high in zip(shares, bounds[:-1], bounds[1:], strict=True):
            if (envs := int(min(end, high) - max(begin, low))) > 0:
                share.append(replace(match, envs=envs))
        begin = end
    return shares


@dataclass(frozen=True)
class Episode:
    """One whole finished episode: its match, score (dishes), shaped event return and event counts (P, E)."""

    kind: Kind
    members: tuple[int, int]
    score: float
    shaped: float
    events: np.ndarray


class Sampler:
    """Steps B environments with several matches at once; episodes go on from one `collect` to the next.

    Args:
        env: a batch of exactly as many environments as the matches ask for.
        matches: who plays where, in order of the batch.
        policies: member id -> policy; the random player is RANDOM_MEMBER.
        name: of the sampler, for the ledger's key.
        seed: of environments and policies.
        stagger: spread the first ends of episodes over the horizon, so that data of all ages arrive together.
        sequence: number of the first segment.
    """

    def __init__(
        self,
        env: BatchedEnv,
        matches: list[Match],
        policies: dict[int, Policy],
        *,
        name: str,
        seed: int,
        stagger: bool = False,
        sequence: int = 0,
    ) -> None:
        if sum(match.envs for match in matches) != env.num_envs:
            asked = sum(match.envs for match in matches)
            raise ValueError(f"matches ask for {asked} environments, the batch has {env.num_envs}")
        self.env, self.matches, self.name, self.sequence = env, matches, name, sequence
        members = sorted({member for match in matches for member in match.members})
        index = {member: position for position, member in enumerate(members)}
        seats = np.concatenate([np.tile([[index[m] for m in match.members]], (match.envs, 1)) for match in matches])
        self.policies = policies
        self.seating = Seating([policies[member] for member in members], seats)
        self.env.reset(seed=seed)
        self.seating.reset(seed)
        count = env.num_envs
        self._whole = np.ones(count, bool)
        if stagger:
            self.env.set_time(np.arange(count) * env.spec.horizon // count)
            self._whole[1:] = False
        self._score = np.zeros(count)
        self._counts = np.zeros((count, 2, env.spec.num_events), np.int64)
        self._weights = np.asarray(env.spec.event_weights)

    def state(self) -> dict[str, Any]:
        """Everything to go on from exactly here, except matches and weights."""
        return {
            "env": self.env.get_state(),
            "generator": self.env.generator_state(),
            "seating": self.seating.state(),
            "whole": self._whole.copy(),
            "score": self._score.copy(),
            "counts": self._counts.copy(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from `state()` of a sampler of the same matches."""
        self.env.set_state(state["env"])
        self.env.load_generator_state(state["generator"])
        self.seating.load_state(state["seating"])
        for name in ("whole", "score", "counts"):
            own = getattr(self, f"_{name}")
            setattr(self, f"_{name}", np.array(state[name], own.dtype).reshape(own.shape))

    def collect(self, steps: int) -> tuple[list[Segment], list[Episode]]:
        """Play `steps` joint steps: one segment per match, and the episodes that ended."""
        env, count, spec = self.env, self.env.num_envs, self.env.spec
        dtype = np.dtype(spec.state_dtype)
        states = np.empty((steps, count, spec.state_size), dtype)
        following = np.empty_like(states)
        actions = np.empty((steps, count, 2), np.uint8)
        events = np.empty((steps, count, 2, spec.num_events), np.uint8)
        reward, score = np.empty((steps, count), np.float32), np.empty((steps, count), np.float32)
        terminated, truncated = np.empty((steps, count), bool), np.empty((steps, count), bool)
        episodes: list[Episode] = []
        for t in range(steps):
            states[t] = env.get_state()
            actions[t] = self.seating.act({view: env.encode(states[t], view) for view in self.seating.views})
            result = env.step(actions[t])
            following[t] = env.get_state()
            reward[t], score[t], events[t] = result.reward, result.score, result.events
            terminated[t], truncated[t] = result.terminated, result.truncated
            self._score += result.score
            self._counts += result.events
            if result.done.any():
                episodes += self._finish(np.flatnonzero(result.done))
            self.seating.ended(result.done)
        return self._segments(states, following, actions, reward, score, events, terminated, truncated), episodes

    def _finish(self, rows: np.ndarray) -> list[Episode]:
        owners = np.repeat(np.arange(len(self.matches)), [match.envs for match in self.matches])
        found = []
        for row in rows:
            match = self.matches[owners[row]]
            if self._whole[row]:
                shaped = float((self._counts[row] * self._weights).sum())
                counts = self._counts[row].copy()
                found.append(Episode(match.kind, match.members, float(self._score[row]), shaped, counts))
        self.env.reset(indices=rows)
        self._whole[rows], self._score[rows], self._counts[rows] = True, 0.0, 0
        return found

    def _segments(self, *columns: np.ndarray) -> list[Segment]:
        names = ("states", "next_states", "actions", "reward", "score", "events", "terminated", "truncated")
        segments, start = [], 0
        for match in self.matches:
            rows = slice(start, start + match.envs)
            part = {name: np.ascontiguousarray(column[:, rows]) for name, column in zip(names, columns, strict=True)}
            segments.append(Segment(match.kind, match.members, **part, sampler=self.name, sequence=self.sequence))
            self.sequence += 1
            start += match.envs
        return segments
