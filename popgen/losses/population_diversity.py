"""How different the members of a population act: what MEP and TrajeDi pay members for. No gradient flows through it.

Members are the first dimension of `log_probs`: what each of them would have given the joint actions that one of them
played. Joint, so that the log-probabilities of the seats are added up.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor


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
    weighted = before + after - log_probs
    return weighted[own] - (torch.logsumexp(weighted, 0) - math.log(log_probs.shape[0]))
