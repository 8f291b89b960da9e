"""E3T (Yan et al. 2023), end-to-end training beside a mixture partner.

    J(j) = J(pi_j, (1 - epsilon) pi_j + epsilon uniform)

A member plays beside its own policy, which takes a random action now and then, in both seatings; only its own seat is
learned from. In one of `PLAIN_ONE_IN` environments it plays plainly with itself instead, which is not learned from:
`sp`, to which `ppo.target_score` is compared as in every other method, is that play's, `sp_noisy` the other's. Both
count as self-play, in the ledger and in `ppo.max_steps`. The paper's module that predicts the partner's actions from
the episode so far is left out: members have no memory. One stage, one member after the other, which differ by their
seeds.
"""

from __future__ import annotations

from popgen.envs.contract import EnvSpec
from popgen.methods.mappo.config import E3tRun
from popgen.methods.mappo.objective import Objective
from popgen.methods.mappo.train import RllibTraining, open_rllib
from popgen.methods.training import Transport


def open_training(config: E3tRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """See `popgen.methods.training.OpenTraining`."""
    return open_rllib(config, spec, attempt, transport, Objective(noise=config.e3t.epsilon))
