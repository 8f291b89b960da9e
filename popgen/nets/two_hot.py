"""Scalars as a categorical over symlog-spaced bins (DreamerV3's two-hot critic)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class TwoHot(nn.Module):
    """Bins at symexp of an even grid over [-limit, limit]; exactly antisymmetric, so flat logits mean 0.

    An odd number of bins keeps one at 0. `limit` is in symlog units: 7 covers returns of about +-1,100.
    """

    bins: Tensor

    def __init__(self, bins: int, limit: float = 7.0) -> None:
        super().__init__()
        half = torch.expm1(torch.linspace(0.0, limit, bins // 2 + 1))[1:]
        middle = torch.zeros(bins % 2)
        self.register_buffer("bins", torch.cat([-half.flip(0), middle, half]), persistent=False)

    def mean(self, logits: Float[Tensor, "*batch K"]) -> Float[Tensor, "*batch"]:
        """The expected value."""
        return (torch.softmax(logits.float(), -1) * self.bins).sum(-1)

    def loss(self, logits: Float[Tensor, "*batch K"], target: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Cross-entropy (...) of the two-hot encoding of `target` (...) under logits (..., K)."""
        bins = self.bins
        target = target.detach().clamp(float(bins[0]), float(bins[-1])).contiguous()
        above = torch.searchsorted(bins, target).clamp(1, len(bins) - 1)
        low, high = bins[above - 1], bins[above]
        weight = (target - low) / (high - low)
        log_probs = torch.log_softmax(logits, -1)
        below_log = log_probs.gather(-1, (above - 1).unsqueeze(-1)).squeeze(-1)
        above_log = log_probs.gather(-1, above.unsqueeze(-1)).squeeze(-1)
        return -((1.0 - weight) * below_log + weight * above_log)
