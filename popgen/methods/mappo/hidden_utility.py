"""What a biased agent is paid in the true reward's place (HSP, Yu et al. 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

EACH_STEP = ("STAY", "MOVEMENT", "IDLE_MOVEMENT", "IDLE_INTERACT_X", "IDLE_INTERACT_EMPTY")
"""HSP's events that can happen at every step: their weights are `STEP_SHARE` of the others'."""

STEP_SHARE = 0.02


@dataclass(frozen=True)
class Utility:
    """A linear utility of what a player does, beside the true reward.

    Attributes:
        events: (F,) weight of each event that the player itself causes (`popgen.envs.player_events`).
        reward: weight of the true training reward of the team.
    """

    events: tuple[float, ...]
    reward: float = 1.0

    @property
    def is_true(self) -> bool:
        """It is the true reward and nothing else."""
        return self.reward == 1.0 and not any(self.events)

    def pay(self, reward: Tensor, events: Tensor) -> Tensor:
        """(...) what the player is paid, of the true reward (...) and its events (..., F)."""
        return self.reward * reward + events.to(reward.dtype) @ torch.tensor(self.events, dtype=reward.dtype)

    def describe(self, names: Sequence[str]) -> dict[str, float]:
        """The weights that are not 0, by event; `reward` for the true reward's."""
        weights = {name: weight for name, weight in zip(names, self.events, strict=True) if weight}
        return {**weights, "reward": self.reward}


def draw_utility(names: Sequence[str], *, spread: float, biases: int, reward: float, seed: Sequence[int]) -> Utility:
    """A utility with `biases` events weighted, each evenly from -spread to spread.

    Args:
        names: of the F events.
        spread: the largest weight; 0 gives the true reward alone, whatever is drawn.
        biases: how many events have one, at most F.
        reward: weight of the true reward.
        seed: decides the draw.
    """
    rng = np.random.default_rng(list(seed))
    chosen = rng.choice(len(names), size=min(biases, len(names)), replace=False)
    weights = np.zeros(len(names))
    weights[chosen] = rng.uniform(-spread, spread, len(chosen))
    weights[[name in EACH_STEP for name in names]] *= STEP_SHARE
    return Utility(tuple(float(weight) for weight in weights), reward)
