"""Trajectories of batched environments or of exact simulation, and what critics make of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from popgen.losses.policy_losses import gae

Values = Callable[[Tensor, Tensor], Tensor]
"""What all seats see (R, P, *view.shape) in columns (R,) int64 -> expected returns (R,)."""


@dataclass(frozen=True)
class Trajectories:
    """T steps of N columns; a column holds trajectories one after the other.

    Attributes:
        obs: (T + 1, N, P, *view.shape) in the view's dtype, what each seat sees; row T is what follows the last step.
        cut_at: (K, 2) int64, step and column of every trajectory that was cut, which bootstraps.
        cut_obs: (K, P, *view.shape), the observation that it led to.
        actions, log_prob: (T, N, P), of the actions under the policies that took them.
        reward: (T, N) float32, the joint training reward.
        terminated, cut: (T, N) bool.
    """

    obs: Tensor
    cut_at: Tensor
    cut_obs: Tensor
    actions: Tensor
    log_prob: Tensor
    reward: Tensor
    terminated: Tensor
    cut: Tensor

    @property
    def steps(self) -> int:
        """Steps of all columns: T * N."""
        return self.reward.numel()

    def of_columns(self, columns: slice) -> Trajectories:
        """Those of some columns, which are counted from 0 again."""
        inside = (self.cut_at[:, 1] >= columns.start) & (self.cut_at[:, 1] < columns.stop)
        return Trajectories(
            obs=self.obs[:, columns],
            cut_at=self.cut_at[inside] - torch.tensor([0, columns.start]),
            cut_obs=self.cut_obs[inside],
            actions=self.actions[:, columns],
            log_prob=self.log_prob[:, columns],
            reward=self.reward[:, columns],
            terminated=self.terminated[:, columns],
            cut=self.cut[:, columns],
        )


class Estimates(NamedTuple):
    """Advantages and lambda-returns of the steps, (T, N) each."""

    advantage: Float[Tensor, "T N"]
    returns: Float[Tensor, "T N"]


@torch.no_grad()
def estimate_advantages(played: Trajectories, value: Values, *, discount: float, lam: float) -> Estimates:
    """GAE of the joint reward under one critic (paper, appendix D.1).

    A terminated trajectory has no value after its last step. One that was cut has: the critic's value of the
    observation that it led to, which enters as discount * v in its last reward. No advantage flows from a trajectory
    into the one before it in its column.
    """
    time, count = played.reward.shape
    columns = torch.arange(count)
    values = value(played.obs.flatten(0, 1), columns.repeat(time + 1)).view(time + 1, count)
    reward = played.reward.clone()
    if len(played.cut_at):
        rows, where = played.cut_at.unbind(-1)
        reward[rows, where] += discount * value(played.cut_obs, where)
    continues: Bool[Tensor, "T N"] = ~(played.cut | played.terminated)
    advantage = gae(reward, values, discount * continues.float(), lam)
    return Estimates(advantage, advantage + values[:-1])
