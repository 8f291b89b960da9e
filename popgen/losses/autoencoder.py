"""The evidence lower bound of a variational autoencoder (Kingma and Welling 2013)."""

from __future__ import annotations

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def elbo_terms(
    outputs: Float[Tensor, "R F"],
    target: Float[Tensor, "R F"],
    mean: Float[Tensor, "R Z"],
    log_variance: Float[Tensor, "R Z"],
    *,
    binary: bool,
) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"]]:
    """-ln p(o | z), up to a constant, and KL[q(z | o) || N(0, 1)], both (R,), to be minimised.

    Args:
        outputs, target: (R, F), logits of Bernoulli variables if `binary`, else means of Gaussians of variance 1.
        mean, log_variance: (R, Z) of q.
    """
    if binary:
        loss = F.binary_cross_entropy_with_logits(outputs, target, reduction="none")
    else:
        loss = 0.5 * (outputs - target).square()
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance)
    return loss.sum(-1), divergence.sum(-1)
