"""A policy without memory: one network for all seats, on the seat's own observation and its number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import nn

from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.nets.blocks import draw_by_multinomial
from popgen.nets.feed_forward import FeedForwardNet, Sizes
from popgen.nets.weights import load_weights, weights_of
from popgen.policies.portable_program import Program, ProgramWriter
from popgen.types import check, check_reset


class FeedForwardSeat(nn.Module):
    """A feed-forward policy's step in one seat, without memory (`popgen.play.stacked_partners.Stackable`)."""

    seats: torch.Tensor

    def __init__(self, net: nn.Module, players: int) -> None:
        super().__init__()
        self.net = net
        self.register_buffer("seats", torch.eye(players), persistent=False)

    def forward(
        self,
        memory: torch.Tensor,
        obs: torch.Tensor,
        previous_actions: torch.Tensor,
        is_first: torch.Tensor,
        seat: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Memory (R, 0), obs (R, P, *shape), seats (R,) -> action logits (R, A) and the memory."""
        index = seat.view(-1, *[1] * (obs.dim() - 1)).expand(-1, 1, *obs.shape[2:])
        return self.net(obs.gather(1, index).squeeze(1), self.seats[seat]), memory


class FeedForwardPolicy:
    """One network for all seats, on the seat's own observation and its one-hot number.

    A multi-layer perceptron on a flat view; with `kernels`, convolutions before it on a grid view.

    Args:
        view: the view it reads; entries are divided by their largest values.
        num_actions: A.
        num_players: P.
        units, layers, activation: of the fully connected hidden layers.
        kernels, channels: of the convolutions; none for a flat view.
        name: the view's name in the environment.
        greedy: take the likeliest action instead of drawing one.
        seed: of the initial weights (PyTorch's default initialisation).

    Raises:
        ValueError: kernels and a flat view, or a grid without kernels.
    """

    kind: ClassVar[str] = "feed_forward"

    def __init__(
        self,
        view: ViewSpec,
        num_actions: int,
        num_players: int = 2,
        *,
        units: int = 128,
        layers: int = 2,
        activation: str = "tanh",
        kernels: Sequence[int] = (),
        channels: int = 32,
        name: str = "features",
        greedy: bool = False,
        seed: int = 0,
    ) -> None:
        self.view, self.greedy = name, bool(greedy)
        self.sizes = Sizes(int(units), int(layers), activation, tuple(int(kernel) for kernel in kernels), int(channels))
        self._players, self._shape = num_players, view.shape
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.net = FeedForwardNet(view, num_actions, num_players, self.sizes)
        self._generator = torch.Generator().manual_seed(0)
        self._batch: int | None = None

    def __repr__(self) -> str:
        return f"<FeedForwardPolicy on {self.view!r}, {sum(p.numel() for p in self.net.parameters()):,} weights>"

    def reset(self, batch: int, seed: int) -> None:
        """Restart the generator; there is no memory."""
        self._generator.manual_seed(seed)
        self._batch = batch

    def logits(self, obs: torch.Tensor) -> torch.Tensor:
        """Action logits (B, P, A) of joint observations (B, P, *view.shape)."""
        seats = torch.eye(self._players).repeat(obs.shape[0], 1)
        return self.net(obs.flatten(0, 1), seats).unflatten(0, obs.shape[:2])

    @torch.inference_mode()
    def act(self, obs: np.ndarray, previous_actions: np.ndarray, is_first: np.ndarray) -> np.ndarray:
        """See `Policy.act`."""
        check(obs, (None, self._players, *self._shape), "obs")
        check_reset(self._batch, len(obs))
        logits = self.logits(torch.from_numpy(np.ascontiguousarray(obs)))
        if self.greedy:
            return logits.argmax(-1).numpy().astype(np.uint8)
        return draw_by_multinomial(logits, self._generator).numpy().astype(np.uint8)

    @property
    def memory_size(self) -> int:
        """There is no memory; see `popgen.play.stacked_partners.Stackable`."""
        return 0

    def seat_network(self) -> nn.Module | None:
        """See `popgen.play.stacked_partners.Stackable`; a greedy policy draws no actions."""
        return None if self.greedy else FeedForwardSeat(self.net, self._players)

    def to_program(self) -> Program:
        """See `popgen.policies.portable_program.Portable`."""
        if self.view != "features":
            raise ValueError(f"it reads the view {self.view!r}, programs read 'features'")
        writer = ProgramWriter()
        return writer.finish(self._write_logits(writer), greedy=self.greedy)

    def _write_logits(self, writer: ProgramWriter) -> str:
        return writer.add_layers(self.net, writer.add_operation("join", ("obs", "seat")))

    def config(self) -> dict[str, Any]:
        """Sizes, the view's name and the way to pick an action."""
        named = {} if self.view == "features" else {"name": self.view}
        return {**self.sizes.as_dict(), **named, "greedy": self.greedy}

    def weights(self) -> dict[str, np.ndarray]:
        """The network's parameters."""
        return weights_of(self.net)

    def load(self, weights: Mapping[str, np.ndarray]) -> None:
        """Load `weights()` of a policy of the same sizes; raises ValueError for others."""
        load_weights(self.net, weights)

    @classmethod
    def from_parts(cls, config: Mapping[str, Any], weights: Mapping[str, np.ndarray], spec: EnvSpec) -> Self:
        """See `Policy.from_parts`."""
        name = config.get("name", "features")
        if name not in spec.views:
            raise ValueError(f"the environment has no view {name!r}")
        policy = cls(spec.views[name], spec.num_actions, spec.num_players, **config)
        policy.load(weights)
        return policy
