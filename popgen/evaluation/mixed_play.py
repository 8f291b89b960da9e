"""Mixed play: cross-play until a random step, and from there self-play of one of the two.

A member that holds to another convention brings cross-play no further, but goes on as usual once it plays with itself.
One that sabotages, or that only plays on after a handshake of its own, does not. So for each member m, partner k and
seat of m: m plays with k until step t, then m takes both seats, and its score from there on stands beside that of
ordinary self-play after the same step. A member with memory goes on with it, or forgets it at the switch: a difference
between the two shows a handshake that its memory keeps.

Self-play goes on with the soups that it has begun, and cross-play leaves few. How much that is worth, a new game of as
many steps as were left after the switch tells: what is less than its share is lost to the partner.

CoMeDi (Sarkar et al. 2023) trains with such episodes; here they judge every method.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.evaluation.estimates import Estimate
from popgen.play.policy import Policy, Remembering
from popgen.play.rollout import Seating, advance

MAX_ENVS = 4096
"""Episodes that are played side by side."""


@dataclass(frozen=True)
class MixedPlay:
    """Scores after the switch, per episode.

    Attributes:
        member: who plays with itself after the switch.
        partner: whom it played with before.
        seat: that it had before.
        kept, reset: after cross-play, with its memory kept and forgotten; the same where it has none.
        ordinary: in its self-play after the same steps.
        fresh: in the first steps of that self-play, as many as were left after the switch.
    """

    member: int
    partner: int
    seat: int
    kept: Estimate
    reset: Estimate
    ordinary: Estimate
    fresh: Estimate

    def share(self, *, reset: bool = False) -> Estimate:
        """Part of ordinary self-play that remains; NaN where that scores nothing."""
        return (self.reset if reset else self.kept).divide(self.ordinary)


@dataclass(frozen=True)
class MixedPlays:
    """All of a population, and the environment steps and episodes that they took."""

    plays: tuple[MixedPlay, ...]
    steps: int
    episodes: int


@dataclass(frozen=True)
class Switch:
    """One episode that changes hands.

    Attributes:
        before, after: policies in the seats until the switch and from there on.
        step: the first of the others.
        forget: whether memories are forgotten at the switch.
    """

    before: tuple[int, int]
    after: tuple[int, int]
    step: int
    forget: bool


@dataclass(frozen=True)
class SwitchedScores:
    """Of each episode (B,), and the steps of all.

    Attributes:
        scores: from its switch on, 0 for one that ended before.
        openings: in its first steps, as many as the switch leaves.
    """

    scores: np.ndarray
    openings: np.ndarray
    steps: int


def play_switches(env: BatchedEnv, policies: list[Policy], switches: list[Switch], seed: int) -> SwitchedScores:
    """Play one episode for each switch.

    Args:
        env: with as many rows as there are switches.
        policies: distinct.
        switches: one for each row.
        seed: same arguments, same result.
    """
    steps = np.array([one.step for one in switches])
    after, forget = np.array([one.after for one in switches]), np.array([one.forget for one in switches])
    seating = Seating(policies, np.array([one.before for one in switches]))
    env_seed, seat_seed = (int(part >> 1) for part in np.random.SeedSequence(seed).generate_state(2))
    env.reset(seed=env_seed)
    seating.reset(seat_seed)
    gained, opening, open_ = np.zeros(len(switches)), np.zeros(len(switches)), np.ones(len(switches), bool)
    seen: dict[str, np.ndarray] = {}
    for time in itertools.count():
        if len(now := np.flatnonzero(steps == time)):
            seating.change_seats(now, after[now], forget[now])
        result = advance(env, seating, seen)
        gained += np.where(open_ & (steps <= time), result.score, 0.0)
        opening += np.where(open_ & (time < env.spec.horizon - steps), result.score, 0.0)
        open_ &= ~result.done
        if not open_.any():
            return SwitchedScores(gained, opening, (time + 1) * len(switches))
        if result.done.any():
            env.reset(indices=np.flatnonzero(result.done))
        seating.ended(result.done)
    raise AssertionError("an episode has no end")


def play_mixed(
    make: Callable[[int, int], BatchedEnv],
    members: Mapping[int, Policy],
    episodes: int,
    seed: int,
    *,
    progress: Callable[[int], None] | None = None,
) -> MixedPlays:
    """Mixed play of every member after cross-play with every other one, in both seats.

    The switch comes at a step between the first and the middle of the episode; all pairs have the same ones.

    Args:
        make: (num_envs, seed) -> environment.
        members: number -> policy.
        episodes: N, of each member, partner, seat and way of going on, and of ordinary self-play.
        seed: same arguments, same result.
        progress: called with the episodes done, of `count_mixed_episodes`, after each batch.
    """
    numbers, policies = list(members), list(members.values())
    if len(numbers) < 2:
        return MixedPlays((), 0, 0)
    horizon = make(1, 0).spec.horizon
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
    steps = rng.integers(1, max(1, horizon // 2) + 1, episodes)
    programme = _list_cases(policies)
    rows = [Switch(*case, int(step), forget) for case, forget in programme for step in steps]
    parts = [rows[start : start + MAX_ENVS] for start in range(0, len(rows), MAX_ENVS)]
    seeds = np.random.SeedSequence([seed, 1]).generate_state(len(parts))
    scores: list[SwitchedScores] = []
    for part, own in zip(parts, seeds, strict=True):
        scores.append(play_switches(make(len(part), 0), policies, part, int(own >> 1)))
        if progress is not None:
            progress(sum(len(done.scores) for done in scores))
    table = np.concatenate([part.scores for part in scores]).reshape(len(programme), episodes)
    openings = np.concatenate([part.openings for part in scores])[: len(policies) * episodes].reshape(-1, episodes)
    found = {key: Estimate.of(row) for key, row in zip(programme, table, strict=True)}
    fresh = [Estimate.of(row) for row in openings]  # self-play of all comes first
    plays = [
        _describe_case(numbers, found, fresh, before, after)
        for (before, after), forget in programme
        if not forget and before != after
    ]
    return MixedPlays(tuple(plays), sum(part.steps for part in scores), len(rows))


def count_mixed_episodes(policies: Sequence[Policy], episodes: int) -> int:
    """Episodes that `play_mixed` takes."""
    return len(_list_cases(policies)) * episodes if len(policies) > 1 else 0


_Case = tuple[tuple[tuple[int, int], tuple[int, int]], bool]


def _list_cases(policies: Sequence[Policy]) -> list[_Case]:
    """((before, after), forget): self-play of each, then cross-play that each of the two takes over."""
    everybody = range(len(policies))
    cases: list[_Case] = [(((m, m), (m, m)), False) for m in everybody]
    for m in everybody:
        for k in everybody:
            for before in ((m, k), (k, m)) if m != k else ():
                cases.append(((before, (m, m)), False))
                if isinstance(policies[m], Remembering):
                    cases.append(((before, (m, m)), True))
    return cases


def _describe_case(
    numbers: list[int],
    found: Mapping[_Case, Estimate],
    fresh: Sequence[Estimate],
    before: tuple[int, int],
    after: tuple[int, int],
) -> MixedPlay:
    own = after[0]
    seat = before.index(own)
    kept = found[(before, after), False]
    reset = found.get(((before, after), True), kept)
    ordinary = found[(after, after), False]
    return MixedPlay(numbers[own], numbers[before[1 - seat]], seat, kept, reset, ordinary, fresh[own])
