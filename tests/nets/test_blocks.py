from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from popgen.methods.xpm_wm.latent_filter import NormGRUCell
from popgen.nets.blocks import ConvDecoder, ConvEncoder, linear, mlp


def test_linear_weights_have_the_variance_of_the_fan_average() -> None:
    torch.manual_seed(0)
    layer = linear(300, 100)
    # A normal cut at two deviations has 0.774 of the variance.
    weight = layer.weight.detach()
    assert float(weight.var()) == pytest.approx(0.774 * 2 / 400, rel=0.05)
    assert float(weight.abs().max()) <= 2 * math.sqrt(2 / 400) + 1e-6
    assert not layer.bias.any() and not linear(5, 4, scale=0.0).weight.any()


def test_mlp_layers() -> None:
    net = mlp(3, 2, units=7, layers=2, activation="leaky_relu", norm=True, output_scale=0.0)
    kinds = [nn.Linear, nn.LayerNorm, nn.LeakyReLU, nn.Linear, nn.LayerNorm, nn.LeakyReLU, nn.Linear]
    assert [type(part) for part in net] == kinds
    assert [tuple(part.weight.shape) for part in net if isinstance(part, nn.Linear)] == [(7, 3), (7, 7), (2, 7)]
    assert not net(torch.randn(4, 3)).any()
    bare = mlp(3, None, units=7, layers=1, activation="silu", norm=False)
    assert [type(part) for part in bare] == [nn.Linear, nn.SiLU]


def test_gru_by_hand() -> None:
    # One unit, gates all zero: reset = 0.5, candidate = tanh(0) = 0, update = sigmoid(-1).
    cell = NormGRUCell(2, 1)
    with torch.no_grad():
        cell.gates.weight.zero_()
    hidden = torch.tensor([[3.0]])
    assert float(cell(torch.zeros(1, 2), hidden).detach()) == pytest.approx(3.0 * (1 - 1 / (1 + math.e)))
    # Layer-normalised gates: mean 0, variance 14 of (4, -5, 1) with eps 1e-3.
    with torch.no_grad():
        cell.gates.bias.copy_(torch.tensor([4.0, -5.0, 1.0]))
    reset, candidate, update = (x / math.sqrt(14.001) for x in (4.0, -5.0, 1.0))
    candidate = math.tanh(candidate / (1 + math.exp(-reset)))
    update = 1 / (1 + math.exp(1 - update))
    after = float(cell(torch.zeros(1, 2), hidden).detach())
    assert after == pytest.approx(update * candidate + (1 - update) * 3.0, rel=1e-5)


def test_every_cell_of_the_decoded_grid_has_a_bias_of_its_own() -> None:
    decoder = ConvDecoder(11, (5, 4, 6), channels=3, kernels=(5, 3), activation="silu", norm=True)
    with torch.no_grad():
        decoder.layers[-1].weight.zero_()
        decoder.bias.copy_(torch.arange(120.0).reshape(5, 4, 6))
    assert torch.equal(decoder(torch.rand(2, 11))[1], decoder.bias)


def test_convolutions_keep_the_grid() -> None:
    shape, options = (5, 4, 6), {"channels": 3, "kernels": (5, 3, 3), "activation": "silu", "norm": False}
    encoder = ConvEncoder(shape, **options)
    assert encoder(torch.rand(7, *shape)).shape == (7, encoder.features) and encoder.features == 3 * 5 * 4
    assert ConvDecoder(11, shape, **options)(torch.rand(7, 11)).shape == (7, *shape)


def test_the_convolutional_encoder_keeps_places_apart() -> None:
    torch.manual_seed(0)
    encoder = ConvEncoder((5, 4, 1), channels=2, kernels=(3,), activation="silu", norm=False)
    grid = torch.zeros(2, 5, 4, 1)
    grid[0, 0, 3], grid[1, 4, 0] = 1.0, 1.0
    features = encoder(grid).unflatten(-1, (2, 5, 4)) - encoder(torch.zeros(1, 5, 4, 1)).unflatten(-1, (2, 5, 4))
    changed = features.abs().sum(1) > 1e-6
    # Channels last (W, H) in, channels first (W, H) out: the touched cells are the neighbours of the lit one.
    assert changed[0].nonzero().tolist() == [[x, y] for x in (0, 1) for y in (2, 3)]
    assert changed[1].nonzero().tolist() == [[x, y] for x in (3, 4) for y in (0, 1)]
