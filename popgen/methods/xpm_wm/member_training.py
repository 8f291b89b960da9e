"""XPM-WM, member after member (paper, algorithm 1 and section 4.2): what members hand on, checkpoints, resuming."""

from __future__ import annotations

import time
from collections.abc import Iterator

from popgen.envs.contract import EnvSpec
from popgen.methods.training import Checkpoint, Loop, Pending, PlannedPhase, Progress, State, TrainedMember
from popgen.methods.xpm_wm import phase1, phase2
from popgen.methods.xpm_wm.actor_critic import FIT_ROWS, WorldModelPolicy
from popgen.methods.xpm_wm.config import WorldModelRun
from popgen.methods.xpm_wm.phase1 import FirstMemberProgress
from popgen.methods.xpm_wm.phase2 import LaterMemberProgress
from popgen.methods.xpm_wm.real_play import Candidate
from popgen.methods.xpm_wm.train import FIRST, LEARNERS, FirstMember, LaterMember
from popgen.methods.xpm_wm.workers import Setup, Workers
from popgen.nets.weights import same_form
from popgen.play.partner_strength import PartnerConstraint, PartnerStrength
from popgen.types import Weights

ROW_SECONDS, IMAGINED_SECONDS, STEP_SECONDS, FIT_SECONDS = 8e-5, 6.5e-5, 5e-6, 1.2e-5
"""On a laptop's core: of a row that the world model learns from, of an imagined step, of an environment step, of an
action that a partner is fitted to."""


def plan_phases(config: WorldModelRun, spec: EnvSpec) -> list[PlannedPhase]:
    """What all members will go through; costs are those of the updates, at the laptop's sizes."""
    one, two, agent = config.phase1, config.phase2, config.agent
    model_update = config.world_model.batch * config.world_model.length * ROW_SECONDS
    alone = agent.starts_sp * agent.horizon * IMAGINED_SECONDS
    together = (agent.starts_sp + agent.starts_xp) * agent.horizon * IMAGINED_SECONDS
    rounds = phase1.self_play_steps(one) / (one.envs * one.steps_per_iteration)
    both = {"model": rounds * one.model_updates * model_update, "agent": rounds * one.agent_updates * alone}
    overlaps = config.run.transport == "ray"
    phases = [
        PlannedPhase(phase1.RANDOM_PLAY, FIRST, one.prefill_steps * STEP_SECONDS),
        PlannedPhase(phase1.MODEL_ALONE, FIRST, {"model": one.pretrain_updates * model_update}),
        PlannedPhase(phase1.SELF_PLAY, FIRST, both, earliest=0.0, side_by_side=overlaps),
    ]
    for member in range(FIRST + 1, config.population.size + 1):
        most = phase2.most_rounds(two, two.cross_play_episodes(member - 1), spec.horizon)
        updates = phase2.count_imagination(two, most)
        fits = most * (member - 1) * two.partner_fits * FIT_ROWS * spec.num_players if config.heeds_predecessors else 0
        imagined = updates * together + fits * FIT_SECONDS  # the agent waits for its partners
        cost = {"model": (most - 1) * two.model_updates * model_update, "agent": imagined}
        earliest = phase2.count_imagination(two, min(two.rounds, most)) / updates
        beside = overlaps and two.model_lag > 0
        begins = {"model": phase2.count_imagination(two, 1) / updates}  # it learns in each round after the first
        planned = PlannedPhase(phase2.IMAGINATION, member, cost, 0, earliest, beside, begins)
        phases.append(planned)
    return phases


