"""The SP/XP matrix: every member with every member, in both seatings, and beside a random and an idle partner.

Members that were trained in pairs never learned to play with themselves: a member's own play (SP) is that with its
mate, cross-play (XP) that across pairs, and their cells on the diagonal are neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import pandas as pd

from popgen.errors import UserError
from popgen.evaluation.estimates import Estimate, adjust_by_holm
from popgen.evaluation.mixed_play import MixedPlay, count_mixed_episodes, play_mixed
from popgen.play.episodes import Episodes
from popgen.play.policy import Policy
from popgen.play.rollout import play_teams
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy
from popgen.population.manifest import EnvironmentInfo
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population

RANDOM, IDLE = "random", "idle"
PARTNERS = (RANDOM, IDLE)

LEVEL = 0.05
"""Chance of any pair at all being called obstructive where none is."""


@dataclass(frozen=True)
class Pairing:
    """Figures per episode of one player in seat 0 and one in seat 1.

    Attributes:
        seats: label of the player in each seat: a member's number as text, `random` or `idle`.
        scores: (N,) the episodes' scores.
        score, reward, shaped: means over episodes; the shaped return is the sum over both seats.
        events: (P, E) mean count of each event, per seat.
    """

    seats: tuple[str, str]
    scores: np.ndarray
    score: Estimate
    reward: Estimate
    shaped: Estimate
    events: np.ndarray


@dataclass(frozen=True)
class Obstruction:
    """An ordered pair whose cross-play is worse than a member's play beside a random or idle partner.

    Attributes:
        pair: members in seat 0 and seat 1.
        partner: `random` or `idle`.
        member: who of the two would do better with that partner in the other seat.
        xp, beside: scores of the pair, and of `member` with the partner.
        p_value: that chance alone makes it as low, corrected for the number of comparisons (Holm).
    """

    pair: tuple[int, int]
    partner: str
    member: int
    xp: Estimate
    beside: Estimate
    p_value: float


@dataclass(frozen=True, repr=False)
class CrossPlayResult:
    """All pairings of M members and the figures drawn from them.

    Attributes:
        environment, method: as in the manifest.
        event_names, event_weights: of the E events.
        members: ids, in the order of rows and columns.
        episodes: per ordered pair.
        seed: of the evaluation.
        training_seed: of the population's run.
        steps: environment steps taken, kind `evaluation`.
        pairings: by label of seat 0 and seat 1.
        mixed: self-play after cross-play, for each member, partner and seat; none of members of pairs, which go on
            with nobody alone.
        mixed_episodes: that it took.
        mates: member that was trained in a pair -> the other of the pair; the others were trained with themselves.
    """

    environment: EnvironmentInfo
    method: str
    event_names: tuple[str, ...]
    event_weights: tuple[float, ...]
    members: tuple[int, ...]
    episodes: int
    seed: int
    training_seed: int
    steps: int
    pairings: dict[tuple[str, str], Pairing]
    mixed: tuple[MixedPlay, ...] = ()
    mixed_episodes: int = 0
    mates: Mapping[int, int] = field(default_factory=dict)

    def __repr__(self) -> str:
        members = f"{len(self.members)} members of {self.method} in {self.environment.name}"
        return f"<SP/XP of {members}: SP {self.sp}, XP {self.xp}, {self.episodes} episodes a pair>"

    @property
    def labels(self) -> tuple[str, ...]:
        """Members as text."""
        return tuple(str(member) for member in self.members)

    def score(self, seat_0: int | str, seat_1: int | str) -> Estimate:
        """Score of an ordered pair; NaN if it was not played."""
        pairing = self.pairings.get((str(seat_0), str(seat_1)))
        return pairing.score if pairing else Estimate(math.nan, math.nan)

    def to_frame(
        self, value: Literal["mean", "error"] = "mean", labels: Sequence[int | str] | None = None
    ) -> pd.DataFrame:
        """Scores of all pairs: rows are the player in seat 0, columns the player in seat 1; NaN where not played.

        Args:
            value: the mean, or its standard error.
            labels: whom to list; None for the members.
        """
        names = self.labels if labels is None else tuple(map(str, labels))
        cells = [[getattr(self.score(row, column), value) for column in names] for row in names]
        return pd.DataFrame(
            np.array(cells, dtype=float).reshape(len(names), len(names)),
            index=pd.Index(names, name="seat_0"),
            columns=pd.Index(names, name="seat_1"),
        )

    @property
    def is_paired(self) -> bool:
        """Some member was trained in a pair."""
        return bool(self.mates)

    def mate_of(self, member: int) -> int:
        """Number of whom a member plays its own play with: its mate, or itself."""
        return self.mates.get(member, member)

    def own_play(self, member: int) -> Estimate:
        """Score of a member with its mate, mean over both seatings, or with itself; NaN where its mate is left out."""
        mate = self.mate_of(member)
        if mate == member:
            return self.score(member, member)
        return Estimate.average([self.score(member, mate), self.score(mate, member)])

    @property
    def crossed(self) -> list[tuple[int, int]]:
        """Ordered pairs of members whose play is cross-play: different ones, no mates."""
        return [(i, j) for i in self.members for j in self.members if j not in (i, self.mate_of(i))]

    @property
    def sp(self) -> Estimate:
        """Mean score over members of play with the mate, each in seat 0, or with itself.

        Members whose mate is left out of the evaluation count nowhere; NaN where all are.
        """
        own = [(member, self.mate_of(member)) for member in self.members]
        return Estimate.average([self.score(*seats) for seats in own if seats[1] in self.members])

    @property
    def xp(self) -> Estimate:
        """Mean score over `crossed`; NaN where there is none, as for one member or one pair."""
        return Estimate.average([self.score(*seats) for seats in self.crossed])

    def beside(self, partner: str, seat: int | None = None) -> Estimate:
        """Mean score of the members beside a `random` or `idle` partner sitting in `seat`, None for both."""
        parts = [self.score(m, partner) for m in self.members] if seat in (1, None) else []
        parts += [self.score(partner, m) for m in self.members] if seat in (0, None) else []
        return Estimate.average(parts)

    @property
    def comparisons(self) -> tuple[Obstruction, ...]:
        """All that obstruction is judged by: members (i, j) in seats 0 and 1, no mates, against i beside the random or
        idle player in seat 1, and against j beside it in seat 0."""
        found = []
        for i, j in self.crossed:
            for partner in PARTNERS:
                for member, beside in ((i, self.score(i, partner)), (j, self.score(partner, j))):
                    xp = self.score(i, j)
                    chance = xp.chance_below(beside, self.episodes)
                    found.append(Obstruction((i, j), partner, member, xp, beside, chance))
        adjusted = adjust_by_holm([one.p_value for one in found])
        return tuple(replace(one, p_value=value) for one, value in zip(found, adjusted, strict=True))

    @property
    def obstructions(self) -> tuple[Obstruction, ...]:
        """Where cross-play is so low that a player must be in the other's way: sabotage, not another convention.

        The chance that any of these is there by chance alone is LEVEL; one episode a pair finds none.
        """
        return tuple(one for one in self.comparisons if one.p_value <= LEVEL)

    def count_episodes(self) -> int:
        """Episodes that were played in all, those of mixed play included."""
        return self.episodes * len(self.pairings) + self.mixed_episodes

    def share(self, member: int, seat: int, *, reset: bool = False) -> Estimate:
        """What remains of a member's self-play after cross-play in which it had `seat`: mean over its partners.

        NaN where it has none, or where its self-play scores nothing. `reset`: with its memory forgotten at the switch.
        The shares have one ordinary self-play in common, whose error no number of partners averages out.
        """
        plays = [one for one in self.mixed if (one.member, one.seat) == (member, seat)]
        if not plays:
            return Estimate(math.nan, math.nan)
        after = Estimate.average([one.reset if reset else one.kept for one in plays])
        return after.divide(plays[0].ordinary)

    def fresh_share(self, member: int) -> Estimate:
        """What a new game of as many steps as the switch leaves is of ordinary self-play: cross-play that leaves an
        empty kitchen costs that much. NaN as in `share`; the two parts come from the same episodes."""
        plays = [one for one in self.mixed if one.member == member]
        return plays[0].fresh.divide(plays[0].ordinary) if plays else Estimate(math.nan, math.nan)

    @property
    def obstruction(self) -> dict[str, bool]:
        """Partner -> mean XP is below the members' mean beside it, by more than two standard errors."""
        return {partner: self.xp.below(self.beside(partner)) for partner in PARTNERS}


