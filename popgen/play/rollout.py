"""Full episodes of any matches in one batch of environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.play.episodes import Episodes
from popgen.play.policy import Policy
from popgen.play.seating import Seating
from popgen.shapes import check
from popgen.types import StepBatch


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


def play(
    env: BatchedEnv,
    policies: Sequence[Policy],
    seats: np.ndarray,
    *,
    seed: int,
    record: Callable[[Transition], None] | None = None,
) -> Episodes:
    """Play one full episode in each of the environment's B rows.

    Args:
        env: is reset first; B = `env.num_envs`.
        policies: K distinct policies; each is called once a step, on all rows in which it sits.
        seats: (B, P) int, index of the policy for each row and seat.
        seed: decides the environment's and every policy's draws: same arguments, same episodes.
        record: called after each step, before finished rows are reset.

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
        if record:
            step = take_step(env, seating)
            result = step.result
            record(replace(step, counted=open_.copy()))
        else:
            result = advance(env, seating, seen)
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
        progress: called with (episodes done, episodes in all) after each batch.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    rows = np.repeat(np.asarray(matches, np.int64), episodes, axis=0)
    starts = range(0, len(rows), max_envs)
    seeds = np.random.SeedSequence(seed).generate_state(len(starts))
    parts = []
    for start, part_seed in zip(starts, seeds, strict=True):
        seats = rows[start : start + max_envs]
        parts.append(play(make(len(seats), 0), policies, seats, seed=int(part_seed >> 1)))
        if progress:
            progress(start + len(seats), len(rows))
    return Episodes.concat(parts)
