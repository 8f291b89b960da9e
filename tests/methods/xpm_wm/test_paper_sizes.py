"""What `scale=paper` builds and draws, against the paper's table of XPM-WM hyper-parameters and its algorithm 1."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.methods.xpm_wm.agent import AgentLearner
from popgen.methods.xpm_wm.imagination import NEW_SP, NEW_XP, OLD, draw_cross_play, draw_self_play
from popgen.methods.xpm_wm.replay import Query, model_batch, start_batch
from popgen.methods.xpm_wm.world_model import Starts, WorldModel
from popgen.types import Kind

SMALL = ["world_model.units=8", "world_model.deter=8", "agent.units=8", "agent.layers=1"]


@pytest.fixture(scope="module")
def config() -> RunConfig:
    return RunConfig.parse(compose(["scale=paper", "env=overcooked/cramped_room"]))


@pytest.fixture(scope="module")
def model(config: RunConfig) -> WorldModel:
    return WorldModel(config.world_model, make_env(config.env.name, 1, **config.env.params).spec)


def hidden(net: nn.Module) -> list[int]:
    """Sizes of the layers that an activation follows; all activations must be the table's."""
    parts = list(net.modules())
    assert not any(isinstance(part, nn.SiLU | nn.ReLU | nn.Tanh) for part in parts)
    linear = [part for part in parts if isinstance(part, nn.Linear)]
    activations = sum(isinstance(part, nn.LeakyReLU) for part in parts)
    return [layer.out_features for layer in linear[:activations]]


def kernels(net: nn.Module, kind: type) -> list[tuple[int, ...]]:
    return [part.kernel_size for part in net.modules() if isinstance(part, kind)]


def test_encoder_is_three_convolutions_and_three_layers(model: WorldModel) -> None:
    encoder = model.filter.encoder
    assert encoder.conv is not None
    assert kernels(encoder.conv, nn.Conv2d) == [(5, 5), (3, 3), (3, 3)]
    assert hidden(encoder.trunk) == [512] * 3
    first = next(part for part in encoder.conv.modules() if isinstance(part, nn.Conv2d))
    assert first.in_channels == 2 * 26, "both players' observations, 26 channels each"


def test_each_player_has_a_decoder_of_three_layers_and_three_transposed_convolutions(model: WorldModel) -> None:
    assert len(model.decoders) == 2
    for decoder in model.decoders:
        assert decoder.conv is not None
        assert hidden(decoder.trunk) == [512] * 3
        assert kernels(decoder.conv, nn.ConvTranspose2d) == [(3, 3), (3, 3), (5, 5)]


def test_heads_transition_prior_and_posterior(model: WorldModel) -> None:
    assert hidden(model.event_head) == hidden(model.continue_head) == [512] * 5
    assert hidden(model.prior_net) == hidden(model.filter.posterior_net) == [512] * 2
    assert model.filter.gru.units == 512
    assert model.event_head[-1].out_features == 2 * 5


def test_latents_are_28_joint_groups_and_4_private_ones_of_32_classes(model: WorldModel) -> None:
    assert model.masks.reshape(2, 32, 32).any(1).sum(-1).tolist() == [30, 30]
    assert int((model.masks[0] * model.masks[1]).reshape(32, 32).any(0).sum()) == 28
    assert model.prior(torch.zeros(1, 512)).shape == (1, 32, 32)


def test_what_the_table_leaves_open_is_dreamers_and_not_the_laptops(config: RunConfig) -> None:
    """KL balance 1 and 0.1 with one free nat, 255 bins, horizon 333; windows of 1,024 states but for the interval of
    50 steps, into which a window and its four steps ahead must fit."""
    model, agent, laptop = config.world_model, config.agent, RunConfig.parse(compose(["env=overcooked/cramped_room"]))
    assert (model.kl_dyn, model.kl_rep, model.free_nats) == (1.0, 0.1, 1.0)
    assert (agent.bins, agent.discount, agent.lam, agent.slow_critic) == (255, 0.997, 0.95, 0.98)
    assert model.length + 4 == config.phase1.steps_per_iteration == 50
    assert abs(model.length * model.batch - 16 * 64) <= model.length // 2
    assert laptop.world_model.kl_rep != model.kl_rep and laptop.world_model.length != model.length


