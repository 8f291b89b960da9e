"""TrajeDi (Lupu et al. 2021): a population whose trajectories diverge.

    J(j) = J_SP(j) + alpha JSD_gamma(pi_1, ..., pi_K)

All members learn together; none plays with another. Each is paid, at every step of its self-play, how much likelier the
actions around it are by its own policy than by the mean of all (`losses/population_diversity.py`): the divergence's
score-function gradient. The rest of its gradient, that of the logarithm itself, vanishes in expectation over the
population where whole episodes are compared, and is left out. The common best response of the paper is an ego agent.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.losses.population_diversity import trajectory_divergence
from popgen.methods.mappo.config import TrajediRun
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.population_bonus import JointLogProbs
from popgen.methods.mappo.train import RllibTraining, open_rllib
from popgen.methods.training import Transport


@dataclass(frozen=True)
class DivergenceBonus:
    """alpha times the step's part of the divergence of joint trajectories."""

    weight: float
    kernel: float

    def __call__(self, played: JointLogProbs) -> Tensor:
        """See `PopulationBonus`."""
        return self.weight * trajectory_divergence(played.seats.sum(-1), played.own, played.ends, self.kernel)


def open_training(config: TrajediRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """See `popgen.methods.training.OpenTraining`."""
    settings = config.trajedi
    bonus = DivergenceBonus(settings.alpha, settings.kernel) if settings.alpha > 0.0 else None
    return open_rllib(config, spec, attempt, transport, Objective(together=True, bonus=bonus))
