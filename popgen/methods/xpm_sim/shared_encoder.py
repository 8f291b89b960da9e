"""The encoder that all members share in the paper's ablation "Effect of World Model as a Dynamics Model".

A variational autoencoder of the joint observation, trained on buffered real states. Actor and critics see its latent
and teach it nothing; a finished member keeps the encoder as it was.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import EnvSpec
from popgen.losses.autoencoder import elbo_terms
from popgen.methods.xpm_sim.config import XpmSimConfig
from popgen.methods.xpm_sim.simulation_starts import StartStates
from popgen.methods.xpm_sim.vae import Vae
from popgen.nets import weights as w
from popgen.nets.feed_forward import Sizes


class SharedEncoder:
    """The autoencoder, its optimiser and its generators during one member's training.

    Args:
        member: from 2 on it learns at `encoder_lr_later`, and not at all where that is 0.
        seed: of fresh weights and of the draws.
    """

    def __init__(self, config: XpmSimConfig, spec: EnvSpec, member: int, seed: int) -> None:
        self.config = config
        self.rate = config.encoder_lr if member == 1 else config.encoder_lr_later
        sizes = Sizes(config.encoder_units, config.encoder_layers, config.activation)
        self.vae = Vae(spec.views["features"], config.latent, sizes, seed)
        self.optimiser = torch.optim.Adam(self.vae.parameters(), lr=self.rate or config.encoder_lr)
        self.rng, self.generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)

    @torch.no_grad()
    def latent(self, obs: Tensor) -> Tensor:
        """Means (R, Z) of observations (R, F)."""
        return self.vae.encode(obs)[0]

    def update(self, starts: StartStates) -> dict[str, float]:
        """`encoder_updates` steps on states of both buffers, seen by both players; mean terms of the loss."""
        if not self.rate:
            return {}
        totals = []
        for _ in range(self.config.encoder_updates):
            obs = starts.env.encode(starts.buffered(self.config.encoder_batch, self.rng))
            totals.append(self._step_encoder(torch.from_numpy(obs).flatten(0, 1)))
        reconstruction, divergence = np.mean(totals, axis=0)
        return {"encoder_reconstruction": float(reconstruction), "encoder_kl": float(divergence)}

    def _step_encoder(self, obs: Tensor) -> tuple[float, float]:
        vae = self.vae
        mean, log_variance = vae.encode(obs)
        noise = torch.randn(mean.shape, generator=self.generator)
        outputs = vae.decode(mean + (0.5 * log_variance).exp() * noise)
        errors, divergences = elbo_terms(outputs, vae.target(obs), mean, log_variance, binary=vae.binary)
        self.optimiser.zero_grad(set_to_none=True)
        (errors + self.config.encoder_kl * divergences).mean().backward()
        self.optimiser.step()
        return float(errors.detach().mean()), float(divergences.detach().mean())

    def state(self) -> dict[str, Any]:
        """Everything to continue from exactly here."""
        return {
            "vae": w.weights_of(self.vae),
            "optimiser": w.optimiser_state(self.optimiser),
            "rng": self.rng.bit_generator.state,
            "generator": self.generator.get_state().numpy(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from `state()`, of the member before or of this one."""
        w.load_weights(self.vae, state["vae"])
        w.load_optimiser_state(self.optimiser, state["optimiser"])
        self.rng.bit_generator.state = state["rng"]
        self.generator.set_state(torch.from_numpy(np.array(state["generator"])))
