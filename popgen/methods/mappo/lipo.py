"""LIPO (Charakorn et al. 2023): policies that are good with themselves and bad with each other.

    J(j) = J_SP(j) - lambda_XP max_k J_XP(j, k)          (paper, eq. LIPO)

Every iteration samples self-play, and cross-play with every other member in both seatings; the strongest partner k is
the one with the highest mean return in the latest of these episodes, and only its trajectories enter the objective.
All members learn together, each the others' partner; with `diversity.order=sequential` one after the other.
"""

from __future__ import annotations

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.config import LipoRun
from popgen.methods.mappo.objective import Objective, Term
from popgen.methods.mappo.train import RllibTraining, open_rllib
from popgen.methods.training import Transport
from popgen.types import Kind

CROSS_PLAY = Term(Kind.XP, weight=lambda recipe: recipe.lambda_xp)

OBJECTIVE = Objective(terms=(CROSS_PLAY,), fresh_episodes=False)


def open_training(config: LipoRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """See `popgen.methods.training.OpenTraining`."""
    return open_rllib(config, spec, attempt, transport, OBJECTIVE)
