"""Policies of one training at different skill: kept while it goes on, chosen when it has ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from popgen.methods.training import State, TrainedMember
from popgen.play.policy import Policy
from popgen.types import SKILLS, Weights

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


def mark_final(member: TrainedMember) -> TrainedMember:
    """The same member, as one whose training has ended."""
    member.extra["skill"] = SKILLS[-1]
    return member


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

    def half_trained(self, final: float) -> SkillCheckpoint:
        """The one nearest to half of the `final` score or, where the first one's score is negative, to half way between
        the two."""
        return self.nearest((min(0.0, self.kept[0].score) + final) / 2.0)

    def finish_seed(self, final: TrainedMember, make: Callable[[Weights], Policy]) -> Iterator[TrainedMember]:
        """The members of a seed, `final` the last. Those before it are made by `make` from their actors' weights; they
        leave behind what it does, so that any may be the last of a population."""
        chosen = (self.kept[0], self.half_trained(float(final.extra.get("sp", 0.0))))
        for number, (skill, checkpoint) in enumerate(zip(SKILLS, chosen, strict=False)):
            member = final.member - len(SKILLS) + 1 + number
            extra = {"skill": skill, "of_member": final.member, **checkpoint.figures()}
            note = f"member {member}: {skill} of member {final.member}, {checkpoint.steps:,} steps into its training"
            policy = make(checkpoint.actor)
            yield TrainedMember(member, policy, None, seed=final.seed, extra=extra, left=final.left, note=note)
        yield mark_final(final)

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
