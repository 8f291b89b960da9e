"""What one update learns from: imagined model states, the member's actions there, and what came of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from popgen.methods.xpm_wm.imagination import Imagined
from popgen.methods.xpm_wm.latents import Latent


@dataclass(frozen=True)
class Samples:
    """R imagined states of one pair of policies; no gradient flows into them.

    key: of the critic that learns from them.
    latent: (R, .), seat: (R,) int64, what that critic sees; returns: (R,), its targets.
    seats, actions: (R, K) int64, where the member sat and what it did: K is 2 in self-play, 1 in cross-play.
    advantage: (R,), with the objective's sign, weight and unit.
    running: (R,), probability that the imagined episode still runs.
    entropy_scale: of the bonus in these states.
    log_prob: (R, K), of the actions under the policy that took them; None where one step is taken on the whole batch.
    """

    key: int
    latent: Latent
    seat: Tensor
    returns: Tensor
    seats: Tensor
    actions: Tensor
    advantage: Tensor
    running: Tensor
    entropy_scale: float
    log_prob: Tensor | None = None

    @staticmethod
    def from_imagined(
        imagined: Imagined, key: int, seats: Tensor, returns: Tensor, advantage: Tensor, entropy_scale: float
    ) -> Samples:
        """Trajectories (H, B) in one row each: `seats` (B, K) int64 are the member's, the critic is told the first."""
        steps, batch = imagined.reward.shape
        seats = seats.expand(steps, batch, -1)
        latent, actions = imagined.latent[:-1], imagined.actions.gather(-1, seats)
        return Samples(
            key=key,
            latent=Latent(latent.h.flatten(0, 1), latent.z.flatten(0, 1)),
            seat=seats[..., 0].flatten(0, 1),
            returns=returns.flatten(0, 1),
            seats=seats.flatten(0, 1),
            actions=actions.flatten(0, 1),
            advantage=advantage.flatten(0, 1),
            running=imagined.running.flatten(0, 1),
            entropy_scale=entropy_scale,
        )

    def __len__(self) -> int:
        return len(self.returns)

    def __getitem__(self, rows: Tensor) -> Samples:
        return replace(
            self,
            latent=self.latent[rows],
            seat=self.seat[rows],
            returns=self.returns[rows],
            seats=self.seats[rows],
            actions=self.actions[rows],
            advantage=self.advantage[rows],
            running=self.running[rows],
            log_prob=None if self.log_prob is None else self.log_prob[rows],
        )

    def minibatches(self, parts: int, generator: torch.Generator) -> list[Samples]:
        """All rows in random order in so many parts; as they are if that is one."""
        if parts == 1:
            return [self]
        order = torch.randperm(len(self), generator=generator, device=self.returns.device)
        return [self[rows] for rows in torch.tensor_split(order, parts)]
