"""BRDiv (Rahman et al. 2023), best-response diversity: partners that ask for different best responses.

    C_ij = J(confederate i, best response of confederate j)
    max  sum_i C_ii + alpha sum_i sum_{j != i} [ (C_ii - C_ij) + (C_ii - C_ji) ]

All pairs are trained together: each with itself, and every confederate with every other's best response, in both
seatings. Everyone learns from its own seat, in each iteration from its cross-play with all others. Divided by the
weight of C_ii, the objective of a pair is its own return less lambda times its mean cross-play (`cross_play_weight`).
With alpha 0, a control, pairs do not meet: no cross-play is sampled, and `ppo.target_score` alone ends the training.
"""

from __future__ import annotations

from collections.abc import Iterator

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.config import BrdivRun, DiversityConfig
from popgen.methods.mappo.needs import list_pair_roles
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.train import STEP_SECONDS, RllibTraining, check_transport
from popgen.methods.mappo.training_job import Job
from popgen.methods.training import PlannedPhase, TrainedMember, Transport
from popgen.types import CONFEDERATE_ROLE


def cross_play_weight(alpha: float, pairs: int) -> float:
    """Lambda of the mean cross-play of a pair with the others, beside its own return's 1: C_ii stands in 1 + 2 alpha
    (K - 1) terms of the objective, each C_ij in 2 alpha."""
    crossed = 2.0 * alpha * (pairs - 1)
    return crossed / (1.0 + crossed)


class BrdivTraining(RllibTraining):
    """All pairs together; see `popgen.methods.training.Training`. Best responses have the numbers 1 to K in RLlib, the
    confederates those after them."""

    def __init__(self, config: BrdivRun, spec: EnvSpec, attempt: str) -> None:
        super().__init__(config, spec, attempt, Objective(together=True))
        self.brdiv, self.roles = config.brdiv, list_pair_roles(config.brdiv)
        self.count = config.population.size // len(self.roles)

    def make_job(self) -> Job:
        """Every best response beside its confederate, and beside all others."""
        config, brdiv = self.config, self.brdiv
        pairs = {pair: pair + self.count for pair in range(1, self.count + 1)}
        diversity = DiversityConfig(
            lambda_xp=cross_play_weight(brdiv.alpha, self.count),
            warmup=brdiv.warmup,
            xp_envs=brdiv.xp_envs,
            xp_clip=brdiv.xp_clip,
            target_xp=brdiv.target_xp,
        )
        return Job(
            env=config.env,
            ppo=config.ppo,
            diversity=diversity if brdiv.alpha > 0.0 else None,
            learning=(*pairs, *pairs.values()),
            seed=config.run.seed * 1000 + 1,
            pairs=pairs,
            all_partners=True,
        )

    def trained_as(self, member: int) -> int:
        """Number in RLlib of a member."""
        place, role = divmod(member - 1, len(self.roles))
        return 1 + place + (self.count if self.roles[role] == CONFEDERATE_ROLE else 0)

    def member_of(self, trained: int) -> int:
        """A pair's own play counts for its best response, cross-play for its confederate; all for the one member that
        a pair gives."""
        pair = (trained - 1) % self.count
        last = len(self.roles) - 1
        return 1 + pair * len(self.roles) + (0 if trained > self.count else last)

    def figures_by_member(self) -> dict[int, dict[str, float]]:
        """The last iteration's."""
        figures = self.algorithm.report.figures
        return {member: figures[self.trained_as(member)] for member in self.learning}

    def plan(self) -> list[PlannedPhase]:
        """One phase, of all pairs."""
        met = (self.count - 1) * self.brdiv.xp_envs / self.config.ppo.envs if self.brdiv.alpha > 0.0 else 0.0
        cost = self.count * (1.0 + met) * self.config.ppo.max_steps * STEP_SECONDS
        return [PlannedPhase(self.config.method, 1, cost, self.config.population.size, earliest=0.0)]

    def finish_members(self) -> Iterator[TrainedMember]:
        """The roles of all pairs, one pair after the other."""
        for member in self.learning:
            place, role = divmod(member - 1, len(self.roles))
            finished = self.finish_member(member, self.trained_as(member))
            finished.extra.update(role=self.roles[role], pair=1 + place)
            yield finished


def open_training(config: BrdivRun, spec: EnvSpec, attempt: str, transport: Transport) -> BrdivTraining:
    """See `popgen.methods.training.OpenTraining`."""
    check_transport(transport)
    return BrdivTraining(config, spec, attempt)
