"""The two levels of HiPT as functions: influence, durations, what the high level is paid, its advantages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def influence_of_skill(
    skill_logits: Float[Tensor, "*rows K"], action_logits: Float[Tensor, "*rows K A"], skill: Int[Tensor, "*rows"]
) -> Float[Tensor, "*rows"]:
    """u = KL[ pi_lo(. | h, z) || sum_z' pi_hi(z' | h) pi_lo(. | h, z') ], an estimate of the mutual information of z
    and action given the history (HiPT, section "Influence"); 0 where the action does not depend on z."""
    log_actions = torch.log_softmax(action_logits, -1)
    weights = torch.log_softmax(skill_logits, -1)
    mixture = torch.logsumexp(log_actions + weights.unsqueeze(-1), -2)
    index = skill[..., None, None].expand(*skill.shape, 1, log_actions.shape[-1])
    chosen = log_actions.gather(-2, index).squeeze(-2)
    return (chosen.exp() * (chosen - mixture)).sum(-1)


def information_of_skill(
    skill_logits: Float[Tensor, "*rows K"], action_logits: Float[Tensor, "*rows K A"]
) -> Float[Tensor, "*rows"]:
    """I(z; a | h) = sum_z pi_hi(z | h) u(z), the mean of `influence_of_skill` over the choices."""
    log_actions = torch.log_softmax(action_logits, -1)
    weights = torch.log_softmax(skill_logits, -1).unsqueeze(-1)
    mixture = torch.logsumexp(log_actions + weights, -2, keepdim=True)
    return ((log_actions + weights).exp() * (log_actions - mixture)).sum((-2, -1))


def draw_durations(count: int, least: int, most: int, generator: torch.Generator) -> Int[Tensor, " R"]:
    """Steps for which a z is kept: even over least, ..., most."""
    return torch.randint(least, most + 1, (count,), generator=generator)


@dataclass(frozen=True)
class Segments:
    """The D segments of a rollout, row after row and in order of time: a z is kept from a decision to the next one.

    Attributes:
        step, row: (D,) int64, where the segment's decision was made.
        length: (D,) int64, its steps.
        first: (D,) bool, it is the first of an episode.
        over: (D,) bool, the episode ended with it.
        last: (D,) bool, the rollout ended with it and its episode goes on.
    """

    step: np.ndarray
    row: np.ndarray
    length: np.ndarray
    first: np.ndarray
    over: np.ndarray
    last: np.ndarray


def cut_segments(decides: np.ndarray, is_first: np.ndarray, done: np.ndarray) -> Segments:
    """Segments of a rollout of T steps of R rows, (T, R) bool each.

    Args:
        decides: a z is drawn at this step: at t = 0, at each first step of an episode, and where a z has expired.
        is_first: the step is the first of an episode.
        done: the episode ended with the step.

    Raises:
        ValueError: a row without a decision at its first step, or at the first of an episode.
    """
    if not decides[0].all() or (is_first & ~decides).any():
        raise ValueError("decides: every row and every episode begins with a decision")
    time = len(decides)
    starts = np.flatnonzero(decides.T.ravel())
    ends = np.append(starts[1:], decides.size) - 1  # the next decision, or the next row's first one, comes after it
    row, step = np.divmod(starts, time)
    over = done.T.ravel()[ends]
    return Segments(
        step=step,
        row=row,
        length=ends - starts + 1,
        first=is_first.T.ravel()[starts],
        over=over,
        last=~over & (ends % time == time - 1),
    )


def pay_segments(
    segments: Segments, reward: np.ndarray, influence: np.ndarray, *, weight: float, sum_first: bool = False
) -> np.ndarray:
    """(D,) the high level's rewards: the mean over each segment's steps of r + weight u.

    Args:
        reward, influence: (T, R), r and u.
        weight: (1 - f) (c_k - 1) in HiPT's terms.
        sum_first: the sum for the first segment of an episode, which the published code has.
    """
    steps = (reward + weight * influence).T.ravel()
    starts = segments.row * len(reward) + segments.step
    total = np.add.reduceat(steps, starts)
    return np.where(segments.first & sum_first, total, total / segments.length)


def advantages_of_decisions(
    segments: Segments, reward: np.ndarray, value: np.ndarray, last_value: np.ndarray, *, discount: float, lam: float
) -> np.ndarray:
    """(D,) generalised advantages over decisions.

    An episode's end has no value for the high level, as published; where the rollout ends before it, `last_value` is
    what follows the row's last segment.

    Args:
        reward, value: (D,), of each segment.
        last_value: (R,), of each row's state after the rollout.
    """
    advantage = np.zeros(len(reward))
    following = 0.0
    for index in range(len(reward) - 1, -1, -1):
        if segments.over[index]:
            after, following = 0.0, 0.0
        elif segments.last[index]:
            after, following = float(last_value[segments.row[index]]), 0.0
        else:
            after = float(value[index + 1])
        following = reward[index] + discount * after - value[index] + discount * lam * following
        advantage[index] = following
    return advantage
