"""Rewards for acting unlike the rest of the population, added to self-play's before advantages are estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from popgen.nets.feed_forward import FeedForwardNet
from popgen.play.trajectories import Trajectories

ROWS_AT_ONCE = 8192
"""Of one forward pass."""


@dataclass(frozen=True)
class JointLogProbs:
    """What all members that learn together would have given the joint actions that one of them played.

    Attributes:
        seats: (K, T, N, P) float32, members in ascending order.
        own: row of the member that played.
        ends: (T, N) bool, the episode ends with this step.
    """

    seats: Tensor
    own: int
    ends: Tensor


class PopulationBonus(Protocol):
    """A method's reward, by its settings; it travels to RLlib's processes with the job."""

    def __call__(self, played: JointLogProbs) -> Tensor:
        """(T, N) float32, in units of the training reward."""
        ...


@torch.no_grad()
def joint_log_probs(steps: Trajectories, member: int, actors: Mapping[int, FeedForwardNet]) -> JointLogProbs:
    """Run all members' actors on a member's self-play."""
    members = sorted(actors)
    players = steps.actions.shape[-1]
    device = next(actors[member].parameters()).device
    obs = steps.obs[:-1].flatten(0, 2)
    action = steps.actions.long().reshape(-1, 1)
    seats = torch.eye(players).repeat(len(obs) // players, 1)
    rows = torch.empty(len(members), len(obs))
    for k, other in enumerate(members):
        for start in range(0, len(obs), ROWS_AT_ONCE):
            part = slice(start, start + ROWS_AT_ONCE)
            logits = actors[other](obs[part].to(device), seats[part].to(device))
            rows[k, part] = torch.log_softmax(logits, -1).cpu().gather(-1, action[part]).squeeze(-1)
    return JointLogProbs(
        rows.view(len(members), *steps.actions.shape), members.index(member), steps.terminated | steps.cut
    )
