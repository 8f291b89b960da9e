"""Feed-forward networks over one view of the environment: actors of one player's observation, critics of both."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from popgen.envs.contract import ViewSpec
from popgen.types import check

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "leaky_relu": nn.LeakyReLU}


@dataclass(frozen=True)
class Sizes:
    """Of the hidden layers: `kernels` of same-padded convolutions with `channels` each (none: a flat view), then
    `layers` fully connected ones of `units`."""

    units: int = 128
    layers: int = 2
    activation: str = "tanh"
    kernels: tuple[int, ...] = ()
    channels: int = 32

    def as_dict(self) -> dict[str, Any]:
        """JSON-able; what stands at its default is left out."""
        plain = Sizes()
        kept = {k: v for k, v in asdict(self).items() if k in ("units", "layers") or v != getattr(plain, k)}
        return kept | {"kernels": list(self.kernels)} if "kernels" in kept else kept


class FeedForwardNet(nn.Sequential):
    """Convolutions over a grid, if any; then an MLP on that, or on a flat view, beside `extras` further inputs.

    Args:
        view: what it reads; entries are divided by their largest values.
        outputs: numbers it gives.
        extras: inputs beside the observation, such as a one-hot seat.
        sizes: of the hidden layers.
        copies: observations stacked on the last dimension (2 for a joint observation).

    Raises:
        ValueError: a grid without kernels or a flat view with some, or an even kernel.
    """

    largest: Tensor

    def __init__(self, view: ViewSpec, outputs: int, extras: int, sizes: Sizes, copies: int = 1) -> None:
        grid = len(view.shape) == 3
        if grid != bool(sizes.kernels) or not grid and len(view.shape) != 1:
            wanted = "a grid view" if sizes.kernels else "a flat view"
            raise ValueError(f"a feed-forward network with kernels {list(sizes.kernels)} needs {wanted}")
        if any(kernel % 2 == 0 for kernel in sizes.kernels):
            raise ValueError(f"kernels must be odd, got {list(sizes.kernels)}")
        activation = ACTIVATIONS[sizes.activation]
        convolutions: list[nn.Module] = []
        inputs = view.shape[-1] * copies
        for kernel in sizes.kernels:
            convolutions += [nn.Conv2d(inputs, sizes.channels, kernel, padding=kernel // 2), activation()]
            inputs = sizes.channels
        inputs = inputs * math.prod(view.shape[:-1]) + extras
        hidden: list[nn.Module] = []
        for _ in range(sizes.layers):
            hidden += [nn.Linear(inputs, sizes.units), activation()]
            inputs = sizes.units
        super().__init__(*convolutions, *hidden, nn.Linear(inputs, outputs))
        self.shape = (*view.shape[:-1], view.shape[-1] * copies)
        self.grid, self.first = grid, len(convolutions)
        maxima = view.maxima * copies if view.maxima else (view.scale,)
        self.register_buffer("largest", torch.tensor(maxima, dtype=torch.float32), persistent=False)
        self.scaled = any(largest != 1.0 for largest in maxima)

    def forward(self, obs: Tensor, extras: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """obs (R, *shape) of any dtype, extras (R, X) -> (R, outputs)."""
        check(obs, (None, *self.shape), "obs")
        values = obs.float()
        if self.scaled:
            values = values / self.largest
        if self.grid:
            values = values.permute(0, 3, 1, 2)
        parts = list(self)
        for part in parts[: self.first]:
            values = part(values)
        values = torch.cat([values.flatten(1), extras], -1)
        for part in parts[self.first :]:
            values = part(values)
        return values


def orthogonal(net: FeedForwardNet, output_gain: float, generator: torch.Generator) -> None:
    """Orthogonal initial weights of gain sqrt(2) and zero biases; `output_gain` for the last layer (Andrychowicz et
    al. 2021: a small one for a policy, whose first actions are then nearly uniform)."""
    layers = [part for part in net if isinstance(part, nn.Linear | nn.Conv2d)]
    for layer in layers:
        gain = output_gain if layer is layers[-1] else math.sqrt(2.0)
        nn.init.orthogonal_(layer.weight, gain, generator=generator)
        assert layer.bias is not None
        nn.init.zeros_(layer.bias)


def joint_copies(view: ViewSpec) -> int:
    """How many players' observations make the joint one: 1 where player 1's is a permutation of player 0's."""
    return 1 if view.swap is not None else 2


def joint(obs: Tensor, view: ViewSpec) -> Tensor:
    """The joint observation (..., *shape) of both players' (..., P, *view.shape), for a centralised critic."""
    dim = obs.dim() - len(view.shape) - 1
    first = obs.select(dim, 0)
    return first if joint_copies(view) == 1 else torch.cat([first, obs.select(dim, 1)], -1)


class ReturnStatistics(NamedTuple):
    """Mean and standard deviation of returns, scalars."""

    mean: Tensor
    deviation: Tensor


class ValueNet(FeedForwardNet):
    """A critic of the joint observation that learns normalised returns: v = mean + deviation * output.

    When the statistics of the returns move, the last layer is changed so that v does not (van Hasselt et al. 2016,
    "Learning values across many orders of magnitude", PopArt).
    """

    mean: Tensor
    square: Tensor
    weight: Tensor

    def __init__(self, view: ViewSpec, extras: int, sizes: Sizes, generator: torch.Generator) -> None:
        super().__init__(view, 1, extras, sizes, joint_copies(view))
        orthogonal(self, 1.0, generator)
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("square", torch.zeros(()))
        self.register_buffer("weight", torch.zeros(()))

    def statistics(self) -> ReturnStatistics:
        """Mean and standard deviation of the returns seen so far, 0 and 1 before any."""
        if not bool(self.weight > 0):
            return ReturnStatistics(torch.zeros(()), torch.ones(()))
        mean = self.mean / self.weight
        variance = (self.square / self.weight - mean.square()).clamp(min=1e-6)
        return ReturnStatistics(mean, variance.sqrt())

    def value(self, obs: Shaped[Tensor, "R ..."], extras: Float[Tensor, "R X"]) -> Float[Tensor, " R"]:
        """Expected returns."""
        mean, deviation = self.statistics()
        return self(obs, extras).squeeze(-1) * deviation + mean

    @torch.no_grad()
    def see(self, returns: Tensor, decay: float) -> None:
        """Take returns of any shape into the moving statistics, keeping every value (but for the first returns)."""
        fresh, (mean, deviation) = not bool(self.weight > 0), self.statistics()
        self.mean.mul_(decay).add_((1.0 - decay) * returns.mean())
        self.square.mul_(decay).add_((1.0 - decay) * returns.square().mean())
        self.weight.mul_(decay).add_(1.0 - decay)
        if fresh:
            return
        new_mean, new_deviation = self.statistics()
        last = self[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(deviation / new_deviation)
        last.bias.mul_(deviation).add_(mean - new_mean).div_(new_deviation)

    def normalised(self, returns: Tensor) -> Tensor:
        """Returns on the scale of the network's output."""
        mean, deviation = self.statistics()
        return (returns - mean) / deviation
