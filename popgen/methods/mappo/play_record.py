"""What a training has played: steps, scores, partners' strength, and what follows for the next iteration."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from popgen.losses.policy_losses import linear_schedule
from popgen.methods.mappo.config import DiversityConfig
from popgen.methods.mappo.pooling import Plan
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import Job
from popgen.play.partner_strength import PartnerConstraint, PartnerStrength, any_then_strongest
from popgen.play.rollout import Match, columns_of
from popgen.types import Kind

HABIT_DECAY = 0.9
"""Per iteration, of the moving mean of what players do."""


@dataclass(frozen=True)
class Counted:
    """Environment steps of one owner and kind in one call of one runner.

    Attributes:
        runner, owner, kind, steps: who stepped how many, for whom.
        episodes, score: those that ended with these steps, and the sum of their scores.
        earned: score of these steps alone, whenever their episodes end.
        covered: steps of an episode that these stand for (`popgen.envs.reward.covered_steps`).
    """

    runner: int
    owner: int
    kind: Kind
    steps: int
    episodes: int
    score: float
    earned: float = 0.0
    covered: float = 0.0


@dataclass
class _Total:
    steps: int = 0
    episodes: int = 0
    score: float = 0.0
    earned: float = 0.0
    covered: float = 0.0


def rate_self_play(counted: Sequence[Counted], horizon: int) -> float | None:
    """Self-play's score an episode, by the score of these steps alone; None without any.

    The policies that took the steps, and no earlier ones, are behind it. Episodes of all ages must be among the steps,
    which staggered ones are.
    """
    played = [one for one in counted if one.kind is Kind.SP]
    covered = sum(one.covered for one in played)
    return horizon * sum(one.earned for one in played) / covered if covered else None


class PlayRecord:
    """Self-play steps and scores of every learning member, and its partners' strength."""

    def __init__(self, job: Job) -> None:
        self.job = job
        # All fresh episodes count, or those of one seating alone would be left of many.
        window = None if job.fresh or job.diversity is None else job.diversity.window
        self.partners = {m: PartnerStrength("max_latest", window) for m in job.learning}
        limit, step = (None, 0.0) if job.diversity is None else (job.diversity.xp_limit, job.diversity.multiplier_step)
        self.constraints = {m: PartnerConstraint(limit, step) for m in job.learning}
        self.own: dict[int, deque[float]] = {m: deque(maxlen=job.ppo.window) for m in job.owners}
        noisy = [m for m in job.owners if job.is_noisy(m)]
        self.noisy: dict[int, deque[float]] = {m: deque(maxlen=job.ppo.window) for m in noisy}
        self.taken = dict.fromkeys(job.owners, 0)  # self-play steps
        self.habits: dict[int, np.ndarray] = {}  # moving mean of each player's events of a step, in its own play
        self.rng = np.random.default_rng(job.seed)

    @property
    def progress(self) -> float:
        """Share of the budget that every member's self-play has used up."""
        return min(self.taken.values()) / self.job.ppo.max_steps

    @property
    def finished(self) -> bool:
        """The budget is used up, or every member's targets are reached."""
        return self.progress >= 1.0 or all(self.is_target_reached(member) for member in self.job.owners)

    def scores(self, member: int) -> dict[str, float]:
        """Mean scores of the latest episodes: `sp`, `sp_noisy` beside the own policy with random actions, and `xp` of
        the partner with the highest."""
        owner = self.job.owner_of(member)
        windows = {"sp": self.own[owner], "sp_noisy": self.noisy.get(owner)}
        own = {name: float(np.mean(scores)) for name, scores in windows.items() if scores}
        cross = self.partners[member].mean_scores()
        return own | ({"xp": max(cross.values())} if cross else {})

    def is_target_reached(self, member: int) -> bool:
        """Self-play is good enough and cross-play with every partner low enough."""
        ppo, diversity, scores = self.job.ppo, self.job.diversity, self.scores(member)
        if len(self.own[member]) < ppo.window or scores["sp"] < ppo.target_score:
            return False
        partners = self.job.partners(member)
        if not partners or diversity is None:
            return True
        cross = self.partners[member].mean_scores()
        return len(cross) == len(partners) and max(cross.values()) <= diversity.target_xp

    def plan(self, member: int, rounds: int) -> Plan:
        """What a member is trained on after `rounds` iterations: lambda_XP rises over the first `warmup`, the bonus
        with the member's score. The partner is the strongest or, under a constraint, drawn in proportion to the
        multipliers; or all share the weight."""
        diversity, partners, mate = self.job.diversity, self.job.partners(member), self.job.mate_of(member)
        bonus = linear_schedule(0.0, 1.0, max(0.0, self.scores(member).get("sp", 0.0)), self.job.bonus_score)
        own = Plan(mate=None if mate == member else mate, bonus=bonus)
        if diversity is None or not partners:
            return own
        weight = linear_schedule(0.0, diversity.lambda_xp, rounds + 1, diversity.warmup)
        bounds = {"xp_clip": diversity.xp_clip, "xp_floor": diversity.xp_floor}
        if self.job.all_partners:
            first, *others = partners
            each = weight / len(partners)
            return replace(own, partner=first, others=tuple(others), lambda_xp=each, **bounds)
        if diversity.xp_limit is None:
            strength = self.partners[member].scores()
            partner = any_then_strongest(partners, strength, diversity.partner_random, self.rng)
        else:
            constraint = self._move_multipliers(member, rounds)
            partner, weight = constraint.draw_partner(partners, self.rng), weight * constraint.pressure(partners)
        mixed = diversity.lambda_mp if self.job.mixed else 0.0
        return replace(own, partner=partner, lambda_xp=weight, lambda_mp=mixed, **bounds)

    def _move_multipliers(self, member: int, rounds: int) -> PartnerConstraint:
        """The constraint after the latest scores: of every iteration, or of fresh episodes where these decide."""
        constraint, diversity = self.constraints[member], self.job.diversity
        if diversity is not None and not (self.job.fresh and rounds % diversity.select_every):
            constraint.add(self.partners[member].mean_scores(), self.scores(member).get("sp"))
        return constraint

    def is_played(self, match: Match, plans: Mapping[int, Plan]) -> bool:
        """LIPO samples cross-play with every partner; CoMeDi with the chosen one, for both kinds."""
        if match.kind is Kind.SP or (match.kind is Kind.XP and not self.job.fresh):
            return True
        return plans[match.owner].partner == match.partner_of(match.owner)

    def add(self, runner: int, rollout: Rollout, *, judge_partners: bool) -> list[Counted]:
        """Steps and episodes by owner and kind; scores to the windows, cross-play's where `judge_partners`."""
        totals: dict[tuple[int, Kind], _Total] = defaultdict(_Total)
        for match, columns in zip(rollout.matches, columns_of(rollout.matches), strict=True):
            played, total = len(rollout.reward) * match.envs, totals[match.owner, match.kind]
            total.steps += played
            total.earned += float(rollout.score[:, columns].sum(dtype=np.float64))
            total.covered += float(rollout.covered[:, columns].sum(dtype=np.float64))
            if match.kind is Kind.SP:
                self.taken[match.owner] += played
        for episode in rollout.episodes:
            total = totals[episode.owner, episode.kind]
            total.episodes += 1
            total.score += episode.score
            if episode.kind is Kind.SP:
                windows = self.noisy if min(episode.members) < 0 else self.own
                windows[episode.owner].append(episode.score)
            elif episode.kind is Kind.XP and judge_partners:
                for member in set(episode.members) & set(self.job.learning):
                    self.partners[member].add(episode.partner_of(member), [episode.shaped], [episode.score])
        return [Counted(runner, owner, kind, **vars(total)) for (owner, kind), total in totals.items()]

    def add_habits(self, rollouts: Sequence[Rollout]) -> None:
        """A tenth of the moving mean is what each player did in an iteration: in these steps of all runners."""
        counted = [rollout for rollout in rollouts if rollout.events.shape[-1]]
        for member in self.job.learning:
            parts = [rollout.events[rollout.seats == member] for rollout in counted]
            if not (steps := sum(map(len, parts))):
                continue
            now = np.sum([part.sum(0, dtype=np.float64) for part in parts], 0) / steps
            before = self.habits[member] if member in self.habits else now  # noqa: SIM401 (a type that is known)
            self.habits[member] = before * HABIT_DECAY + (1.0 - HABIT_DECAY) * now

    def selection_matches(self, member: int, diversity: DiversityConfig) -> Sequence[Match]:
        """Fresh episodes with every partner, in both seatings, decide who is the strongest; the old ones are
        forgotten."""
        for partner in self.job.partners(member):
            self.partners[member].forget(partner)
        return [
            Match(Kind.XP, pair, diversity.select_episodes, member)
            for k in self.job.partners(member)
            for pair in ((member, k), (k, member))
        ]

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "partners": {str(m): strength.state() for m, strength in self.partners.items()},
            "constraints": {str(m): constraint.state() for m, constraint in self.constraints.items()},
            "own": {str(m): list(scores) for m, scores in self.own.items()},
            "noisy": {str(m): list(scores) for m, scores in self.noisy.items()},
            "taken": {str(m): steps for m, steps in self.taken.items()},
            "habits": {str(m): habits.copy() for m, habits in self.habits.items()},
            "rng": self.rng.bit_generator.state,
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Replace the contents with `state()` of a record of the same job."""
        for member in self.job.learning:
            self.partners[member].load_state(state["partners"][str(member)])
            self.constraints[member].load_state(state["constraints"][str(member)])
        for member in self.job.owners:
            self.own[member].clear()
            self.own[member].extend(state["own"][str(member)])
            self.taken[member] = int(state["taken"][str(member)])
        for member, scores in self.noisy.items():
            scores.clear()
            scores.extend(state["noisy"][str(member)])
        self.habits = {int(m): np.array(habits) for m, habits in state["habits"].items()}
        self.rng.bit_generator.state = state["rng"]
