"""Members that do not play: their self-play is far below what was aimed at or below the other members', or no better
than play beside a random partner.

Self-play of a member that was trained in a pair is its play with its mate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from popgen.evaluation.crossplay import RANDOM
from popgen.evaluation.estimates import Estimate
from popgen.evaluation.holdout_lineages import TRAINED_WITH
from popgen.population.manifest import MemberInfo
from popgen.reports.crossplay_report import estimate_play, list_mates
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


def list_weak_members(infos: Sequence[MemberInfo], scores: Mapping[str, Any], share: float) -> list[WeakMember]:
    """Members of a population that do not play, of those that are meant to play with themselves or their mates.

    Args:
        infos: of all members; `extra.target` is the self-play that a method aimed at.
        scores: the evaluation, see `popgen.reports.crossplay_report`.
        share: as in `find_weak_members`.
    """
    targets = {info.id: float(info.extra["target"]) for info in infos if "target" in info.extra}
    meant = list_meant(infos, scores)
    return [one for one in find_weak_members(scores, targets, share) if one.member in meant]


def list_meant(infos: Sequence[MemberInfo], scores: Mapping[str, Any]) -> list[int]:
    """Members that are meant to play well with themselves, or with their mates.

    A member that is kept for its lower skill (`extra.skill`) is not, nor is an ego that learned beside partners
    (`extra.trained_with`), or one of a pair (`extra.role`) that is kept without its mate.
    """
    mates = list_mates(scores)
    unfinished = {info.id for info in infos if is_unfinished(info)}
    single = {info.id for info in infos if "role" in info.extra and mates.get(info.id) == info.id}
    taught = {info.id for info in infos if info.extra.get(TRAINED_WITH)}
    return [info.id for info in infos if info.id not in unfinished | single | taught]


def is_unfinished(info: MemberInfo) -> bool:
    """A member that is kept for its lower skill."""
    return info.extra.get("skill", FINAL_SKILL) != FINAL_SKILL


def find_weak_members(scores: Mapping[str, Any], targets: Mapping[int, float], share: float) -> list[WeakMember]:
    """Members whose self-play is, by more than two standard errors, below `share` of their target or of the median of
    the others; and of the rest those whose self-play is no better than their own play beside a random partner.

    Aims that are not positive, as returns that are penalties, tell nothing, nor do those that are `NEVER_REACHED`;
    play beside a random partner does, whatever its sign.

    Args:
        scores: the evaluation.
        targets: by member, where its method has one.
        share: 0 finds nobody.
    """
    mates = list_mates(scores)
    own, beside = estimate_play(scores, mates), estimate_play(scores, dict.fromkeys(mates, RANDOM))
    found = []
    for member, sp in own.items() if share > 0.0 else ():
        what, aim = _find_aim(own, member, targets.get(member, 0.0))
        if aim > 0.0 and sp.mean + _double_error(sp) < share * aim:
            found.append(WeakMember(member, sp, aim, what, share))
        elif sp.mean <= beside[member].mean:
            found.append(WeakMember(member, sp, beside[member].mean, RANDOM_PARTNER, share))
    return found


def _find_aim(own: Mapping[int, Estimate], member: int, target: float) -> tuple[str, float]:
    """The higher of a member's target and the other members' median self-play, and which it is; 0 where neither is."""
    others = [sp.mean for other, sp in own.items() if other != member]
    aims = {"target": target if target < NEVER_REACHED else 0.0}
    aims["other members"] = float(np.median(others)) if len(others) >= OTHERS else 0.0
    what = max(aims, key=lambda name: aims[name])
    return what, aims[what]


def _double_error(estimate: Estimate) -> float:
    """Two standard errors, 0 where they are not known."""
    return 2.0 * estimate.error if math.isfinite(estimate.error) else 0.0
