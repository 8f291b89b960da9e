"""From rollouts to one weighted batch per member: advantages by each critic, signs and weights by kind.

    minimise  sum over kinds of  mean over that kind's rows of  surrogate(sign * weight * advantage / scale)

A row is a step of one seat that the member's present policy played. The signs are those of `losses.policy_losses`.
Advantages of each kind are centred; `scale` is their standard deviation or self-play's, whichever is larger. Divided by
its own alone, cross-play would keep pushing with full weight when its returns are nearly zero; by self-play's alone, it
would drown a beginner's self-play, whose returns are small beside what a trained partner earns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor, nn

from popgen.envs.contract import ViewSpec
from popgen.losses.policy_losses import bound_advantage, floor_reward, signed_advantage
from popgen.methods.mappo.hidden_utility import Utility
from popgen.methods.mappo.slots import Rollout
from popgen.methods.mappo.training_job import critic_name
from popgen.nets.feed_forward import ValueNet, joint
from popgen.play.trajectories import Estimates, Trajectories, estimate_advantages
from popgen.types import Kind

CHUNK = 8192
"""Rows of one forward pass without gradient."""


@dataclass(frozen=True)
class Plan:
    """What a member is trained on in one iteration: its own play, cross-play and mixed play with one partner, and
    cross-play with `others`. Its own play is with itself unless `mate` has the other seat. `bonus` is the share of the
    job's bonus that self-play is paid."""

    partner: int | None = None
    lambda_xp: float = 0.0
    lambda_mp: float = 0.0
    xp_clip: float = 0.0
    xp_floor: float | None = None
    mate: int | None = None
    others: tuple[int, ...] = ()
    bonus: float = 1.0

    def sources(self, member: int) -> list[tuple[Kind, int, float]]:
        """(kind, partner, weight), self-play first."""
        sources = [(Kind.SP, member if self.mate is None else self.mate, 1.0)]
        if self.partner is not None:
            sources += [(Kind.XP, self.partner, self.lambda_xp), (Kind.MP, self.partner, self.lambda_mp)]
        sources += [(Kind.XP, other, self.lambda_xp) for other in self.others]
        return [source for source in sources if source[2] > 0.0]


@dataclass(frozen=True)
class MemberTrajectories:
    """Columns that one critic judges, of all rollouts side by side, with what is the member's of them.

    Attributes:
        steps: the trajectories.
        trained: (T, n, P) bool, the seat was played by the member's present policy and counts.
        seat: (n,) int64, which seat of cross-play or of a pair the member has; 0 where it has both.
        events: (T, n, F), what the member did in its seats; F = 0 where nobody counted.
        covered: (T, n), steps that each reward stands for.
    """

    steps: Trajectories
    trained: Tensor
    seat: Tensor
    events: Tensor
    covered: Tensor


def gather(rollouts: Sequence[Rollout], kind: Kind, member: int, partner: int) -> MemberTrajectories | None:
    """The member's trajectories of a kind with a partner (itself in self-play); None where there are none."""
    parts, offset = [], 0
    for rollout in rollouts:
        for index, match in enumerate(rollout.matches):
            if match.kind is kind and member in match.members and match.partner_of(member) == partner:
                parts.append(_columns_of_match(rollout, index, member, offset))
                offset += match.envs
    if not parts:
        return None
    joined = {name: torch.cat([part[name] for part in parts], _SIDE.get(name, 1)) for name in parts[0]}
    beside = {name: joined.pop(name) for name in ("trained", "seat", "events", "covered")}
    return MemberTrajectories(Trajectories(**joined), **beside)


_SIDE = {"cut_at": 0, "cut_obs": 0, "seat": 0}


def _columns_of_match(rollout: Rollout, index: int, member: int, offset: int) -> dict[str, Tensor]:
    """One match's columns, which come to stand at `offset`, as tensors."""
    match, columns = rollout.matches[index], rollout.columns(index)
    own = rollout.seats[:, columns] == member
    if match.kind is Kind.MP:  # it counts from the switch on, when the member has both seats
        own = np.broadcast_to(own.all(-1, keepdims=True), own.shape)
    inside = (rollout.cut_at[:, 1] >= columns.start) & (rollout.cut_at[:, 1] < columns.stop)
    cut_at = rollout.cut_at[inside] - np.array([0, columns.start - offset])
    seat = 0 if match.kind is Kind.MP else match.members.index(member)
    did = np.where(own[..., None], rollout.events[:, columns], 0).sum(2, dtype=np.float32)
    arrays = {
        "obs": rollout.obs[:, columns],
        "cut_at": cut_at,
        "cut_obs": rollout.cut_obs[inside],
        "actions": rollout.actions[:, columns],
        "log_prob": rollout.log_prob[:, columns],
        "reward": rollout.reward[:, columns],
        "terminated": rollout.terminated[:, columns],
        "cut": rollout.truncated[:, columns],
        "trained": own,
        "events": did,
        "covered": rollout.covered[:, columns],
        "seat": np.full(match.envs, seat),
    }
    return {name: torch.from_numpy(np.require(array, requirements=["C", "W"])) for name, array in arrays.items()}


