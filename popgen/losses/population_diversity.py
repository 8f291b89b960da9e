"""How different the members of a population act: what MEP and TrajeDi pay members for. No gradient flows through it.

Members are the first dimension of `log_probs`: what each of them would have given the joint actions that one of them
played. Joint, so that the log-probabilities of the seats are added up.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LEAST_WEIGHT = 1e-7
"""Of a step in another's divergence: what the numbers can tell from nothing."""


def population_surprise(log_probs: Float[Tensor, "K *#steps"], floor: float) -> Float[Tensor, "*#steps"]:
    """-ln of the mean probability that the population gives an action (Zhao et al. 2023, maximum entropy population).

    Its expectation under the mean policy is the population's entropy. `floor` bounds the probability from below.
    """
    mean = torch.logsumexp(log_probs, 0) - math.log(log_probs.shape[0])
    return -mean.clamp(min=math.log(floor))


def trajectory_divergence(
    log_probs: Float[Tensor, "K T N"], own: int, ends: Bool[Tensor, "T N"], kernel: float
) -> Float[Tensor, "T N"]:
    """The step's part of the Jensen-Shannon divergence of trajectories (Lupu et al. 2021, eq. of JSD_gamma).

        d_k(t) = sum over t' of kernel^|t - t'| ln pi_k(a_t' | s_t')        over the steps of one episode
        b(t)   = d_own(t) - ln mean_k exp d_k(t)

    The mean of b over steps and members, each on its own trajectories, is the divergence, between 0 and ln K. With
    kernel 0 actions are compared one by one, with 1 whole episodes.

    Args:
        log_probs: (K, T, N) of the joint actions that member `own` played.
        own: row of that member.
        ends: (T, N), the episode ends with this step.
        kernel: in [0, 1].
    """
    before, after = torch.zeros_like(log_probs), torch.zeros_like(log_probs)
    for t in range(log_probs.shape[1]):
        carried = kernel * (before[:, t - 1] * ~ends[t - 1]) if t else 0.0
        before[:, t] = log_probs[:, t] + carried
    for t in reversed(range(log_probs.shape[1])):
        carried = kernel * after[:, t + 1] * ~ends[t] if t + 1 < log_probs.shape[1] else 0.0
        after[:, t] = log_probs[:, t] + carried
    return _exceed_mean(before + after - log_probs, own)


def divergence_rewards(
    log_probs: Float[Tensor, "K T N"], own: int, ends: Bool[Tensor, "T N"], kernel: float
) -> Float[Tensor, "T N"]:
    """What each step's action adds to the `trajectory_divergence` of its episode up to then.

        b_t(u)  the part of step u, by the actions up to step t alone
        r(t)    = b_t(t) + sum over u < t of [b_t(u) - b_{t-1}(u)]          over the steps of one episode

    An episode's rewards add up to its divergence. b(u) depends on actions after u too, so that returns of b itself
    would not credit them with it; the return of r from a step on lacks only what the actions before have decided, which
    makes it, undiscounted, the credit of the divergence's score-function gradient. With kernel 0, r is b. Steps whose
    weight in each other's part is below `LEAST_WEIGHT` are taken to have none.

    Args:
        log_probs, own, ends, kernel: as for `trajectory_divergence`.
    """
    steps = log_probs.shape[1]
    reach = next((lag for lag in range(steps) if kernel ** (lag + 1) < LEAST_WEIGHT), steps)
    episode = ends.cumsum(0) - ends.long()
    weighted = torch.zeros_like(log_probs)  # d_k(u), by the actions so far
    parts, rewards = torch.zeros_like(log_probs[own]), torch.zeros_like(log_probs[own])
    for t in range(steps):
        past, near = slice(max(0, t - reach), t + 1), slice(max(0, t - reach), t + reach + 1)
        weights = log_probs.new_tensor([kernel ** abs(t - u) for u in range(steps)[near]])
        weighted[:, near] += weights[:, None] * (episode[near] == episode[t]) * log_probs[:, t : t + 1]
        now = _exceed_mean(weighted[:, past], own)
        rewards[t] = (now - parts[past]).sum(0)
        parts[past] = now
    return rewards


def _exceed_mean(weighted: Float[Tensor, "K T N"], own: int) -> Float[Tensor, "T N"]:
    """How much a member's log-probabilities exceed that of the population's mean probability."""
    return weighted[own] - (torch.logsumexp(weighted, 0) - math.log(weighted.shape[0]))
