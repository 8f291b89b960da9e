"""From rollouts to one weighted batch per member: advantages by each critic, signs and weights by kind.

    minimise  sum over kinds of  mean over that kind's rows of  surrogate(sign * weight * advantage / scale)

A row is a step of one seat that the member's present policy played. The signs are those of `losses.diversity`.
Advantages of each kind are centred; `scale` is their standard deviation or self-play's, whichever is larger. Divided by
its own alone, cross-play would keep pushing with full weight when its returns are nearly zero; by self-play's alone, it
would drown a beginner's self-play, whose returns are small beside what a trained partner earns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from popgen.envs.contract import ViewSpec
from popgen.losses.diversity import signed_advantage
from popgen.losses.returns import gae
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import critic_name
from popgen.nets.feed_forward import ValueNet, joint
from popgen.types import Kind

CHUNK = 8192
"""Rows of one forward pass without gradient."""


@dataclass(frozen=True)
class Plan:
    """What a member is trained on in one iteration: self-play, and cross-play and mixed play with one partner."""

    partner: int | None = None
    lambda_xp: float = 0.0
    lambda_mp: float = 0.0

    def sources(self, member: int) -> list[tuple[Kind, int, float]]:
        """(kind, partner, weight), self-play first."""
        found = [(Kind.SP, member, 1.0)]
        if self.partner is not None:
            found += [(Kind.XP, self.partner, self.lambda_xp), (Kind.MP, self.partner, self.lambda_mp)]
        return [source for source in found if source[2] > 0.0]


@dataclass(frozen=True)
class Trajectories:
    """Columns that one critic judges, of all rollouts side by side.

    Attributes:
        obs: (T + 1, n, P, *view.shape); final, final_at: as in `Rollout`.
        actions, log_prob: (T, n, P).
        reward, terminated, truncated: (T, n).
        trained: (T, n, P) bool, the seat was played by the member's present policy and counts.
        seat: (n,) int64, which seat of cross-play the member has; 0 where it has both.
    """

    obs: Tensor
    final_at: Tensor
    final: Tensor
    actions: Tensor
    log_prob: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    trained: Tensor
    seat: Tensor


def gather(rollouts: Sequence[Rollout], kind: Kind, member: int, partner: int) -> Trajectories | None:
    """The member's trajectories of a kind with a partner (itself in self-play); None where there are none."""
    parts, offset = [], 0
    for rollout in rollouts:
        for index, group in enumerate(rollout.groups):
            if group.kind is kind and member in group.members and group.partner_of(member) == partner:
                parts.append(_columns(rollout, index, member, offset))
                offset += group.envs
    if not parts:
        return None
    joined = {name: torch.cat([part[name] for part in parts], _SIDE.get(name, 1)) for name in parts[0]}
    return Trajectories(**joined)


_SIDE = {"final_at": 0, "final": 0, "seat": 0}


def _columns(rollout: Rollout, index: int, member: int, offset: int) -> dict[str, Tensor]:
    group, columns = rollout.groups[index], rollout.columns(index)
    own = rollout.seats[:, columns] == member
    if group.kind is not Kind.XP:  # mixed play counts from the switch on, when the member has both seats
        own = np.broadcast_to(own.all(-1, keepdims=True), own.shape)
    inside = (rollout.final_at[:, 1] >= columns.start) & (rollout.final_at[:, 1] < columns.stop)
    final_at = rollout.final_at[inside] - np.array([0, columns.start - offset])
    seat = group.members.index(member) if group.kind is Kind.XP else 0
    arrays = {
        "obs": rollout.obs[:, columns],
        "final_at": final_at,
        "final": rollout.final[inside],
        "actions": rollout.actions[:, columns],
        "log_prob": rollout.log_prob[:, columns],
        "reward": rollout.reward[:, columns],
        "terminated": rollout.terminated[:, columns],
        "truncated": rollout.truncated[:, columns],
        "trained": own,
        "seat": np.full(group.envs, seat),
    }
    return {name: torch.from_numpy(np.require(array, requirements=["C", "W"])) for name, array in arrays.items()}


def advantages(
    found: Trajectories, critic: ValueNet, view: ViewSpec, *, discount: float, lam: float
) -> tuple[Tensor, Tensor]:
    """GAE of the joint reward under one critic.

    A terminated episode has no value after its last step. One cut at the horizon has: the critic's value of the
    observation that it ended with, which enters as discount * v in its last reward: the next row is a new episode.

    Returns:
        Advantages and lambda-returns, (T, n) each.
    """
    steps, count = found.reward.shape
    seats = torch.eye(found.actions.shape[-1])
    extras = seats[found.seat]
    observed = joint(found.obs, view)
    value = _values(critic, observed.flatten(0, 1), extras.repeat(steps + 1, 1)).view(steps + 1, count)
    reward = found.reward.clone()
    if len(found.final_at):
        after = _values(critic, joint(found.final, view), extras[found.final_at[:, 1]])
        reward[found.final_at[:, 0], found.final_at[:, 1]] += discount * after
    goes_on = discount * (~(found.terminated | found.truncated)).float()
    advantage = gae(reward, value, goes_on, lam)
    return advantage, advantage + value[:-1]