def advantages(
    played: MemberTrajectories, critic: ValueNet, view: ViewSpec, *, discount: float, lam: float
) -> Estimates:
    """GAE of the joint reward under one critic, which sees the joint observation and the member's seat."""
    extras = torch.eye(played.steps.actions.shape[-1])[played.seat]

    def value(obs: Tensor, columns: Tensor) -> Tensor:
        return _values_in_chunks(critic, joint(obs, view).contiguous(), extras[columns])

    return estimate_advantages(played.steps, value, discount=discount, lam=lam)


@torch.no_grad()
def _values_in_chunks(critic: ValueNet, obs: Tensor, extras: Tensor) -> Tensor:
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
class PooledBatch:
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

    def to(self, device: torch.device) -> PooledBatch:
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
    critics: Mapping[str, ValueNet] | nn.ModuleDict,
    view: ViewSpec,
    *,
    discount: float,
    lam: float,
    value_decay: float,
    bonus: Callable[[Trajectories], Tensor] | None = None,
    utility: Utility | None = None,
) -> PooledBatch | None:
    """One member's batch; None where it played no self-play (a runner was lost). Each critic takes its returns into its
    statistics. `utility` pays in the reward's place, `bonus` (T, N) on top.
    """
    own, parts, rows, recorded = None, [], {}, []
    for kind, partner, weight in plan.sources(member):
        played, name = gather(rollouts, kind, member, partner), critic_name(kind, partner)
        if played is None or not bool(played.trained.any()):
            continue
        counted, label = played.trained.any(-1), str(kind).lower()
        figures = {f"{label}_reward": float(played.steps.reward[counted].mean())}
        played = _change_reward(played, kind, plan, utility, bonus, figures)
        critic = critics[name]
        assert isinstance(critic, ValueNet)
        advantage, returns = advantages(played, critic, view, discount=discount, lam=lam)
        chosen = advantage[counted]
        if kind is Kind.XP and own is not None:
            chosen = bound_advantage(chosen, clip=plan.xp_clip, unit=own)
        spread = chosen.std(correction=0).clamp(min=1e-6)
        own = spread if kind is Kind.SP else own
        if own is None:
            return None
        unit = torch.maximum(own, spread)
        centred = torch.zeros_like(advantage)
        centred[counted] = signed_advantage(kind, chosen - chosen.mean(), weight=weight, unit=unit)
        parts.append(_policy_rows(played, centred, kind))
        critic.see(returns[counted].to(critic.mean.device), value_decay)
        rows[name] = _critic_rows(played, critic, returns, counted, view)
        figures |= {
            f"{label}_advantage_std": float(chosen.std(correction=0)),
            f"{label}_explained": _explained_share(chosen, returns[counted]),
        }
        recorded.append(figures)
    if not parts:
        return None
    joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return PooledBatch(**joined, critics=rows, figures=_average_figures(recorded))


def _average_figures(recorded: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """With several partners of a kind, means over them."""
    found: dict[str, list[float]] = {}
    for figures in recorded:
        for name, value in figures.items():
            found.setdefault(name, []).append(value)
    return {name: sum(values) / len(values) for name, values in found.items()}


def _change_reward(
    played: MemberTrajectories,
    kind: Kind,
    plan: Plan,
    utility: Utility | None,
    bonus: Callable[[Trajectories], Tensor] | None,
    figures: dict[str, float],
) -> MemberTrajectories:
    """The same trajectories: self-play paid by a utility and with a bonus, where there are these, cross-play with its
    floor."""
    reward = played.steps.reward
    if kind is Kind.XP:
        reward = floor_reward(reward, played.covered, plan.xp_floor)
    if kind is Kind.SP and utility is not None:
        reward = utility.pay(reward, played.events)
        figures["utility"] = float(reward.mean())
    if kind is Kind.SP and bonus is not None:
        extra = plan.bonus * bonus(played.steps)
        figures["bonus"] = float(extra.mean())
        reward = reward + extra
    return replace(played, steps=replace(played.steps, reward=reward))


def _policy_rows(played: MemberTrajectories, advantage: Tensor, kind: Kind) -> dict[str, Tensor]:
    players = played.steps.actions.shape[-1]
    seats = torch.eye(players).expand(*played.trained.shape, players)
    count = int(played.trained.sum())
    return {
        "obs": played.steps.obs[:-1][played.trained],
        "extras": seats[played.trained],
        "action": played.steps.actions[played.trained].long(),
        "log_prob": played.steps.log_prob[played.trained],
        "advantage": advantage.unsqueeze(-1).expand_as(played.trained)[played.trained],
        "weight": torch.full((count,), 1.0 / count),
        "cross": torch.full((count,), kind is Kind.XP),
    }


def _critic_rows(
    played: MemberTrajectories, critic: ValueNet, returns: Tensor, counted: Tensor, view: ViewSpec
) -> CriticRows:
    seats = torch.eye(played.steps.actions.shape[-1])[played.seat].expand(*counted.shape, -1)
    target = critic.normalised(returns[counted].to(critic.mean.device))
    return CriticRows(joint(played.steps.obs[:-1], view)[counted], seats[counted], target)


def _explained_share(advantage: Tensor, returns: Tensor) -> float:
    """Share of the returns' variance that the critic knew before: their advantages are its errors."""
    return float(1.0 - advantage.var(correction=0) / returns.var(correction=0).clamp(min=1e-8))
