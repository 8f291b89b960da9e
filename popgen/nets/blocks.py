"""Building blocks of networks: layers, convolutions, draws of actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

ACTIVATIONS: dict[str, type[nn.Module]] = {"silu": nn.SiLU, "leaky_relu": nn.LeakyReLU}


def linear(inputs: int, outputs: int, *, scale: float = 1.0) -> nn.Linear:
    """Linear layer, zero bias, normal weights of variance scale / fan-average cut at two deviations (DreamerV3)."""
    layer = nn.Linear(inputs, outputs)
    if scale == 0.0:
        nn.init.zeros_(layer.weight)
    else:
        deviation = math.sqrt(2.0 * scale / (inputs + outputs))
        nn.init.trunc_normal_(layer.weight, std=deviation, a=-2 * deviation, b=2 * deviation)
    nn.init.zeros_(layer.bias)
    return layer


def mlp(
    inputs: int,
    outputs: int | None,
    *,
    units: int,
    layers: int,
    activation: str,
    norm: bool,
    output_scale: float = 1.0,
) -> nn.Sequential:
    """`layers` hidden layers of `units`, each Linear (+ LayerNorm) + activation, then a linear output if asked."""
    parts: list[nn.Module] = []
    for index in range(layers):
        parts.append(linear(inputs if index == 0 else units, units))
        if norm:
            parts.append(nn.LayerNorm(units, eps=1e-3))
        parts.append(ACTIVATIONS[activation]())
    if outputs is not None:
        parts.append(linear(units if layers else inputs, outputs, scale=output_scale))
    return nn.Sequential(*parts)


def _make_convolution(
    kind: type[nn.Conv2d] | type[nn.ConvTranspose2d],
    inputs: int,
    outputs: int,
    kernel: int,
    *,
    bias: bool = True,
) -> nn.Module:
    """Same-padded convolution with the initial weights of `linear`: default ones let the signal fade."""
    layer = kind(inputs, outputs, kernel, padding=kernel // 2, bias=bias)
    deviation = math.sqrt(2.0 / ((inputs + outputs) * kernel**2))
    nn.init.trunc_normal_(layer.weight, std=deviation, a=-2 * deviation, b=2 * deviation)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


def _after_conv(channels: int, activation: str, norm: bool) -> list[nn.Module]:
    return [*([nn.GroupNorm(1, channels, eps=1e-3)] if norm else []), ACTIVATIONS[activation]()]


class ConvEncoder(nn.Module):
    """Same-padded convolutions over a grid view, then flat. (B, W, H, K) -> (B, features)."""

    def __init__(
        self, shape: Sequence[int], *, channels: int, kernels: Sequence[int], activation: str, norm: bool
    ) -> None:
        super().__init__()
        width, height, planes = shape
        parts: list[nn.Module] = []
        for kernel in kernels:
            parts += [_make_convolution(nn.Conv2d, planes, channels, kernel), *_after_conv(channels, activation, norm)]
            planes = channels
        self.layers = nn.Sequential(*parts)
        self.features = channels * width * height

    def forward(self, grid: Tensor) -> Tensor:
        """(B, W, H, K) -> (B, features)."""
        return self.layers(grid.permute(0, 3, 1, 2)).flatten(1)


class ConvDecoder(nn.Module):
    """Transposed convolutions back to a grid view. (B, inputs) -> (B, W, H, K).

    The bias of the output is of its own for every cell, since walls and dispensers never move.
    """

    def __init__(
        self,
        inputs: int,
        shape: Sequence[int],
        *,
        channels: int,
        kernels: Sequence[int],
        activation: str,
        norm: bool,
    ) -> None:
        super().__init__()
        self.width, self.height, planes = shape
        self.channels = channels
        self.expand = linear(inputs, channels * self.width * self.height)
        parts: list[nn.Module] = []
        for index, kernel in enumerate(reversed(kernels)):
            last = index == len(kernels) - 1
            parts += _after_conv(channels, activation, norm)
            parts.append(
                _make_convolution(nn.ConvTranspose2d, channels, planes if last else channels, kernel, bias=not last)
            )
        self.layers = nn.Sequential(*parts)
        self.bias = nn.Parameter(torch.zeros(self.width, self.height, planes))

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs) -> (B, W, H, K)."""
        grid = self.expand(features).unflatten(-1, (self.channels, self.width, self.height))
        return self.layers(grid).permute(0, 2, 3, 1) + self.bias


# ---- draws of actions ------------------------------------------------------------------------------------------------


class DrawnActions(NamedTuple):
    """Actions and their log-probabilities, of the same shape."""

    action: Tensor
    log_prob: Tensor


def draw_by_gumbel(logits: Float[Tensor, "*batch A"], generator: torch.Generator) -> DrawnActions:
    """The largest of log p plus Gumbel noise, with its log-probability: no sum over actions, the fastest for the many
    rows of a batch of simulators."""
    log_probs = torch.log_softmax(logits, -1)
    noise = torch.empty_like(log_probs).exponential_(generator=generator).log_()
    actions = (log_probs - noise).argmax(-1, keepdim=True)
    return DrawnActions(actions.squeeze(-1), log_probs.gather(-1, actions).squeeze(-1))


def draw_by_multinomial(logits: Float[Tensor, "*batch A"], generator: torch.Generator) -> Int[Tensor, "*batch"]:
    """By `torch.multinomial`; what archived feed-forward members act with."""
    drawn = torch.multinomial(logits.flatten(0, -2).softmax(-1), 1, generator=generator)
    return drawn.view(logits.shape[:-1])
