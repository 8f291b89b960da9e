"""A variational autoencoder of one flat view (Kingma and Welling 2013), for the paper's shared-encoder ablation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from popgen.envs.contract import ViewSpec
from popgen.nets.feed_forward import FeedForwardNet, Sizes

_LIMIT = 10.0  # of the log-variance, so that its exponential stays finite


def latent_view(latent: int) -> ViewSpec:
    """The view that a network has which reads `latent` numbers instead of an observation; they are of no player."""
    return ViewSpec(shape=(latent,), dtype="float32", binary=False, swap=tuple(range(latent)))


class Vae(nn.Module):
    """q(z | o) = N(mean, exp(log variance)) and p(o | z), Bernoulli for a binary view, else Gaussian.

    An observation of a fully observed task holds both players, so that one player's view is the joint observation.
    """

    def __init__(self, view: ViewSpec, latent: int, sizes: Sizes, seed: int) -> None:
        super().__init__()
        self.latent, self.binary, self.scale = latent, view.binary, float(view.scale)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.encoder = FeedForwardNet(view, 2 * latent, 0, sizes)
            self.decoder = FeedForwardNet(latent_view(latent), view.shape[0], 0, sizes)

    def encode(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance (R, Z) of observations (R, F)."""
        mean, log_variance = self.encoder(obs, obs.new_zeros(len(obs), 0)).chunk(2, -1)
        return mean, log_variance.clamp(-_LIMIT, _LIMIT)

    def decode(self, latent: Tensor) -> Tensor:
        """Logits or means (R, F), the latter as shares of the view's scale, of latents (R, Z)."""
        return self.decoder(latent, latent.new_zeros(len(latent), 0))

    def target(self, obs: Tensor) -> Tensor:
        """Observations on the scale of `decode`."""
        return obs.float() / self.scale
