"""REINFORCE on imagined trajectories with a centralised distributional critic."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


def reinforce(
    log_prob: Float[Tensor, "*rows"],
    advantage: Float[Tensor, "*#rows"],
    entropy: Float[Tensor, "*rows"],
    weight: Float[Tensor, "*#rows"],
    *,
    entropy_scale: float,
) -> Float[Tensor, ""]:
    """Policy-gradient loss, to be minimised:  -E[w (A log pi(a|z) + eta H[pi])].

    All tensors broadcast to (H, B, ...); `advantage` and `weight` carry no gradient. `weight` is the
    probability that the imagined episode still runs.
    """
    return -(weight.detach() * (advantage.detach() * log_prob + entropy_scale * entropy)).mean()


class ReturnScale(nn.Module):
    """Moving range between two percentiles of the returns, at least 1 (DreamerV3's normaliser)."""

    range: Tensor
    weight: Tensor

    def __init__(self, percentiles: tuple[float, float], decay: float = 0.99) -> None:
        super().__init__()
        self.percentiles, self.decay = percentiles, decay
        self.register_buffer("range", torch.zeros(()))
        self.register_buffer("weight", torch.zeros(()))

    def update(self, returns: Float[Tensor, "*rows"]) -> Float[Tensor, ""]:
        """Take in a batch of returns; the new scale (a scalar, no gradient)."""
        quantiles = torch.tensor(self.percentiles, device=returns.device) / 100.0
        low, high = torch.quantile(returns.detach().float().flatten(), quantiles)
        self.range.mul_(self.decay).add_((1.0 - self.decay) * (high - low))
        self.weight.mul_(self.decay).add_(1.0 - self.decay)
        return self.value()

    def value(self) -> Float[Tensor, ""]:
        """max(1, bias-corrected moving range)."""
        return (self.range / self.weight.clamp(min=1e-8)).clamp(min=1.0)
