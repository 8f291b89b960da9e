"""Who sits where: the matches that fill a batch of environments, and how they are shared out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from popgen.types import RANDOM_MEMBER, Kind


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
