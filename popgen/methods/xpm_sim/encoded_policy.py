"""A policy without memory that acts on the latent of an encoder of the joint observation."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from popgen.envs.contract import ViewSpec
from popgen.methods.xpm_sim.vae import latent_view
from popgen.nets.feed_forward import FeedForwardNet, Sizes
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.portable_program import ProgramWriter


class EncodedNet(nn.Module):
    """The mean of an encoder's latent, then a head on it beside the seat; the encoder learns nothing from the head."""

    def __init__(self, encoder: FeedForwardNet, latent: int, outputs: int, extras: int, sizes: Sizes) -> None:
        super().__init__()
        self.encoder, self.latent = encoder, latent
        self.head = FeedForwardNet(latent_view(latent), outputs, extras, sizes)

    def forward(self, obs: Tensor, extras: Tensor) -> Tensor:
        """obs (R, F) and extras (R, X) -> (R, outputs)."""
        with torch.no_grad():
            latent = self.encoder(obs, extras[:, :0])[:, : self.latent]
        return self.head(latent, extras)


class EncodedPolicy(FeedForwardPolicy):
    """One network for all seats, on the latent of the seat's view of the joint observation and its one-hot number.

    Args:
        view, num_actions, num_players: as `FeedForwardPolicy`.
        latent: size of the encoder's latent, whose mean is taken.
        encoder_units, encoder_layers: of the encoder's hidden layers.
        others: units, layers, activation (of the encoder too), greedy and seed of `FeedForwardPolicy`.
    """

    kind: ClassVar[str] = "encoded"

    def __init__(
        self,
        view: ViewSpec,
        num_actions: int,
        num_players: int = 2,
        *,
        latent: int,
        encoder_units: int,
        encoder_layers: int,
        seed: int = 0,
        **others: Any,
    ) -> None:
        super().__init__(view, num_actions, num_players, seed=seed, **others)
        self.latent, self.encoder_units, self.encoder_layers = int(latent), int(encoder_units), int(encoder_layers)
        sizes = Sizes(self.encoder_units, self.encoder_layers, self.sizes.activation)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            encoder = FeedForwardNet(view, 2 * self.latent, 0, sizes)
            self.net = EncodedNet(encoder, self.latent, num_actions, num_players, self.sizes)

    def _write_logits(self, writer: ProgramWriter) -> str:
        *hidden, last = self.net.encoder
        assert isinstance(last, nn.Linear)
        inner = writer.add_layers(hidden, "obs")
        latent = writer.add_linear(inner, last.weight[: self.latent], last.bias[: self.latent])
        return writer.add_layers(self.net.head, writer.add_operation("join", (latent, "seat")))

    def config(self) -> dict[str, Any]:
        """Sizes of head and encoder, and the way to pick an action."""
        encoder = {"encoder_units": self.encoder_units, "encoder_layers": self.encoder_layers}
        return {**super().config(), "latent": self.latent, **encoder}