@torch.no_grad()
def _values(critic: ValueNet, obs: Tensor, extras: Tensor) -> Tensor:
    """(R,), in this process's memory wherever the critic is."""
    device = critic.mean.device
    parts = zip(obs.split(CHUNK), extras.split(CHUNK), strict=True)
    return torch.cat([critic.value(o.to(device), e.to(device)).cpu() for o, e in parts])


@dataclass(frozen=True)
class CriticRows:
    """What one critic learns from: joint observations (R, ...), seats (R, P) and normalised returns (R,)."""

    obs: Tensor
    extras: Tensor
    target: Tensor

    def to(self, device: torch.device) -> CriticRows:
        """On a learner's device."""
        return CriticRows(self.obs.to(device), self.extras.to(device), self.target.to(device))


@dataclass(frozen=True)
class Batch:
    """One member's pooled rows of one iteration.

    Attributes:
        obs: (A, *view.shape); extras: (A, P) one-hot seats.
        action, log_prob: (A,), what was played and its log-probability then.
        advantage: (A,), signed, weighted and scaled.
        weight: (A,), one over the rows of its kind.
        cross: (A,) bool, cross-play.
        critics: name -> rows.
        figures: for the logs.
    """

    obs: Tensor
    extras: Tensor
    action: Tensor
    log_prob: Tensor
    advantage: Tensor
    weight: Tensor
    cross: Tensor
    critics: dict[str, CriticRows]
    figures: dict[str, float]

    def to(self, device: torch.device) -> Batch:
        """On a learner's device."""
        moved = {f.name: v.to(device) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return replace(self, **moved, critics={name: rows.to(device) for name, rows in self.critics.items()})

    def minibatches(self, parts: int, generator: torch.Generator) -> Iterator[dict[str, object]]:
        """One epoch in `parts` batches, every row once; policy rows and each critic's are shuffled on their own."""
        order = torch.randperm(len(self.action), generator=generator).tensor_split(parts)
        shuffled = {
            name: torch.randperm(len(rows.target), generator=generator).tensor_split(parts)
            for name, rows in self.critics.items()
        }
        for part, index in enumerate(order):
            batch: dict[str, object] = {name: getattr(self, name)[index] for name in _ROWS}
            batch["weight"] = self.weight[index] * parts
            batch["critics"] = {
                name: CriticRows(rows.obs[i], rows.extras[i], rows.target[i])
                for name, rows in self.critics.items()
                if len(i := shuffled[name][part])
            }
            yield batch


_ROWS = ("obs", "extras", "action", "log_prob", "advantage", "cross")


def pool(
    rollouts: Sequence[Rollout],
    member: int,
    plan: Plan,
    critics: Mapping[str, ValueNet],
    view: ViewSpec,
    *,
    discount: float,
    lam: float,
    value_decay: float,
) -> Batch | None:
    """One member's batch; None where it played no self-play (a runner was lost).

    Each critic takes its returns into its statistics.
    """
    own, parts, rows, figures = None, [], {}, {}
    for kind, partner, weight in plan.sources(member):
        found, name = gather(rollouts, kind, member, partner), critic_name(kind, partner)
        if found is None or not bool(found.trained.any()):
            continue
        critic = critics[name]
        advantage, returns = advantages(found, critic, view, discount=discount, lam=lam)
        counted = found.trained.any(-1)
        chosen = advantage[counted]
        spread = chosen.std(correction=0).clamp(min=1e-6)
        if kind is Kind.SP:
            own = spread
        if own is None:
            return None
        scale = torch.maximum(own, spread)
        centred = torch.zeros_like(advantage)
        centred[counted] = signed_advantage(kind, chosen - chosen.mean(), weight=weight, scale=scale)
        parts.append(_policy_rows(found, centred, kind))
        critic.see(returns[counted].to(critic.mean.device), value_decay)
        rows[name] = _critic_rows(found, critic, returns, counted, view)
        told = str(kind).lower()
        figures |= {
            f"{told}_reward": float(found.reward[counted].mean()),
            f"{told}_advantage_std": float(chosen.std(correction=0)),
            f"{told}_explained": _explained(chosen, returns[counted]),
        }
    if not parts:
        return None
    joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return Batch(**joined, critics=rows, figures=figures)


def _policy_rows(found: Trajectories, advantage: Tensor, kind: Kind) -> dict[str, Tensor]:
    players = found.actions.shape[-1]
    seats = torch.eye(players).expand(*found.trained.shape, players)
    count = int(found.trained.sum())
    return {
        "obs": found.obs[:-1][found.trained],
        "extras": seats[found.trained],
        "action": found.actions[found.trained].long(),
        "log_prob": found.log_prob[found.trained],
        "advantage": advantage.unsqueeze(-1).expand_as(found.trained)[found.trained],
        "weight": torch.full((count,), 1.0 / count),
        "cross": torch.full((count,), kind is Kind.XP),
    }


def _critic_rows(found: Trajectories, critic: ValueNet, returns: Tensor, counted: Tensor, view: ViewSpec) -> CriticRows:
    seats = torch.eye(found.actions.shape[-1])[found.seat].expand(*counted.shape, -1)
    target = critic.normalised(returns[counted].to(critic.mean.device))
    return CriticRows(joint(found.obs[:-1], view)[counted], seats[counted], target)


def _explained(advantage: Tensor, returns: Tensor) -> float:
    """Share of the returns' variance that the critic knew before: their advantages are its errors."""
    return float(1.0 - advantage.var(correction=0) / returns.var(correction=0).clamp(min=1e-8))
