"""MEP (Zhao et al. 2023): a population with maximum entropy.

    J(j) = J_SP(j) + alpha E[ sum over steps and seats of -ln mean_k pi_k(a | o) ]

All members learn together; none plays with another. What the whole population seldom does is paid, to whoever does it.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.losses.population_diversity import population_surprise
from popgen.methods.mappo.config import MepRun
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.population_bonus import JointLogProbs
from popgen.methods.mappo.train import RllibTraining, open_rllib
from popgen.methods.training import Transport


@dataclass(frozen=True)
class SurpriseBonus:
    """alpha times the population's surprise, both seats' added up."""

    weight: float
    floor: float

    def __call__(self, played: JointLogProbs) -> Tensor:
        """See `PopulationBonus`."""
        return self.weight * population_surprise(played.seats, self.floor).sum(-1)


def open_training(config: MepRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """See `popgen.methods.training.OpenTraining`."""
    settings = config.mep
    bonus = SurpriseBonus(settings.alpha, settings.floor) if settings.alpha > 0.0 else None
    return open_rllib(config, spec, attempt, transport, Objective(together=True, bonus=bonus))
