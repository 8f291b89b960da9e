"""Drawing actions: the right shares, log-probabilities of what was drawn, and draws that never change."""

from __future__ import annotations

import numpy as np
import torch

from popgen.methods.xpm_wm.actor_critic import draw_by_inversion
from popgen.nets.blocks import draw_by_gumbel, draw_by_multinomial

SHARES = torch.tensor([0.5, 0.3, 0.15, 0.05])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_every_way_draws_from_the_distribution() -> None:
    logits = SHARES.log().expand(20_000, 4)
    ways = (
        draw_by_inversion(logits, generator()),
        draw_by_gumbel(logits + 3.0, generator()).action,
        draw_by_multinomial(logits + 3.0, generator()),
    )
    for actions in ways:
        assert actions.shape == (20_000,)
        np.testing.assert_allclose(np.bincount(actions, minlength=4) / 20_000, SHARES, atol=0.012)


def test_gumbel_knows_the_log_probability_of_what_it_drew() -> None:
    logits = torch.randn(5, 2, 4, generator=generator())
    drawn = draw_by_gumbel(logits, generator())
    wanted = logits.log_softmax(-1).gather(-1, drawn.action.unsqueeze(-1)).squeeze(-1)
    assert drawn.action.shape == (5, 2) and torch.equal(drawn.log_prob, wanted)


def test_a_sure_action_is_always_drawn() -> None:
    logits = torch.full((100, 3), -1e9)
    logits[:, 1] = 0.0
    for actions in (
        draw_by_inversion(logits.log_softmax(-1), generator()),
        draw_by_gumbel(logits, generator()).action,
        draw_by_multinomial(logits, generator()),
    ):
        assert (actions == 1).all()
