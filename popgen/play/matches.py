"""Who sits where: the matches that fill a batch of environments, and the policies in their seats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from popgen.play.policy import Policy, Remembering
from popgen.types import RANDOM_MEMBER, Kind, check


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
