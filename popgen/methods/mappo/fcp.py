"""FCP (Strouse et al. 2021), fictitious co-play: self-play by different seeds, at different skill.

    J(j) = J_SP(j)

Each seed gives three members: the policy it started from, one on its way whose self-play is nearest to half of the
final one's (half way from the initial one's where that is negative), and the final one. A policy on the way has the
score of the iteration that it played, and of no other; the final one, which has played none yet, that of the latest
`ppo.window` episodes before it, as every method's members. All of a seed's environment steps and seconds are counted
for its final member.
"""

from __future__ import annotations

from collections.abc import Iterator

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.config import FcpRun
from popgen.methods.mappo.objective import SELF_PLAY
from popgen.methods.mappo.play_record import rate_self_play
from popgen.methods.mappo.train import RllibTraining, check_transport
from popgen.methods.mappo.training_job import policy_config
from popgen.methods.skill_checkpoints import SkillCheckpoint, SkillCheckpoints
from popgen.methods.training import Checkpoint, Loop, PlannedPhase, State, TrainedMember, Transport
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.types import SKILLS, Weights


class FcpTraining(RllibTraining):
    """One seed after the other; see `popgen.methods.training.Training`."""

    def __init__(self, config: FcpRun, spec: EnvSpec, attempt: str) -> None:
        super().__init__(config, spec, attempt, SELF_PLAY)
        self.skills = SkillCheckpoints()
        self.acting: tuple[int, Weights] = (0, {})  # who plays the next iteration, so many steps into the training

    def first_of_group(self, member: int) -> int:
        """The initial member of the seed that `member` is of."""
        return member - (member - 1) % len(SKILLS)

    def plan(self) -> list[PlannedPhase]:
        """RLlib trains the final member of each seed alone."""
        return [phase for phase in super().plan() if phase.member % len(SKILLS) == 0]

    def begin(self, first: int) -> tuple[int, ...]:
        """RLlib trains the final member; the others are kept on the way."""
        final = first + len(SKILLS) - 1
        super().begin(final)
        self.skills = SkillCheckpoints()
        self._hold_actor()
        return tuple(range(first, final + 1))

    def report_iteration(self) -> Loop:
        """The policy that has played this iteration is a candidate for the one at half skill; the first is the initial
        one."""
        yield from super().report_iteration()
        score = rate_self_play(self.algorithm.report.counted, self.spec.horizon)
        if score is not None:
            steps, actor = self.acting
            self.skills.add(SkillCheckpoint(steps, score, actor))
        self._hold_actor()

    def _hold_actor(self) -> None:
        final = self.learning[0]
        self.acting = self.progress.steps[final], self.algorithm.actors()[final]

    def finish_members(self) -> Iterator[TrainedMember]:
        """The three of this seed."""
        final = self.finish_member(self.learning[0])
        for member in self.skills.finish_seed(final, self._make_policy):
            self.archive[member.member] = member.policy.weights()
            yield member

    def _make_policy(self, actor: Weights) -> FeedForwardPolicy:
        return FeedForwardPolicy.from_parts(policy_config(self.config.ppo), actor, self.spec)

    def checkpoint(self) -> State:
        """See `Training`."""
        return {**super().checkpoint(), "skills": self.skills.state()}

    def restore(self, checkpoint: Checkpoint) -> None:
        """See `Training`."""
        super().restore(checkpoint)
        self.skills = SkillCheckpoints.from_state(checkpoint.state["skills"])
        self._hold_actor()


def open_training(config: FcpRun, spec: EnvSpec, attempt: str, transport: Transport) -> FcpTraining:
    """See `popgen.methods.training.OpenTraining`."""
    check_transport(transport)
    return FcpTraining(config, spec, attempt)
