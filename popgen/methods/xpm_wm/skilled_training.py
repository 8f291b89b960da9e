"""FCP (Strouse et al. 2021) in a world model: self-play by different seeds, at different skill.

    J(j) = J_SP(j), on trajectories simulated by the world model of member 1

Member 1 and its world model are trained as in XPM-WM. Each later seed then learns in imagination, meets nobody, and
gives three members, as `method=fcp` does: the policy it started from, that of the round whose real self-play is nearest
to half of the final one's, and the final one. All of a seed's environment steps and seconds are counted for its final
member.
"""

from __future__ import annotations

from collections.abc import Iterator

from popgen.methods.skill_checkpoints import SkillCheckpoint, SkillCheckpoints, mark_final
from popgen.methods.training import PlannedPhase, TrainedMember
from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.methods.xpm_wm.member_training import XpmWmTraining
from popgen.methods.xpm_wm.phase2 import LaterMemberProgress
from popgen.methods.xpm_wm.train import FIRST
from popgen.types import SKILLS, Weights


class FcpWmTraining(XpmWmTraining):
    """One seed after the other; see `popgen.methods.training.Training`."""

    def first_of_group(self, member: int) -> int:
        """The initial member of the seed that `member` is of; member 1 is alone."""
        return member if member == FIRST else member - (member - FIRST - 1) % len(SKILLS)

    def plan(self) -> list[PlannedPhase]:
        """A seed trains its final member alone."""
        return [phase for phase in super().plan() if (phase.member - FIRST) % len(SKILLS) == 0]

    def begin(self, first: int) -> tuple[int, ...]:
        """A fresh agent, which becomes the final member of its seed; the others are kept on the way."""
        if first == FIRST:
            return super().begin(first)
        final = first + len(SKILLS) - 1
        super().begin(final)
        assert isinstance(self.progress, LaterMemberProgress)
        untrained = self.work.published_form()["acting"]
        self.progress.skills = SkillCheckpoints([SkillCheckpoint(0, 0.0, untrained)])
        return tuple(range(first, final + 1))

    def finish_members(self, final: TrainedMember) -> Iterator[TrainedMember]:
        """The three of this seed; member 1 is its final one alone."""
        if final.member == FIRST:
            yield mark_final(final)
            return
        assert isinstance(self.progress, LaterMemberProgress) and self.progress.skills is not None
        yield from self.progress.skills.finish_seed(final, self._make_policy)

    def _make_policy(self, actor: Weights) -> WorldModelPolicy:
        policy = WorldModelPolicy(self.config.world_model, self.config.agent, self.spec)
        policy.load(actor)
        return policy