def evaluate_population(
    population: Population,
    episodes: int = 20,
    seed: int = 0,
    members: Sequence[int] | None = None,
    *,
    max_envs: int = 1024,
    progress: Callable[[int, int], None] | None = None,
) -> CrossPlayResult:
    """Play all ordered pairs of members, each beside a random and an idle partner in both seats, and mixed play.

    Args:
        population: of at least one member; mixed play is left out where members were trained in pairs.
        episodes: per ordered pair.
        seed: same arguments, same result.
        members: ids to evaluate, None for all.
        max_envs: largest batch. progress: called with (episodes done, episodes in all).

    Raises:
        UserError: no members, an unknown or repeated one, or less than 1 episode.
    """
    chosen = _choose_members(population, members)
    if episodes < 1:
        raise UserError("evaluation.episodes", f"must be at least 1, got {episodes}")
    spec, labels, count = population.spec, [*map(str, chosen), *PARTNERS], len(chosen)
    policies: list[Policy] = [population[member] for member in chosen]
    policies += [RandomPolicy(spec.num_actions), IdlePolicy(spec.action_names)]
    # All pairs but those of the two partners among themselves.
    matches = [(i, j) for i in range(count + 2) for j in range(count + 2) if i < count or j < count]
    mates, halves, first = _choose_mates(population, chosen), -(-episodes // 2), len(matches) * episodes
    alone = {} if mates else dict(zip(chosen, policies, strict=False))
    tell = _tell_of_all(progress, first + count_mixed_episodes(list(alone.values()), halves))
    make = population.make_env
    played = play_teams(make, policies, matches, episodes, seed=seed, max_envs=max_envs, progress=tell)
    mixed = play_mixed(make, alone, halves, seed, progress=lambda done: tell(first + done))
    return CrossPlayResult(
        environment=population.env_info,
        method=population.manifest.method,
        event_names=tuple(spec.event_names),
        event_weights=tuple(map(float, spec.event_weights)),
        members=chosen,
        episodes=episodes,
        seed=seed,
        training_seed=population.manifest.seed,
        steps=played.steps + mixed.steps,
        pairings=_estimate_pairings([(labels[i], labels[j]) for i, j in matches], played, episodes),
        mixed=mixed.plays,
        mixed_episodes=mixed.episodes,
        mates=mates,
    )


def _tell_of_all(progress: Callable[[int, int], None] | None, total: int) -> Callable[..., None]:
    """What is told (episodes done, episodes of a part), as one of (episodes done, `total`)."""
    return lambda done, _=0: progress(done, total) if progress is not None else None


def _choose_members(population: Population, members: Sequence[int] | None) -> tuple[int, ...]:
    if not len(population):
        raise UserError(str(population.path), "has no members yet", "train at least one first")
    chosen = tuple(range(1, len(population) + 1)) if members is None else tuple(int(member) for member in members)
    for member in chosen:
        if not 1 <= member <= len(population):
            raise UserError("members", f"no member {member}", f"choose among 1 to {len(population)}")
    if not chosen or len(set(chosen)) != len(chosen):
        raise UserError("members", "must be one or more different numbers", f"choose among 1 to {len(population)}")
    return chosen


def _choose_mates(population: Population, chosen: Sequence[int]) -> dict[int, int]:
    mates = enumerate(find_mates(population.members), start=1)
    return {member: mate for member, mate in mates if member in chosen and mate != member}


def _estimate_pairings(
    seats: Sequence[tuple[str, str]], played: Episodes, episodes: int
) -> dict[tuple[str, str], Pairing]:
    rows = (slice(n * episodes, (n + 1) * episodes) for n in range(len(seats)))
    return {pair: _estimate_pairing(pair, played, own) for pair, own in zip(seats, rows, strict=True)}


def _estimate_pairing(seats: tuple[str, str], played: Episodes, rows: slice) -> Pairing:
    scores = played.score[rows]
    return Pairing(
        seats=seats,
        scores=scores,
        score=Estimate.of(scores),
        reward=Estimate.of(played.reward[rows]),
        shaped=Estimate.of(played.shaped[rows].sum(-1)),
        events=played.events[rows].mean(0),
    )
