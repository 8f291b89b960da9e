"""From simulated batches to what the losses take: actions with signed advantages, and targets of the critics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from popgen.methods.xpm_sim.simulation import SimulatedBatch
from popgen.play.trajectories import Estimates, Values, estimate_advantages


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
    def of_seats(batch: SimulatedBatch, columns: slice | Tensor, seats: Tensor, advantage: Tensor) -> Actions:
        """What the member did in one seat of each of n columns; seats (n,), advantage (T, n). Steps that belong to no
        trajectory have no weight."""
        index = torch.arange(len(batch.actions[0]))[columns]
        columns_of = (seats.expand_as(advantage), batch.actions[:, index, seats], batch.log_prob[:, index, seats])
        rows = (batch.obs[:-1, index, seats], *columns_of, advantage, batch.valid[:, columns].float())
        return Actions(*(x.flatten(0, 1) for x in rows))

    @staticmethod
    def join(parts: Sequence[WeightedActions]) -> Actions:
        """One set, in which mean(weight * x) is the sum over parts of the part's weight times its mean of x."""
        parts = [part for part in parts if len(part[0].action)]
        total = sum(len(actions.action) for actions, _ in parts)
        columns = {f.name: torch.cat([getattr(actions, f.name) for actions, _ in parts]) for f in fields(Actions)}
        scaled = [actions.weight * (weight * total / len(actions.action)) for actions, weight in parts]
        columns["weight"] = torch.cat(scaled)
        return Actions(**columns)

    def __getitem__(self, rows: Tensor) -> Actions:
        return Actions(*(getattr(self, f.name)[rows] for f in fields(Actions)))


class WeightedActions(NamedTuple):
    """Actions, and the weight of their mean in the policy loss."""

    actions: Actions
    weight: float


def batch_advantages(batch: SimulatedBatch, columns: slice, value: Values, *, discount: float, lam: float) -> Estimates:
    """GAE over some columns, both (T, n); advantages of steps of no trajectory are the others' mean."""
    estimates = estimate_advantages(batch.of_columns(columns), value, discount=discount, lam=lam)
    valid, advantage = batch.valid[:, columns], estimates.advantage
    return Estimates(torch.where(valid, advantage, advantage[valid].mean()), estimates.returns)