class XpmWmTraining:
    """The `Training` of XPM-WM on any workers."""

    learners = LEARNERS
    begins_workers = False

    def __init__(self, config: WorldModelRun, spec: EnvSpec, work: Workers) -> None:
        self.config, self.spec, self.work = config, spec, work
        self.log_rows = max(1, config.replay.capacity // 2)
        self.weights: dict[int, Weights] = {}
        self.archive: dict[int, Pending[Weights]] = {}
        self.member, self.seed, self.began, self.resumed = FIRST, 0, time.time(), False
        self.progress: FirstMemberProgress | LaterMemberProgress = self._fresh_progress(0)

    def _fresh_progress(self, steps: int) -> FirstMemberProgress | LaterMemberProgress:
        if self.member == FIRST:
            # An episode of each environment: fewer reach the target by luck, where some end in a stand-still.
            return FirstMemberProgress(max(16, self.config.phase1.envs), steps)
        agent = self.config.agent
        constraint = PartnerConstraint(agent.xp_limit, agent.multiplier_step)
        return LaterMemberProgress(PartnerStrength(agent.partner), steps, constraint=constraint)

    def adopt(self, weights: dict[int, Weights], left: State) -> None:
        """Take over finished members, their buffers and the world model."""
        for member, acting in weights.items():
            self._archive(member, acting)
        self.work.adopt(left)

    def _archive(self, member: int, acting: Weights) -> None:
        self.weights[member], self.archive[member] = acting, self.work.put(acting)

    def first_of_group(self, member: int) -> int:
        """Members learn one after the other."""
        return member

    def plan(self) -> list[PlannedPhase]:
        """See `Training`."""
        return plan_phases(self.config, self.spec)

    def begin(self, first: int) -> tuple[int, ...]:
        """A fresh agent on the world model so far."""
        self.member, self.seed = first, self.config.run.seed * 1000 + first
        self.began, self.resumed = time.time(), False
        self.progress = self._fresh_progress(0)
        self.work.begin_member(first, self.seed, self.weights if self.config.heeds_predecessors else {})
        return (first,)

    def train(self) -> Loop:
        """One member."""
        if self.resumed:
            steps = self.progress.steps
            yield Progress(self.member, steps, note=f"continuing after {steps:,} steps of member {self.member}")
        candidate = yield from (self._first().train(self.resumed) if self.member == FIRST else self._later().train())
        yield from self._complete(candidate)

    def _setup(self) -> Setup:
        return Setup(self.work, self.config, self.spec, self.member, self.seed, self.archive)

    def _first(self) -> FirstMember:
        assert isinstance(self.progress, FirstMemberProgress)
        return FirstMember(self._setup(), self.progress)

    def _later(self) -> LaterMember:
        assert isinstance(self.progress, LaterMemberProgress)
        return LaterMember(self._setup(), self.progress)

    def _complete(self, candidate: Candidate) -> Loop:
        """The member as it is saved, with the buffers and the world model that the next one starts from."""
        acting, model, critics = (
            handle.result() for handle in (candidate.weights.acting, candidate.weights.model, candidate.weights.critics)
        )
        training = {f"model.{name}": value for name, value in model.items() if not name.startswith("filter.")}
        training |= {f"critics.{name}": value for name, value in critics.items()}
        report, seconds, steps = self.work.report_model().result(), time.time() - self.began, self.progress.steps
        yield Progress(self.member, steps, {"final_sp": candidate.sp, "final_xp": candidate.xp, **report})
        policy = WorldModelPolicy(self.config.world_model, self.config.agent, self.spec)
        policy.load(acting)
        phase = self.config.phase1 if self.member == FIRST else self.config.phase2
        extra = {"sp": candidate.sp, "xp": candidate.xp, "seconds": round(seconds, 1), "world_model": report}
        extra["target"] = phase.target_score
        note = (
            f"member {self.member}: SP {candidate.sp:.2f}, XP {candidate.xp:.2f} {self.spec.score_name} in training, "
            f"{steps:,} environment steps, {seconds / 60:.1f} min"
        )
        left = {**self.work.buffers_state(), "model": self.work.model_state()}
        for trained in self.finish_members(TrainedMember(self.member, policy, training, self.seed, extra, left, note)):
            yield trained
            self._archive(trained.member, trained.policy.weights())

    def finish_members(self, final: TrainedMember) -> Iterator[TrainedMember]:
        """All that this training gives."""
        yield final

    # ---- checkpoints -----------------------------------------------------------------------------------------------

    def checkpoint(self) -> State:
        """The member's progress, and the state of all workers but the buffers, which the log holds."""
        own = {"progress": self.progress.to_state(), "steps": self.progress.steps, "seconds": time.time() - self.began}
        return {**self.work.state(), **own}

    def buffers(self) -> State:
        """Both buffers whole."""
        return self.work.buffers_state()

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue where `checkpoint` was made.

        Raises:
            LookupError, TypeError, ValueError: a part is missing or does not fit.
        """
        state, steps = checkpoint.state["progress"], int(checkpoint.state["steps"])
        self.began -= float(checkpoint.state.get("seconds", 0.0))  # an earlier version did not keep them
        self.work.restore(checkpoint)
        form = self.work.published_form()
        if self.member == FIRST:
            best = state["best"] or state
            for weights in (state["published"], {**state["published"], "model": state["model"]}, best["published"]):
                same_form(weights, form, "the published policy")
            window = max(16, self.config.phase1.envs)
            self.progress = FirstMemberProgress.from_state(state, window, steps, self.work.put)
            self._first().start_self_play()
            self.work.restore_samplers(checkpoint.state["samplers"])
        else:
            same_form(state["best"]["published"], form, "the published policy")
            self.progress = progress = self._fresh_progress(steps)
            assert isinstance(progress, LaterMemberProgress)
            progress.load_state(state, self.work.put)
        self.resumed = True

    def close(self) -> None:
        """End all workers."""
        self.work.end()
