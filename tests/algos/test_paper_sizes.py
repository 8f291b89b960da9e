"""The networks that `scale=paper` builds, against the paper's table of XPM-WM hyper-parameters."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from popgen.algos.xpm_wm.agent_learner import AgentLearner
from popgen.cli import compose
from popgen.config import RunConfig
from popgen.envs import make_env
from popgen.world_model.model import WorldModel


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


def test_agent(config: RunConfig, model: WorldModel) -> None:
    agent = AgentLearner(config.agent, config.world_model, model.spec, member=1, seed=0)
    assert hidden(agent.actor.net) == hidden(agent.critics["0"].net) == [512] * 5
    rates = [group["lr"] for group in (*agent.actor_optimiser.param_groups, *agent.critic_optimiser.param_groups)]
    assert rates == [4e-5, 1e-4]
    assert (agent.config.horizon, agent.config.entropy, agent.config.lambda_xp) == (15, 0.03, 0.25)
