"""Phase 2, members 2..M: how far a member's training has come, which is what a checkpoint holds, and the rules of its
rounds.

Rules and what is said of a round are pure functions of the progress and the recipe; what a round changes in the
progress stands apart. Nothing runs for any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from popgen.methods.skill_checkpoints import SkillCheckpoint, SkillCheckpoints
from popgen.methods.training import Pending, Phase, Progress, Round, State
from popgen.methods.xpm_wm.config import Phase2Config
from popgen.methods.xpm_wm.real_play import Candidate, MemberWeights, Put, Watch
from popgen.methods.xpm_wm.workers import AgentTask, FittedPartners
from popgen.methods.xpm_wm.world_model import Starts
from popgen.play.episodes import Episode
from popgen.play.partner_strength import PartnerConstraint, PartnerStrength
from popgen.types import Kind, Weights

IMAGINATION = "imagination"


@dataclass
class LaterMemberProgress:
    """Members 2..M.

    Attributes:
        strength: each partner's returns in real cross-play.
        constraint: the multipliers that its scores there have led to.
        steps: environment steps so far.
        rounds: of real episodes that have ended; since_best: since the best of them.
        self_play_has_begun: real self-play has reached `agent.entropy_after` of the target.
        best: the policy of the best round.
        figures: of the last round.
        watch: signs of trouble so far.
        skills: policies on the way by their real self-play; None where the best alone is kept.
    """

    strength: PartnerStrength
    steps: int = 0
    rounds: int = 0
    self_play_has_begun: bool = False
    best: Candidate | None = None
    figures: dict[str, float] = field(default_factory=dict)
    since_best: int = 0
    watch: Watch = field(default_factory=Watch)
    constraint: PartnerConstraint = field(default_factory=lambda: PartnerConstraint(None, 0.0))
    skills: SkillCheckpoints | None = None

    def keep_skill(self, scored: Candidate) -> None:
        """The policy of a round, where such are kept."""
        if self.skills is not None:
            self.skills.add(SkillCheckpoint(self.steps, scored.sp, scored.weights.acting.result()))

    @property
    def best_shown(self) -> dict[str, float]:
        """The best round so far, for the progress line."""
        return {} if self.best is None else {"SP": round(self.best.sp, 2), "XP": round(self.best.xp, 2)}

    def to_state(self) -> State:
        """For a checkpoint, after the first round."""
        assert self.best is not None
        return {
            "rounds": self.rounds,
            "plays": self.self_play_has_begun,
            "since_best": self.since_best,
            "watch": self.watch.to_state(),
            "best": self.best.to_state(),
            "strength": self.strength.state(),
            "constraint": self.constraint.state(),
            "skills": None if self.skills is None else self.skills.state(),
        }

    def load_state(self, state: State, put: Put) -> None:
        """Go on from `to_state()`, as it was read; the steps are known."""
        self.strength.load_state(state["strength"])
        self.constraint.load_state(state["constraint"])
        self.best = Candidate.from_state(state["best"], put)
        self.rounds, self.self_play_has_begun = int(state["rounds"]), bool(state["plays"])
        self.since_best, self.watch = int(state["since_best"]), Watch.from_state(state["watch"])
        self.skills = None if state["skills"] is None else SkillCheckpoints.from_state(state["skills"])


# ---- rules -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ImaginationPlan:
    """Agent updates of one round: how many, how many came before, share of starts from the member's own data."""

    updates: int
    done: int
    new_share: float


def plan_imagination(rounds: int, phase: Phase2Config) -> ImaginationPlan:
    """Plan the round after `rounds`: the first one has no data of its own, and more updates."""
    if rounds == 0:
        return ImaginationPlan(phase.first_updates, 0, 0.0)
    return ImaginationPlan(phase.updates_per_round, count_imagination(phase, rounds), phase.starts_new)


def count_imagination(phase: Phase2Config, rounds: int) -> int:
    """Agent updates of so many rounds."""
    return phase.first_updates + (rounds - 1) * phase.updates_per_round if rounds else 0


