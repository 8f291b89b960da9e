"""Imagined trajectories.

Alignment (H the horizon):

    t           0           1                 H
    latents    (h,z)_0 --- (h,z)_1 --- ... --- (h,z)_H
    actions         a_0         a_1   ...
    reward          r_1         r_2   ...  r_H      what arriving in (h,z)_{t+1} earned, stored in row t
    running    1         c_1      c_1 c_2  ...      probability that the episode still runs in row t
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from popgen.methods.xpm_wm.latents import Latent
from popgen.methods.xpm_wm.world_model import WorldModel

JointActor = Callable[[Latent], Tensor]
"""Joint actions (B, P) int64 for a batch of model states."""


@dataclass(frozen=True)
class Imagined:
    """latent: h (H + 1, B, D), z (H + 1, B, C * G); actions (H, B, P); reward, keep, running (H, B)."""

    latent: Latent
    actions: Tensor
    reward: Tensor
    keep: Tensor
    running: Tensor

    def of_columns(self, columns: slice) -> Imagined:
        """Part of the batch."""
        return Imagined(
            Latent(self.latent.h[:, columns], self.latent.z[:, columns]),
            self.actions[:, columns],
            self.reward[:, columns],
            self.keep[:, columns],
            self.running[:, columns],
        )


class Paid(NamedTuple):
    """What arriving in states (H, B) earned, and the probability that the episode goes on from them."""

    reward: Tensor
    keep: Tensor


Pay = Callable[[WorldModel, Latent], Paid]


def expected_pay(model: WorldModel, arrived: Latent) -> Paid:
    """As the world model predicts it."""
    return Paid(model.reward(arrived).float(), model.continuation(arrived).float())


@torch.no_grad()
def imagine(
    model: WorldModel,
    act: JointActor,
    start: Latent,
    horizon: int,
    generator: torch.Generator | None = None,
    pay: Pay = expected_pay,
) -> Imagined:
    """Roll the prior forward for `horizon` steps from start (B, .) with the joint policy `act`."""
    states, actions = [start], []
    for _ in range(horizon):
        joint = act(states[-1])
        actions.append(joint)
        states.append(model.step(states[-1], joint, generator))
    latent = Latent(torch.stack([s.h for s in states]), torch.stack([s.z for s in states]))
    reward, keep = pay(model, latent[1:])
    running = torch.cat([torch.ones_like(keep[:1]), keep[:-1]]).cumprod(0)
    return Imagined(latent, torch.stack(actions), reward, keep, running)
