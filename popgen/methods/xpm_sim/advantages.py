"""From simulated batches to what the losses take: actions with signed advantages, and targets of the critics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from popgen.losses.returns import gae
from popgen.methods.xpm_sim.simulation import Batch

Values = Callable[[Tensor, Tensor], Tensor]
"""What all seats see (R, P, *view.shape) in a group's columns (R,) int64 -> expected returns (R,)."""


@dataclass(frozen=True)
class Actions:
    """R actions of the learning member.

    obs (R, *view.shape) and seat (R,) of the actor; action (R,) int64, log_prob (R,) when it was drawn, advantage (R,)
    with the objective's sign and scale, weight (R,) in the policy loss.
    """

    obs: Tensor
    seat: Tensor
    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    weight: Tensor

    @staticmethod
    def of_seats(batch: Batch, columns: slice | Tensor, seats: Tensor, advantage: Tensor) -> Actions:
        """What the member did in one seat of each of n columns; seats (n,), advantage (T, n). Steps that belong to no
        trajectory have no weight."""
        index = torch.arange(len(batch.actions[0]))[columns]
        columns_of = (seats.expand_as(advantage), batch.actions[:, index, seats], batch.log_prob[:, index, seats])
        rows = (batch.obs[:, index, seats], *columns_of, advantage, batch.valid[:, columns].float())
        return Actions(*(x.flatten(0, 1) for x in rows))

    @staticmethod
    def join(groups: Sequence[tuple[Actions, float]]) -> Actions:
        """One set, in which mean(weight * x) is the sum over groups of the group's weight times its mean of x."""
        groups = [(part, weight) for part, weight in groups if len(part.action)]
        total = sum(len(part.action) for part, _ in groups)
        columns = {f.name: torch.cat([getattr(part, f.name) for part, _ in groups]) for f in fields(Actions)}
        columns["weight"] = torch.cat([part.weight * (weight * total / len(part.action)) for part, weight in groups])
        return Actions(**columns)

    def __getitem__(self, rows: Tensor) -> Actions:
        return Actions(*(getattr(self, f.name)[rows] for f in fields(Actions)))


@torch.no_grad()
def advantages(batch: Batch, columns: slice, value: Values, *, discount: float, lam: float) -> tuple[Tensor, Tensor]:
    """GAE over some columns (paper, appendix D.1): advantages and returns, both (T, n).

    A trajectory that was cut, and the last row, bootstrap from the critic's value of the state they led to; no
    advantage flows from a trajectory into the one before it in its column. Advantages of steps that belong to no
    trajectory are the mean of the others.
    """
    time, count = batch.reward.shape[0], columns.stop - columns.start
    obs = torch.cat([batch.obs[:, columns], batch.last_obs[None, columns]]).flatten(0, 1)
    values = value(obs, torch.arange(count).repeat(time + 1)).view(time + 1, count)
    cut = batch.cut[:, columns]
    going_on = ~(cut | batch.terminated[:, columns])
    reward = batch.reward[:, columns].clone()
    column = batch.cut.nonzero()[:, 1]
    mine = (column >= columns.start) & (column < columns.stop)
    reward[cut] += discount * value(batch.cut_obs[mine], column[mine] - columns.start)
    advantage = gae(reward, values, discount * going_on.float(), lam)
    valid = batch.valid[:, columns]
    return torch.where(valid, advantage, advantage[valid].mean()), advantage + values[:-1]
