"""Policies of one training at different skill: kept while it goes on, chosen when it has ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from popgen.methods.training import State
from popgen.types import Weights

KEPT = 16
"""Candidates for the policies between the first and the last."""


@dataclass(frozen=True)
class SkillCheckpoint:
    """A policy on its way.

    Attributes:
        steps: environment steps until then.
        score: mean score of an episode of its own self-play, and of no other policy's; 0 for one that never played.
        actor: weights that it acts with.
    """

    steps: int
    score: float
    actor: Weights

    def figures(self) -> dict[str, Any]:
        """For the record of a member: it took no time beside the training that it is of."""
        return {"at_steps": self.steps, "sp": self.score, "seconds": 0.0}


@dataclass
class SkillCheckpoints:
    """At most `KEPT` policies of a training, spread over the scores it went through."""

    kept: list[SkillCheckpoint] = field(default_factory=list)

    def add(self, checkpoint: SkillCheckpoint) -> None:
        """Keep it; of too many the one goes that a neighbour in score stands in for best. The first stays."""
        self.kept.append(checkpoint)
        if len(self.kept) <= KEPT:
            return
        by_score = sorted(self.kept[1:], key=lambda one: one.score)
        gaps = [after.score - before.score for before, after in zip(by_score, by_score[1:], strict=False)]
        redundant = by_score[gaps.index(min(gaps))]
        self.kept = [one for one in self.kept if one is not redundant]

    def nearest(self, score: float) -> SkillCheckpoint:
        """The one after the first whose score is nearest, the earlier of two; the first where there is no other."""
        return min(self.kept[1:] or self.kept, key=lambda one: (abs(one.score - score), one.steps))

    def state(self) -> State:
        """For a checkpoint of the run."""
        return {
            str(number): {"steps": one.steps, "score": one.score, "actor": one.actor}
            for number, one in enumerate(self.kept)
        }

    @staticmethod
    def from_state(state: State) -> SkillCheckpoints:
        """Of `state()`."""
        saved = [state[number] for number in sorted(state, key=int)]
        return SkillCheckpoints(
            [SkillCheckpoint(int(one["steps"]), float(one["score"]), one["actor"]) for one in saved]
        )