def most_rounds(phase: Phase2Config, episodes_xp: int, horizon: int) -> int:
    """Rounds of real episodes at most: those configured, fewer where the environment steps end first."""
    most, each = max(phase.rounds, phase.max_rounds), (phase.episodes_sp + episodes_xp) * horizon
    return most if phase.max_steps is None else max(1, min(most, phase.max_steps // each))


def wants_another_round(progress: LaterMemberProgress, phase: Phase2Config, most: int) -> bool:
    """The configured rounds are played in any case, further ones only by a member that is still weak or, with a
    plateau, improves."""
    weak = progress.best is None or progress.best.sp < phase.target_score
    goes_on = weak or progress.since_best < phase.plateau
    return progress.rounds < (most if goes_on else min(phase.rounds, most))


def foresee_end(progress: LaterMemberProgress, phase: Phase2Config, most: int) -> int | None:
    """Agent updates after which the member is complete if it is good enough by now; None where it is still weak."""
    is_open = progress.best is None or progress.best.sp < phase.target_score or phase.plateau > 0
    return None if is_open else count_imagination(phase, max(progress.rounds, min(phase.rounds, most)))


def make_agent_task(
    progress: LaterMemberProgress,
    phase: Phase2Config,
    model: Pending[Weights],
    starts: Pending[Starts],
    partners: Pending[FittedPartners],
    most_paid: np.ndarray | None,
) -> AgentTask:
    """The round's task before its first update; the strongest partner so far (line 9) follows from `strength`.

    Args:
        progress, phase: of the member.
        model, starts, partners: see `AgentTask`.
        most_paid: by real play in up to 1, 2, ... steps on end, where imagination is held to it.
    """
    return AgentTask(
        updates=0,
        model=model,
        starts=starts,
        self_play_has_begun=progress.self_play_has_begun,
        new_share=plan_imagination(progress.rounds, phase).new_share,
        partner_scores=progress.strength.scores(),
        multipliers=progress.constraint.multipliers,
        partners=partners,
        pay_limits=None if most_paid is None else phase.pay_limit * most_paid,
    )


def choose_later(progress: LaterMemberProgress) -> Candidate:
    """The policy of the best round; there has been one."""
    assert progress.best is not None
    return progress.best


# ---- what a round changes --------------------------------------------------------------------------------------------


def judge_round(
    progress: LaterMemberProgress, published: MemberWeights, episodes: Sequence[Episode], horizon: int
) -> Candidate:
    """Line 9's returns from B_XP, of every partner met, and what follows for its multiplier; the round's policy with
    its scores, kept if it is the best."""
    own = [e for e in episodes if e.kind is Kind.SP]
    partners = sorted({partner for e in episodes if e.kind is Kind.XP for partner in e.members} - set(own[0].members))
    cross = {k: [e for e in episodes if e.kind is Kind.XP and k in e.members] for k in partners}
    for partner, met in cross.items():
        progress.strength.add(partner, [e.shaped for e in met])
    scores = {k: float(np.mean([e.score for e in met])) for k, met in cross.items()}
    strongest = max(scores.values(), default=0.0)
    candidate = Candidate(published, float(np.mean([e.score for e in own])), strongest)
    limit = progress.constraint.limit
    progress.constraint.add(scores, candidate.sp)
    progress.since_best += 1
    if progress.best is None or candidate.merit(limit) > progress.best.merit(limit):
        progress.best, progress.since_best = candidate, 0
    progress.keep_skill(candidate)
    progress.rounds += 1
    progress.figures = {
        "real_sp": candidate.sp,
        **({"real_xp_max": strongest} if scores else {}),
        "real_shaped_sp": float(np.mean([e.shaped for e in own])) / horizon,
        "round": progress.rounds,
    }
    return candidate


# ---- what is said ----------------------------------------------------------------------------------------------------


def describe_imagination(progress: LaterMemberProgress, phase: Phase2Config, member: int, most: int) -> Phase:
    """The phase of a later member: updates of at most so many rounds, those of the rounds so far done."""
    total, done = (count_imagination(phase, rounds) for rounds in (most, progress.rounds))
    return Phase(IMAGINATION, total, member, done=done, ends_at=foresee_end(progress, phase, most))


def describe_updates(
    progress: LaterMemberProgress, member: int, figures: dict[str, float], done: int, phase: Phase2Config, most: int
) -> Progress:
    """So many of the member's updates in imagination are done, of those of at most so many rounds."""
    shown = {"steps": progress.steps, "entropy": round(figures["agent/entropy"], 2), **progress.best_shown}
    return Progress(member, progress.steps, figures, done=done, shown=shown, ends_at=foresee_end(progress, phase, most))


def describe_round(progress: LaterMemberProgress, scored: Candidate, score_name: str) -> str:
    """A round in a line."""
    met = f", strongest XP {scored.xp:.2f}" if "real_xp_max" in progress.figures else ""
    scores = f"SP {scored.sp:.2f}{met} {score_name}"
    return f"round {progress.rounds}: {scores}, {progress.steps:,} steps"


def describe_later_round(
    progress: LaterMemberProgress, plan: Phase, scored: Candidate, score_name: str, trouble: str
) -> Round:
    """The round that has ended, with its figures, and its line with signs of trouble; `plan` is the phase by now."""
    note = f"member {plan.member}, {describe_round(progress, scored, score_name)}"
    note += f"; {trouble}" if trouble else ""
    ended = Round(plan.member, progress.steps, progress.figures, note=note, number=progress.rounds)
    return replace(ended, done=plan.done, ends_at=plan.ends_at)
