"""Members that do not play: their self-play is far below what was aimed at, or below the other members'.

Self-play of a member that was trained in a pair is its play with its mate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from popgen.evaluation.crossplay import CrossPlayResult, Estimate

NEVER_REACHED = 1000.0
"""A target of so much or more is none: recipes set it where the steps are what ends a training."""

OTHERS = 2
"""Other members that it takes to measure one by."""


@dataclass(frozen=True)
class WeakMember:
    """Self-play `sp` of a `member` is below `share` of `aim`, which is `what`: `target` or `other members`."""

    member: int
    sp: Estimate
    aim: float
    what: str
    share: float

    def describe(self, unit: str) -> str:
        """In a line."""
        of = "its target" if self.what == "target" else "the other members' median"
        return (
            f"member {self.member} does not play: self-play {self.sp.mean:.2f} {unit} is below {self.share:.0%} "
            f"of {of}, {self.aim:.2f}"
        )


def find_weak_members(result: CrossPlayResult, targets: Mapping[int, float], share: float) -> list[WeakMember]:
    """Members whose self-play is, by more than two standard errors, below `share` of their target or of the median of
    the others. Aims that are not positive, as returns that are penalties, tell nothing, nor do those that are
    `NEVER_REACHED`.

    Args:
        result: the evaluation.
        targets: by member, where its method has one.
        share: 0 finds nobody.
    """
    found = []
    for member in result.members:
        sp = result.own_play(member)
        others = [result.own_play(other).mean for other in result.members if other != member]
        target = targets.get(member, 0.0)
        aims = {"target": target if target < NEVER_REACHED else 0.0}
        aims["other members"] = float(np.median(others)) if len(others) >= OTHERS else 0.0
        what = max(aims, key=lambda name: aims[name])
        bound = share * aims[what]
        margin = 2.0 * sp.error if math.isfinite(sp.error) else 0.0
        if aims[what] > 0.0 and sp.mean + margin < bound:
            found.append(WeakMember(member, sp, aims[what], what, share))
    return found
