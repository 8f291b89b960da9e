"""The terms of the world-model loss (paper, equations WM and WM+), as pure functions of tensors."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from popgen.methods.xpm_wm.latents import kl_divergence


def masked_mean(values: Float[Tensor, "T B"], mask: Float[Tensor, "T B"]) -> Float[Tensor, ""]:
    """Mean of values (T, B) where mask (T, B) is 1; 0 if nowhere."""
    return (values * mask).sum() / mask.sum().clamp(min=1.0)


def reconstruction(
    outputs: Float[Tensor, "T B *shape"],
    target: Float[Tensor, "T B *shape"],
    *,
    binary: bool,
    largest: Tensor | None = None,
) -> Float[Tensor, "T B"]:
    """-ln p(o | h, z), up to a constant. (T, B, ...) -> (T, B).

    Args:
        outputs: logits of Bernoulli variables and counts if `binary`, else means of Gaussians of variance 1.
        target: for counts, their share of the largest count, whose logit is then the output.
        largest: largest counts (1 for a Bernoulli variable), broadcast to the outputs; None if all are 1. A count
            weighs as its root: as a Binomial one of n trials it would weigh n, and drown the variables beside it.
    """
    if binary:
        loss = F.binary_cross_entropy_with_logits(outputs, target, reduction="none")
        loss = loss if largest is None else largest.sqrt() * loss
    else:
        loss = 0.5 * (outputs - target).square()
    return loss.flatten(2).sum(-1)


def events(logits: Float[Tensor, "T B PE"], target: Float[Tensor, "T B PE"]) -> Float[Tensor, "T B"]:
    """-ln p(r | h, z) of the binary event vector. (T, B, P * E) -> (T, B)."""
    return F.binary_cross_entropy_with_logits(logits, target, reduction="none").sum(-1)


def balanced_kl(
    posterior: Float[Tensor, "T B C G"], prior: Float[Tensor, "T B C G"], *, dyn: float, rep: float, free_nats: float
) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
    """KL balancing with free nats (DreamerV2/V3).

        dyn * max(free, KL[sg(q) || p]) + rep * max(free, KL[q || sg(p)])

    Args:
        posterior, prior: probabilities (T, B, C, G).

    Returns:
        The weighted loss (T, B) and the raw KL (T, B) for logging.
    """
    dynamics = kl_divergence(posterior.detach(), prior)
    representation = kl_divergence(posterior, prior.detach())
    loss = dyn * dynamics.clamp(min=free_nats) + rep * representation.clamp(min=free_nats)
    return loss, dynamics.detach()


def predecessor_kl(posterior: Float[Tensor, "T B C G"], predecessor: Float[Tensor, "T B C G"]) -> Float[Tensor, "T B"]:
    """KL[q_j(z | h, o) || q_k(z | h, o)] on cross-play data with k (paper, eq. WM+). (T, B, C, G) -> (T, B)."""
    return kl_divergence(posterior, predecessor.detach())


def event_counts(
    logits: Float[Tensor, "T B P E"], target: Float[Tensor, "T B P E"], mask: Float[Tensor, "T B"]
) -> dict[str, Tensor]:
    """True positives, predicted and actual positives per event at threshold 1/2, over the masked steps.

    logits, target (T, B, P, E); mask (T, B). Each result (E,). Precision = hits / predicted, recall = hits / actual.
    """
    chosen = mask.bool()
    predicted, actual = (logits > 0.0)[chosen].float(), target[chosen]
    total = {"hits": predicted * actual, "predicted": predicted, "actual": actual}
    none = torch.zeros(target.shape[-1], device=target.device)
    return {name: value.sum(dim=(0, 1)) if value.numel() else none for name, value in total.items()}
