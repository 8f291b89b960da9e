from __future__ import annotations

from dataclasses import replace

import torch
from support.small import random_latent

from popgen.methods.xpm_wm.imagination import Imagined, Samples

STEPS, BATCH = 2, 3


def imagined() -> Imagined:
    """Action 10 t + b of the first player, 100 more of the second."""
    own = 10 * torch.arange(STEPS)[:, None] + torch.arange(BATCH)
    ones = torch.ones(STEPS, BATCH)
    return Imagined(random_latent(STEPS + 1, BATCH), torch.stack([own, own + 100], -1), ones, ones, 0.5 * ones)


def numbered() -> Samples:
    """Of cross-play: first and last in seat 0, the middle one in seat 1."""
    seats = torch.tensor([[0], [1], [0]])
    values = torch.arange(6.0).view(STEPS, BATCH)
    return Samples.from_imagined(imagined(), 4, seats, values, -values, 0.1)


def test_rows_run_over_time_and_batch_and_take_the_members_own_seat() -> None:
    samples = numbered()
    assert len(samples) == 6 and samples.key == 4
    assert samples.seat.tolist() == [0, 1, 0, 0, 1, 0]
    assert samples.actions.tolist() == [[0], [101], [2], [10], [111], [12]]
    assert samples.returns.tolist() == [0, 1, 2, 3, 4, 5] == (-samples.advantage).tolist()
    assert torch.equal(samples.latent.h[4], imagined().latent.h[1, 1])  # the state in which it acted, not the next
    assert samples.running.tolist() == [0.5] * 6


def test_in_self_play_both_seats_act_and_the_critic_is_told_the_first() -> None:
    players = torch.tensor([0, 1]).expand(BATCH, 2)
    samples = Samples.from_imagined(imagined(), 0, players, torch.zeros(STEPS, BATCH), torch.zeros(STEPS, BATCH), 0.1)
    assert samples.actions.tolist()[4] == [11, 111] and samples.seat.tolist() == [0] * 6


def test_minibatches_share_out_every_row_once_and_keep_rows_together() -> None:
    samples = replace(numbered(), log_prob=torch.arange(6.0).unsqueeze(-1))
    parts = samples.minibatches(4, torch.Generator().manual_seed(0))
    assert sorted(len(part) for part in parts) == [1, 1, 2, 2]
    assert sorted(torch.cat([part.returns for part in parts]).tolist()) == [0, 1, 2, 3, 4, 5]
    for part in parts:
        assert part.log_prob is not None and torch.equal(part.log_prob[:, 0], part.returns)
        assert torch.equal(part.latent.z, samples.latent.z[part.returns.long()])
    assert samples.minibatches(1, torch.Generator()) == [samples]
