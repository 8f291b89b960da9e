"""Members that do not play: their self-play is far below what was aimed at or below the other members', or no better
than play beside a random partner.

Self-play of a member that was trained in a pair is its play with its mate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from popgen.evaluation.crossplay import RANDOM, CrossPlayResult, Estimate
from popgen.evaluation.holdout_lineages import TRAINED_WITH
from popgen.population.manifest import MemberInfo
from popgen.types import FINAL_SKILL

NEVER_REACHED = 1000.0
"""A target of so much or more is none: recipes set it where the steps are what ends a training."""

RANDOM_PARTNER = "random partner"

OTHERS = 2
"""Other members that it takes to measure one by."""


@dataclass(frozen=True)
class WeakMember:
    """Self-play `sp` of a `member` is below `share` of `aim`, which is `what`: `target` or `other members`; or it is no
    better than `aim`, which it has beside a `random partner`."""

    member: int
    sp: Estimate
    aim: float
    what: str
    share: float

    def describe(self, unit: str) -> str:
        """In a line."""
        if self.what == RANDOM_PARTNER:
            return (
                f"member {self.member} does not play: self-play {self.sp.mean:.2f} {unit} is no better than with a "
                f"random partner, {self.aim:.2f}"
            )
        of = "its target" if self.what == "target" else "the other members' median"
        return (
            f"member {self.member} does not play: self-play {self.sp.mean:.2f} {unit} is below {self.share:.0%} "
            f"of {of}, {self.aim:.2f}"
        )


def list_weak_members(infos: Sequence[MemberInfo], result: CrossPlayResult, share: float) -> list[WeakMember]:
    """Members that do not play, by their methods' targets where there are any, by each other and by a random partner.

    A member that is kept for its lower skill (`extra.skill`) is meant to be weak; not meant for itself is an ego that
    learned beside partners (`extra.trained_with`), or one of a pair (`extra.role`) that is kept without its mate.
    """
    targets = {info.id: float(info.extra["target"]) for info in infos if "target" in info.extra}
    unskilled = {info.id for info in infos if info.extra.get("skill", FINAL_SKILL) != FINAL_SKILL}
    single = {info.id for info in infos if "role" in info.extra and result.mate_of(info.id) == info.id}
    taught = {info.id for info in infos if info.extra.get(TRAINED_WITH)}
    found = find_weak_members(result, targets, share)
    return [one for one in found if one.member not in unskilled | single | taught]


def find_weak_members(result: CrossPlayResult, targets: Mapping[int, float], share: float) -> list[WeakMember]:
    """Members whose self-play is, by more than two standard errors, below `share` of their target or of the median of
    the others; and of the rest those whose self-play is no better than their own play beside a random partner.

    Aims that are not positive, as returns that are penalties, tell nothing, nor do those that are `NEVER_REACHED`;
    play beside a random partner does, whatever its sign.

    Args:
        result: the evaluation.
        targets: by member, where its method has one.
        share: 0 finds nobody.
    """
    found = []
    for member in result.members if share > 0.0 else ():
        sp = result.own_play(member)
        what, aim = _find_aim(result, member, targets.get(member, 0.0))
        beside = result.member_beside(RANDOM, member)
        if aim > 0.0 and sp.mean + _double_error(sp) < share * aim:
            found.append(WeakMember(member, sp, aim, what, share))
        elif sp.mean <= beside.mean:
            found.append(WeakMember(member, sp, beside.mean, RANDOM_PARTNER, share))
    return found


def _find_aim(result: CrossPlayResult, member: int, target: float) -> tuple[str, float]:
    """The higher of a member's target and the other members' median self-play, and which it is; 0 where neither is."""
    others = [result.own_play(other).mean for other in result.members if other != member]
    aims = {"target": target if target < NEVER_REACHED else 0.0}
    aims["other members"] = float(np.median(others)) if len(others) >= OTHERS else 0.0
    what = max(aims, key=lambda name: aims[name])
    return what, aims[what]


def _double_error(estimate: Estimate) -> float:
    """Two standard errors, 0 where they are not known."""
    return 2.0 * estimate.error if math.isfinite(estimate.error) else 0.0
