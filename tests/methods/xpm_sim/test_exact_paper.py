"""scale=paper holds the paper's table "Hyperparameters for MPPMR Agents" and the networks it asks for."""

from __future__ import annotations

import torch

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.xpm_sim.agent import XpmSimLearner, make_actor


def test_the_table_to_the_letter() -> None:
    config = RunConfig.parse(compose(["method=xpm_sim", "scale=paper", "env=rendezvous/mppmr"])).xpm_sim
    assert (config.layers, config.units, config.activation) == (5, 512, "leaky_relu")
    assert (config.lambda_xp, config.learning_rate, config.entropy, config.capacity) == (0.5, 5e-4, 1e-4, 200_000)
    assert config.horizon == config.restart_horizon == config.xp_horizon == config.unroll == 30
    assert config.surrogate == "reinforce" and config.starts_initial == config.xp_initial == 0.0
    self_play = (config.sims_sp + config.sims_restart) * config.unroll * config.updates
    cross_play = config.sims_xp * config.unroll * config.updates
    assert 8e5 <= self_play == cross_play < 8.01e5
    assert config.sp_weight + config.restart_weight == 1.0  # one expectation over both buffers
    assert config.recent * 50 >= config.capacity  # every buffered state can serve


def test_the_networks_have_five_layers_and_each_pair_its_critic() -> None:
    config = RunConfig.parse(compose(["method=xpm_sim", "scale=paper", "env=rendezvous/mppmr"])).xpm_sim
    env = make_env("rendezvous/mppmr", 1)
    known = {k: make_actor(config, env.spec, k).weights() for k in (1, 2)}
    learner = XpmSimLearner(config, env, 3, 0, known)
    for net in (learner.actor.net, *learner.critics.values()):
        linear = [part for part in net if isinstance(part, torch.nn.Linear)]
        assert [part.out_features for part in linear[:-1]] == [512] * 5
    assert set(learner.critics) == {"self", "1", "2"}  # 1 + 2 + 3 = M (M + 1) / 2 over three members
