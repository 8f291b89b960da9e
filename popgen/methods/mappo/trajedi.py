"""TrajeDi (Lupu et al. 2021): a population whose trajectories diverge.

    J(j) = J_SP(j) + alpha JSD_gamma(pi_1, ..., pi_K)

All members learn together; none plays with another. A step's part of the divergence is how much likelier the actions
around it are by the member's own policy than by the mean of all. Each is paid, at every step of its self-play, what its
action adds to the parts of all steps so far (`divergence_rewards` of `losses/population_diversity.py`), so that its
undiscounted returns are the divergence's score-function gradient. The rest of the gradient, that of the logarithm
itself, is left out. It vanishes in expectation over the population where whole episodes are compared (kernel 1); at
kernel 0.5 it is 0.23 of the whole, by random members on four steps (`tests/losses/test_population_diversity.py`). The
common best response of the paper is an ego agent. On the laptop alpha is in full only once a member plays
(`trajedi.full_score`).
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.losses.population_diversity import divergence_rewards
from popgen.methods.mappo.config import TrajediRun
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.population_bonus import JointLogProbs
from popgen.methods.mappo.train import RllibTraining, open_rllib
from popgen.methods.training import Transport


@dataclass(frozen=True)
class DivergenceBonus:
    """alpha times what each step's joint action adds to the divergence of joint trajectories."""

    weight: float
    kernel: float

    def __call__(self, played: JointLogProbs) -> Tensor:
        """See `PopulationBonus`."""
        return self.weight * divergence_rewards(played.seats.sum(-1), played.own, played.ends, self.kernel)


def open_training(config: TrajediRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """See `popgen.methods.training.OpenTraining`."""
    settings = config.trajedi
    bonus = DivergenceBonus(settings.alpha, settings.kernel) if settings.alpha > 0.0 else None
    objective = Objective(together=True, bonus=bonus, bonus_score=settings.full_score)
    return open_rllib(config, spec, attempt, transport, objective)
