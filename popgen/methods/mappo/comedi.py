"""CoMeDi (Sarkar et al. 2023): cross-play falls, and mixed play keeps members from sabotage.

    J(j) = J_SP(j) + lambda_MP J_MP(j, k*) - lambda_XP J_XP(j, k*),   k* = argmax_k J_XP(j, k)      (paper, eq. CoMeDi)

Members learn one after the other against frozen predecessors. Every `diversity.select_every` iterations, fresh episodes
with every predecessor in both seatings tell the strongest, k*. An iteration samples self-play, and with k* alone
cross-play and mixed play: an episode that begins in cross-play and goes over to self-play at a random step, from which
on it counts. A member that plays badly only to look different in cross-play would play badly there too.
"""

from __future__ import annotations

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.config import ComediRun
from popgen.methods.mappo.objective import Objective, Term
from popgen.methods.mappo.train import RllibTraining, open_rllib
from popgen.methods.training import Transport
from popgen.types import Kind

CROSS_PLAY = Term(Kind.XP, weight=lambda recipe: recipe.lambda_xp)
MIXED_PLAY = Term(Kind.MP, weight=lambda recipe: recipe.lambda_mp)

OBJECTIVE = Objective(terms=(MIXED_PLAY, CROSS_PLAY), fresh_episodes=True)


def open_training(config: ComediRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """See `popgen.methods.training.OpenTraining`."""
    return open_rllib(config, spec, attempt, transport, OBJECTIVE)
