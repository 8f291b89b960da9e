"""Networks of ego agents: an encoder of one seat's view, a memory, an actor, and for two levels a choice of z."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from popgen.envs.contract import EnvSpec

KERNELS = (5, 3, 3)
"""Of the convolutions that HiPT publishes."""

SKILL_SPREAD = 0.3
"""Of the first biases of z in the actor's hidden layer. At 1 they outweigh the memory, and each z is a policy that has
to be learned almost by itself."""


@dataclass(frozen=True)
class EgoSizes:
    """What decides an ego's networks.

    Attributes:
        network: `features_gru` or `conv_lstm`.
        units: of the linear layers and the memory.
        channels: of the convolutions, if there are any.
        head_units: of the actor's hidden layer.
        skills: number of z, 0 for one level.
    """

    network: str = "features_gru"
    units: int = 128
    channels: int = 26
    head_units: int = 64
    skills: int = 0

    @property
    def view(self) -> str:
        """Name of the view that the network reads."""
        return "lossless" if self.network == "conv_lstm" else "features"

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


class Remembered(NamedTuple):
    """What the memory gives: outputs (T, R, U) and its state after the last step (R, S)."""

    outputs: Tensor
    state: Tensor


class EgoNet(nn.Module):
    """Encoder, memory and heads; rows are single seats, time is the first dimension.

    Args:
        sizes: of the layers.
        spec: of the environment.

    Raises:
        ValueError: an unknown network, or an environment without its view.
    """

    largest: Tensor

    def __init__(self, sizes: EgoSizes, spec: EnvSpec) -> None:
        super().__init__()
        if sizes.network not in ("features_gru", "conv_lstm"):
            raise ValueError(f"unknown network {sizes.network!r}")
        if sizes.view not in spec.views:
            raise ValueError(f"the environment has no view {sizes.view!r}")
        self.sizes, self.actions, self.players = sizes, spec.num_actions, spec.num_players
        view, units = spec.views[sizes.view], sizes.units
        self.shape = view.shape
        maxima = view.maxima if view.maxima else (view.scale,)
        self.register_buffer("largest", torch.tensor(maxima, dtype=torch.float32), persistent=False)
        self.scaled = any(largest != 1.0 for largest in maxima)
        self.convolutions = nn.ModuleList()
        inputs = math.prod(view.shape)
        if sizes.network == "conv_lstm":
            planes = view.shape[-1]
            for kernel in KERNELS:
                self.convolutions.append(nn.Conv2d(planes, sizes.channels, kernel, padding=kernel // 2))
                planes = sizes.channels
            inputs = math.prod(view.shape[:-1]) * planes
        self.first = nn.Linear(inputs + self.extras, units)
        self.second = nn.Linear(units, units)
        self.memory = (nn.LSTM if sizes.network == "conv_lstm" else nn.GRU)(units, units)
        self.hidden = nn.Linear(units, sizes.head_units)
        self.skill_bias = nn.Parameter(torch.zeros(max(sizes.skills, 1), sizes.head_units))
        self.action = nn.Linear(sizes.head_units, self.actions)
        self.skill = nn.Linear(units, sizes.skills) if sizes.skills else None
        self._initialise()

    def _initialise(self) -> None:
        """Orthogonal layers of gain sqrt(2), nearly uniform first actions and choices, zs that differ from each
        other from the start."""
        for layer in (*self.convolutions, self.first, self.second, self.hidden):
            weight, bias = layer.get_parameter("weight"), layer.get_parameter("bias")
            nn.init.orthogonal_(weight, math.sqrt(2.0))
            nn.init.zeros_(bias)
        for head in [self.action] + ([] if self.skill is None else [self.skill]):
            nn.init.orthogonal_(head.weight, 0.01)
            nn.init.zeros_(head.bias)
        if self.sizes.skills:
            nn.init.normal_(self.skill_bias, std=SKILL_SPREAD)

    @property
    def extras(self) -> int:
        """Inputs beside the view: the seat, and both players' previous actions."""
        return self.players + 2 * self.actions

    @property
    def state_size(self) -> int:
        """Numbers of one row's memory: an LSTM has two states."""
        return self.sizes.units * (2 if isinstance(self.memory, nn.LSTM) else 1)

    def make_extras(
        self,
        seat: Int[Tensor, "*rows"],
        own: Int[Tensor, "*rows"],
        other: Int[Tensor, "*rows"],
        is_first: Bool[Tensor, "*rows"],
    ) -> Float[Tensor, "*rows X"]:
        """Seat and previous actions as one-hot numbers; there is no previous action where `is_first`."""
        keep = (~is_first).float().unsqueeze(-1)
        before = (F.one_hot(action, self.actions) * keep for action in (own, other))
        return torch.cat([F.one_hot(seat, self.players).float(), *before], -1)

    def encode(self, obs: Shaped[Tensor, "R ..."], extras: Float[Tensor, "R X"]) -> Float[Tensor, "R U"]:
        """One seat's view and what goes with it."""
        values = obs.float()
        if self.scaled:
            values = values / self.largest
        if len(self.convolutions):
            values = values.permute(0, 3, 1, 2)
            for convolution in self.convolutions:
                values = F.leaky_relu(convolution(values))
        values = F.leaky_relu(self.first(torch.cat([values.flatten(1), extras], -1)))
        return F.leaky_relu(self.second(values))

    def remember(
        self, encoded: Float[Tensor, "T R U"], state: Float[Tensor, "R S"], is_first: Bool[Tensor, "T R"]
    ) -> Remembered:
        """Run the memory over T steps; a row forgets everything before each step where `is_first`.

        Between two steps at which any row begins anew all rows are one call.
        """
        starts = [t for t, anew in enumerate(is_first.any(1).tolist()) if anew or t == 0]
        outputs: list[Tensor] = []
        for begin, end in zip(starts, [*starts[1:], len(encoded)], strict=True):
            state = state * (~is_first[begin]).to(state.dtype).unsqueeze(-1)
            output, state = self._advance(encoded[begin:end], state)
            outputs.append(output)
        return Remembered(outputs[0] if len(outputs) == 1 else torch.cat(outputs), state)

    def _advance(self, encoded: Tensor, state: Tensor) -> Remembered:
        if isinstance(self.memory, nn.LSTM):
            before = tuple(part.contiguous().unsqueeze(0) for part in state.chunk(2, -1))
            output, (hidden, cell) = self.memory(encoded, before)
            return Remembered(output, torch.cat([hidden, cell], -1).squeeze(0))
        output, hidden = self.memory(encoded, state.unsqueeze(0))
        return Remembered(output, hidden.squeeze(0))

    def action_logits(
        self, memory: Float[Tensor, "*rows U"], skill: Int[Tensor, "*rows"] | None = None
    ) -> Float[Tensor, "*rows A"]:
        """Of the actions, under a z where there are two levels."""
        bias = self.skill_bias[0]
        if skill is not None:  # a product, since the gradient of an index is slow
            bias = F.one_hot(skill, len(self.skill_bias)).to(memory.dtype) @ self.skill_bias
        return self.action(F.leaky_relu(self.hidden(memory) + bias))

    def logits_by_skill(self, memory: Float[Tensor, "*rows U"]) -> Float[Tensor, "*rows K A"]:
        """Of the actions, under every z."""
        return self.action(F.leaky_relu(self.hidden(memory).unsqueeze(-2) + self.skill_bias))

    def skill_logits(self, memory: Float[Tensor, "*rows U"]) -> Float[Tensor, "*rows K"]:
        """Of the choice of z.

        Raises:
            RuntimeError: the network has one level.
        """
        if self.skill is None:
            raise RuntimeError("a network of one level chooses no z")
        return self.skill(memory)


def build_network(sizes: EgoSizes, spec: EnvSpec, seed: int) -> EgoNet:
    """A network with initial weights of a seed; the global generator is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return EgoNet(sizes, spec)
