"""Drawing actions from categorical distributions. All give the same distribution, each other draws of a generator.

A policy keeps the one it was trained and archived with: another one would play other episodes from the same seed.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class DrawnActions(NamedTuple):
    """Actions and their log-probabilities, of the same shape."""

    action: Tensor
    log_prob: Tensor


def draw_by_inversion(
    log_probs: Float[Tensor, "*batch A"], generator: torch.Generator | None = None
) -> Int[Tensor, "*batch"]:
    """By inverting the cumulative distribution: one uniform number an action, the fewest draws; for imagination."""
    cumulative = log_probs.exp().cumsum(-1)
    uniform = torch.rand(cumulative.shape[:-1], generator=generator, device=cumulative.device)
    actions = (cumulative < uniform.unsqueeze(-1) * cumulative[..., -1:]).sum(-1)
    return actions.clamp(max=cumulative.shape[-1] - 1)


def draw_by_gumbel(logits: Float[Tensor, "*batch A"], generator: torch.Generator) -> DrawnActions:
    """The largest of log p plus Gumbel noise, with its log-probability: no sum over actions, the fastest for the many
    rows of a batch of simulators."""
    log_probs = torch.log_softmax(logits, -1)
    noise = torch.empty_like(log_probs).exponential_(generator=generator).log_()
    actions = (log_probs - noise).argmax(-1, keepdim=True)
    return DrawnActions(actions.squeeze(-1), log_probs.gather(-1, actions).squeeze(-1))


def draw_by_multinomial(logits: Float[Tensor, "*batch A"], generator: torch.Generator) -> Int[Tensor, "*batch"]:
    """By `torch.multinomial`; what archived feed-forward members act with."""
    drawn = torch.multinomial(logits.flatten(0, -2).softmax(-1), 1, generator=generator)
    return drawn.view(logits.shape[:-1])