def test_agent(config: RunConfig, model: WorldModel) -> None:
    agent = AgentLearner(config.agent, config.world_model, model.spec, member=1, seed=0)
    assert hidden(agent.actor.net) == hidden(agent.critics["0"].net) == [512] * 5
    rates = [
        group["lr"]
        for group in (*agent.networks.actor_optimiser.param_groups, *agent.networks.critic_optimiser.param_groups)
    ]
    assert rates == [4e-5, 1e-4]
    assert (agent.config.horizon, agent.config.entropy, agent.config.lambda_xp) == (15, 0.03, 0.25)


@pytest.mark.parametrize(("layout", "wanted"), [("cramped_room", 0.25), ("counter_circuit_o_1order", 0.1)])
def test_lambda_is_the_tables_from_the_first_update_on(layout: str, wanted: float) -> None:
    config = RunConfig.parse(compose(["scale=paper", f"env=overcooked/{layout}", *SMALL]))
    agent = AgentLearner(config.agent, config.world_model, make_env(config.env.name, 1).spec, member=2, seed=0)
    for updates in (0, 1, 10, 10_000):
        agent.updates = updates
        assert agent.lambda_now() == wanted


def starts(pool: int, partner: int, count: int = 50) -> Starts:
    h, z = np.zeros((count, 4), np.float32), np.zeros((count, 2), np.uint8)
    return Starts(h, z, np.full(count, pool, np.uint8), np.full(count, partner, np.int16))


def test_starts_are_half_self_play_half_cross_play_and_cross_play_is_that_partners(config: RunConfig) -> None:
    pools = [starts(OLD, 0), starts(NEW_SP, 0), starts(NEW_XP, 1), starts(NEW_XP, 2)]
    every, rng = Starts.concat(pools), np.random.default_rng(0)
    share, from_xp = config.phase2.starts_new, config.agent.sp_from_xp
    own = draw_self_play(every, 20_000, share, from_xp, rng)
    shares = np.bincount(every.pool[own], minlength=3) / len(own)
    np.testing.assert_allclose(shares, [0.0, 0.5, 0.5], atol=0.02)
    cross = draw_cross_play(every, 1000, share, 2, rng)
    assert set(every.pool[cross]) == {NEW_XP} and set(every.partner[cross]) == {2}
    unmet = draw_cross_play(Starts.concat(pools[:3]), 1000, share, 2, rng)
    assert set(every.pool[unmet]) == {OLD}, "states of another partner do not stand in"


def test_batches_are_drawn_evenly_and_of_the_members_own_play(config: RunConfig, model: WorldModel) -> None:
    first = model_batch(config, 1)
    assert [(r.query, r.count, r.event_fraction) for r in first.sp] == [(Query(), config.world_model.batch, 0.0)]
    later = model_batch(config, 3)
    drawn = {name: [r for r in getattr(later, name) if r.count] for name in ("sp", "xp")}
    assert all(r.query.owner == 3 and r.query.owner_is == "equal" for found in drawn.values() for r in found)
    assert all(r.event_fraction == 0.0 for found in drawn.values() for r in found)
    assert [sum(r.count for r in found) for found in drawn.values()] == [config.world_model.batch // 2] * 2
    beginning = start_batch(config, model.spec, 2, 100)
    old = [r for r in (*beginning.sp, *beginning.xp) if r.pool == OLD and r.count]
    assert [(r.query.kind, r.events) for r in old] == [(Kind.SP, ())], "neither random play nor chosen moments"
