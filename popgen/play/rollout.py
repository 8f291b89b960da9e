"""Matches in one batch of environments: who sits where, whole episodes, and samplers that hand on segments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.play.episodes import Episode, Episodes
from popgen.play.policy import Policy, Remembering
from popgen.types import RANDOM_MEMBER, Kind, Segment, StepBatch, check


@dataclass(frozen=True)
class Match:
    """`envs` environments in which `members` (seat 0, seat 1) play; the steps count as `kind`.

    In mixed play `members` begin, and `owner` takes both seats from a random step on.

    Attributes:
        owner: member for whose training the steps are taken; 0 where the caller keeps account of that.
    """

    kind: Kind
    members: tuple[int, int]
    envs: int
    owner: int = RANDOM_MEMBER

    def partner_of(self, member: int) -> int:
        """Who plays with `member` (itself in self-play)."""
        first, second = self.members
        return second if first == member else first


def columns_of(matches: Sequence[Match]) -> list[slice]:
    """The columns of each match in a batch that the matches fill in order."""
    ends = np.cumsum([match.envs for match in matches])
    return [slice(int(end) - match.envs, int(end)) for match, end in zip(matches, ends, strict=True)]


def match_of_columns(matches: Sequence[Match]) -> np.ndarray:
    """(B,) int: the number of the match that each column of the batch belongs to."""
    return np.repeat(np.arange(len(matches)), [match.envs for match in matches])


def split_matches(matches: Sequence[Match], parts: int) -> list[list[Match]]:
    """Cut the batch of environments that the matches fill into `parts`, as even as possible and in order.

    Sizes differ by one at most, the larger ones first; with fewer environments than parts the last ones are empty.
    """
    total = sum(match.envs for match in matches)
    bounds = np.cumsum([0] + [total // parts + (part < total % parts) for part in range(parts)])
    shares: list[list[Match]] = [[] for _ in range(parts)]
    for match, columns in zip(matches, columns_of(matches), strict=True):
        for share, low, high in zip(shares, bounds[:-1], bounds[1:], strict=True):
            if (envs := int(min(columns.stop, high) - max(columns.start, low))) > 0:
                share.append(replace(match, envs=envs))
    return shares


def share_of_each(matches: Sequence[Match], parts: int, part: int) -> list[Match]:
    """All matches with the environments that part number `part` of `parts` has of each; all parts together have all.

    What does not divide goes to other parts from match to match.
    """
    return [
        replace(match, envs=match.envs // parts + ((part + index) % parts < match.envs % parts))
        for index, match in enumerate(matches)
    ]


class Seating:
    """B matches drawn from K policies, and the memory that acting needs (previous actions, first steps).

    A policy in both seats of a row is called once for that row. The caller steps the environment, resets the
    rows that are done and says so through `ended`.

    Args:
        policies: K distinct policy objects.
        seats: (B, P) int, the policy's index for each row and seat.

    Raises:
        ValueError: `seats` of a wrong shape or range, or one policy object listed twice.
    """

    def __init__(self, policies: Sequence[Policy], seats: np.ndarray) -> None:
        self.seats = np.asarray(seats)
        check(self.seats, (None, None), "seats")
        if len({id(policy) for policy in policies}) != len(policies):
            raise ValueError("policies: one object is listed twice; its memory can serve one set of rows only")
        if self.seats.size == 0 or self.seats.min() < 0 or self.seats.max() >= len(policies):
            raise ValueError(f"seats: need at least one row and indices in [0, {len(policies)})")
        self.policies = list(policies)
        # A policy that sits in no row is left alone.
        rows = ((k, np.flatnonzero((self.seats == k).any(1))) for k in range(len(policies)))
        self._rows = [(k, members) for k, members in rows if len(members)]
        self._actions = np.zeros(self.seats.shape, np.uint8)
        self._first = np.ones(len(self.seats), bool)

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views that `act` needs."""
        return tuple(sorted({self.policies[k].view for k, _ in self._rows}))

    @property
    def is_first(self) -> np.ndarray:
        """(B,) bool: the row's next action is the first of an episode."""
        return self._first.copy()

    def reset(self, seed: int) -> None:
        """Fresh episodes in all rows; every policy's generator is derived from `seed`."""
        seeds = np.random.SeedSequence(seed).generate_state(len(self.policies))
        for k, rows in self._rows:
            self.policies[k].reset(len(rows), int(seeds[k] >> 1))
        self._actions[:], self._first[:] = 0, True

    def act(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """Joint actions (B, P) uint8 on the current observations, view name -> (B, P, *view.shape)."""
        actions = np.empty_like(self._actions)
        for k, rows in self._rows:
            policy, obs = self.policies[k], observations[self.policies[k].view]
            check(obs, (len(self.seats), self.seats.shape[1], *obs.shape[2:]), f"observations[{policy.view!r}]")
            chosen = np.asarray(policy.act(obs[rows], self._actions[rows], self._first[rows]))
            check(chosen, (len(rows), self.seats.shape[1]), f"actions of policy {k}")
            _check_narrow(chosen, f"actions of policy {k}")
            own = self.seats[rows] == k
            part = actions[rows]
            part[own] = chosen[own]
            actions[rows] = part
        self._actions, self._first = actions, np.zeros(len(actions), bool)
        return actions.copy()

    def ended(self, done: np.ndarray) -> None:
        """Mark the rows (B,) bool that were reset: their next step is the first of an episode."""
        self._first = np.asarray(done, bool).copy()

    def change_seats(self, rows: np.ndarray, seats: np.ndarray, forget: np.ndarray) -> None:
        """From the next step on other players sit in some rows, of those that sit there already.

        Whoever sat in a row has followed it with its memory, and goes on with that.

        Args:
            rows: (R,) int.
            seats: (R, P) int, the policy's index for each seat.
            forget: (R,) bool, the row's memories are to be forgotten, as if its episode began.
        """
        assert all(np.isin(new, old).all() for new, old in zip(seats, self.seats[rows], strict=True))
        self.seats = self.seats.copy()
        self.seats[rows] = seats
        self._first[rows] |= forget

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here: last actions, first steps and the policies' memories."""
        memories = {str(k): policy.memory() for k, policy in self._remembering_policies().items()}
        return {"actions": self._actions.copy(), "first": self._first.copy(), "memories": memories}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `state()` of the same seats and policies."""
        self._actions, self._first = np.array(state["actions"]), np.array(state["first"])
        remembering = self._remembering_policies()
        for k, rows in self._rows:
            if k in remembering:
                remembering[k].load_memory(state["memories"][str(k)])
            else:  # nothing of it is in the state
                self.policies[k].reset(len(rows), 0)

    def _remembering_policies(self) -> dict[int, Remembering]:
        seated = ((k, self.policies[k]) for k, _ in self._rows)
        return {k: policy for k, policy in seated if isinstance(policy, Remembering)}


def _check_narrow(actions: np.ndarray, name: str) -> None:
    """Raise ValueError unless bytes hold the actions as they are: a cast would make others of 1.7 or 260."""
    if actions.dtype == np.uint8:
        return
    if actions.dtype.kind not in "iu":
        raise ValueError(f"{name}: need whole numbers, got {actions.dtype}")
    if actions.min() < 0 or actions.max() > 255:
        raise ValueError(f"{name}: need numbers from 0 to 255, got {actions.min()} to {actions.max()}")


# ---- steps -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Transition:
    """One joint step of B environments, handed to a recorder.

    Attributes:
        states, next_states: (B, S) before and after the step; next_states come from before any reset.
        actions: (B, P) uint8.
        result: what the environment gave.
        is_first: (B,) bool, the step is the first of its episode.
        counted: (B,) bool, the step belongs to the row's episode; False once the episode is over and the row
            only waits for the longer ones.
    """

    states: np.ndarray
    next_states: np.ndarray
    actions: np.ndarray
    result: StepBatch
    is_first: np.ndarray
    counted: np.ndarray


def take_step(env: BatchedEnv, seating: Seating) -> Transition:
    """All players act and the environment answers; the caller resets finished rows and tells `seating.ended`."""
    states, is_first = env.get_state(), seating.is_first
    actions = seating.act({view: env.encode(states, view) for view in seating.views})
    result = env.step(actions)
    return Transition(states, env.get_state(), actions, result, is_first, np.ones(len(states), bool))


def advance(env: BatchedEnv, seating: Seating, seen: dict[str, np.ndarray]) -> StepBatch:
    """One step that nobody records: no states are copied.

    Args:
        env: steps; the caller resets finished rows and tells `seating.ended`.
        seating: of all players.
        seen: view -> array that observations are written to; filled by the first call, to be passed to the next ones.
    """
    for view in seating.views:
        seen[view] = env.observe(view, seen.get(view))
    return env.step(seating.act(seen))


def _take_counted_step(
    env: BatchedEnv,
    seating: Seating,
    seen: dict[str, np.ndarray],
    record: Callable[[Transition], None] | None,
    counted: np.ndarray,
) -> StepBatch:
    if record is None:
        return advance(env, seating, seen)
    step = take_step(env, seating)
    record(replace(step, counted=counted.copy()))
    return step.result


def play(
    env: BatchedEnv,
    policies: Sequence[Policy],
    seats: np.ndarray,
    *,
    seed: int,
    record: Callable[[Transition], None] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Episodes:
    """Play one full episode in each of the environment's B rows.

    Args:
        env: is reset first; B = `env.num_envs`.
        policies: K distinct policies; each is called once a step, on all rows in which it sits.
        seats: (B, P) int, index of the policy for each row and seat.
        seed: decides the environment's and every policy's draws: same arguments, same episodes.
        record: called after each step, before finished rows are reset.
        progress: called after each step with the episodes that as many steps would fill.

    Raises:
        ValueError: `seats` of a wrong shape or range.
    """
    spec, batch = env.spec, env.num_envs
    check(np.asarray(seats), (batch, spec.num_players), "seats")
    seating = Seating(policies, seats)
    env_seed, seat_seed = (int(s >> 1) for s in np.random.SeedSequence(seed).generate_state(2))
    env.reset(seed=env_seed)
    seating.reset(seat_seed)
    score, reward, length = np.zeros(batch), np.zeros(batch), np.zeros(batch, np.int64)
    events = np.zeros((batch, spec.num_players, spec.num_events), np.int64)
    open_, terminated, steps = np.ones(batch, bool), np.zeros(batch, bool), 0
    seen: dict[str, np.ndarray] = {}
    while open_.any():
        result = _take_counted_step(env, seating, seen, record, open_)
        score += np.where(open_, result.score, 0.0)
        reward += np.where(open_, result.reward, 0.0)
        events += result.events * open_[:, None, None]
        length += open_
        steps += batch
        terminated |= open_ & result.terminated
        open_ &= ~result.done
        if result.done.any() and open_.any():
            env.reset(indices=np.flatnonzero(result.done))
        seating.ended(result.done)
        if progress:
            progress(steps // spec.horizon)
    shaped = events @ np.asarray(spec.event_weights, np.float64)
    return Episodes(seating.seats.copy(), score, reward, events, shaped, length, terminated, steps)


def play_teams(
    make: Callable[[int, int], BatchedEnv],
    policies: Sequence[Policy],
    matches: Sequence[tuple[int, ...]],
    episodes: int,
    *,
    seed: int,
    max_envs: int = 1024,
    progress: Callable[[int, int], None] | None = None,
) -> Episodes:
    """Play `episodes` full episodes of every match, in as few batches as `max_envs` allows.

    Args:
        make: (num_envs, seed) -> environment.
        policies: K distinct policies.
        matches: policy index per seat; row n of the result belongs to team n // episodes.
        progress: called with (episodes done, episodes in all), a batch that is played by what its steps would fill.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    rows = np.repeat(np.asarray(matches, np.int64), episodes, axis=0)
    starts = range(0, len(rows), max_envs)
    seeds = np.random.SeedSequence(seed).generate_state(len(starts))
    parts = []
    for start, part_seed in zip(starts, seeds, strict=True):
        seats = rows[start : start + max_envs]
        tell = None if progress is None else lambda done, first=start: progress(first + done, len(rows))
        parts.append(play(make(len(seats), 0), policies, seats, seed=int(part_seed >> 1), progress=tell))
        if progress:
            progress(start + len(seats), len(rows))
    return Episodes.concat(parts)


class Sampler:
    """Steps B environments with several matches at once; episodes continue from one `collect` to the next.

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
        """Everything to continue from exactly here, except matches and weights."""
        return {
            "env": self.env.get_state(),
            "generator": self.env.generator_state(),
            "seating": self.seating.state(),
            "whole": self._whole.copy(),
            "score": self._score.copy(),
            "counts": self._counts.copy(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()` of a sampler of the same matches."""
        self.env.set_state(state["env"])
        self.env.load_generator_state(state["generator"])
        self.seating.load_state(state["seating"])
        self._whole = np.array(state["whole"], bool).reshape(self._whole.shape)
        self._score = np.array(state["score"], np.float64).reshape(self._score.shape)
        self._counts = np.array(state["counts"], np.int64).reshape(self._counts.shape)

    def collect(self, steps: int) -> tuple[list[Segment], list[Episode]]:
        """Play `steps` joint steps: one segment per match, and the episodes that ended."""
        columns, episodes = self._empty_columns(steps), []
        for t in range(steps):
            step = take_step(self.env, self.seating)
            result = step.result
            columns["states"][t], columns["next_states"][t] = step.states, step.next_states
            columns["actions"][t], columns["events"][t] = step.actions, result.events
            columns["reward"][t], columns["score"][t] = result.reward, result.score
            columns["terminated"][t], columns["truncated"][t] = result.terminated, result.truncated
            self._score += result.score
            self._counts += result.events
            if result.done.any():
                episodes += self._finish_episodes(np.flatnonzero(result.done))
            self.seating.ended(result.done)
        return self._cut_segments(columns), episodes

    def _empty_columns(self, steps: int) -> dict[str, np.ndarray]:
        """Arrays (T, B, ...) of a segment of all matches."""
        count, spec = self.env.num_envs, self.env.spec
        shape = (steps, count)
        return {
            "states": np.empty((*shape, spec.state_size), np.dtype(spec.state_dtype)),
            "next_states": np.empty((*shape, spec.state_size), np.dtype(spec.state_dtype)),
            "actions": np.empty((*shape, 2), np.uint8),
            "reward": np.empty(shape, np.float32),
            "score": np.empty(shape, np.float32),
            "events": np.empty((*shape, 2, spec.num_events), np.uint8),
            "terminated": np.empty(shape, bool),
            "truncated": np.empty(shape, bool),
        }

    def _finish_episodes(self, rows: np.ndarray) -> list[Episode]:
        """The episodes of `rows` that began at their beginning; all of the rows are reset."""
        numbers, episodes = match_of_columns(self.matches), []
        for row in rows:
            match = self.matches[numbers[row]]
            if self._whole[row]:
                shaped = float((self._counts[row] * self._weights).sum())
                counts, score = self._counts[row].copy(), float(self._score[row])
                episodes.append(Episode(match.kind, match.members, score, shaped, counts, match.owner))
        self.env.reset(indices=rows)
        self._whole[rows], self._score[rows], self._counts[rows] = True, 0.0, 0
        return episodes

    def _cut_segments(self, columns: dict[str, np.ndarray]) -> list[Segment]:
        """One segment per match, numbered on."""
        segments = []
        for match, rows in zip(self.matches, columns_of(self.matches), strict=True):
            part = {name: np.ascontiguousarray(column[:, rows]) for name, column in columns.items()}
            segments.append(Segment(match.kind, match.members, **part, sampler=self.name, sequence=self.sequence))
            self.sequence += 1
        return segments
