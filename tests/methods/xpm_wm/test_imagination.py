from __future__ import annotations

from typing import Any

import numpy as np
import torch
from support.small import random_latent
from torch import Tensor

from popgen.methods.xpm_wm.imagination import (
    Imagined,
    PayLimits,
    find_excessive_pay,
    find_running,
    imagine,
)
from popgen.methods.xpm_wm.latent_filter import Latent
from popgen.methods.xpm_wm.world_model import WorldModel


class Counter(WorldModel):
    """A model whose state is a number: h' = 10 h + a^0 + 2 a^1; reward and continuation depend on it alone."""

    def __init__(self) -> None:
        torch.nn.Module.__init__(self)

    def step(self, latent: Latent, actions: Tensor, generator: Any = None) -> Latent:
        return Latent(10 * latent.h + (actions * torch.tensor([1.0, 2.0])).sum(-1, keepdim=True), latent.z)

    def reward(self, latent: Latent) -> Tensor:
        return 100 + latent.h.squeeze(-1)

    def continuation(self, latent: Latent) -> Tensor:
        return 1.0 / (1.0 + latent.h.squeeze(-1) % 10)


def last_digit(latent: Latent) -> Tensor:
    """Player 0 plays the last digit of the state (at most 3), player 1 plays 1."""
    digit = (latent.h.squeeze(-1) % 10).long().clamp(max=3)
    return torch.stack([digit, torch.ones_like(digit)], -1)


def test_rewards_are_those_of_arrival_and_weights_those_of_departure() -> None:
    start = Latent(torch.tensor([[0.0], [3.0]]), torch.zeros(2, 4))
    imagined = imagine(Counter(), last_digit, start, horizon=3)
    # Row 0: 0 -(0,1)-> 2 -(2,1)-> 24 -(3,1)-> 245.   Row 1: 3 -(3,1)-> 35 -(3,1)-> 355 -(3,1)-> 3555.
    assert imagined.latent.h.squeeze(-1).T.tolist() == [[0, 2, 24, 245], [3, 35, 355, 3555]]
    assert imagined.actions[:, 0].tolist() == [[0, 1], [2, 1], [3, 1]]
    assert imagined.actions[:, 1].tolist() == [[3, 1], [3, 1], [3, 1]]
    assert imagined.reward.T.tolist() == [[102, 124, 345], [135, 455, 3655]]
    torch.testing.assert_close(imagined.keep.T, torch.tensor([[1 / 3, 1 / 5, 1 / 6], [1 / 6, 1 / 6, 1 / 6]]))
    # The first step always runs; each later one with the probability that all arrivals before it went on.
    torch.testing.assert_close(imagined.running.T, torch.tensor([[1, 1 / 3, 1 / 15], [1, 1 / 6, 1 / 36]]))


def test_imagination_carries_no_gradient() -> None:
    start = Latent(torch.ones(2, 1, requires_grad=True), torch.zeros(2, 4))
    imagined = imagine(Counter(), last_digit, start, horizon=2)
    assert not imagined.reward.requires_grad and not imagined.latent.h.requires_grad


def test_pay_is_excessive_where_some_last_steps_together_are_beyond_their_limit() -> None:
    reward = torch.tensor([[4.0, 0.0, 0.0], [0.0, 3.0, 0.0], [2.0, 3.0, 9.0], [0.0, 0.0, 0.0]])
    excessive = find_excessive_pay(reward, np.array([4.0, 5.0, 5.0]))
    # Three steps of the first column pay 6, two and three of the second, one to three of the third.
    assert excessive.T.int().tolist() == [[0, 0, 1, 0], [0, 0, 1, 1], [0, 0, 1, 1]]
    assert not find_excessive_pay(reward, np.zeros(0)).any()


def test_a_trajectory_ends_unpaid_with_its_first_excessive_step() -> None:
    reward = torch.tensor([[3.0, 3.0], [3.0, 0.0], [0.0, 3.0], [3.0, 1.0]])
    keep, actions = torch.full((4, 2), 0.5), torch.zeros(4, 2, 2, dtype=torch.long)
    imagined, limits = Imagined(random_latent(5, 2), actions, reward, keep, find_running(keep)), PayLimits()
    assert limits.hold(imagined) is imagined and limits.figures() == {}
    limits.most = np.array([3.0, 5.0, 6.0])
    ended = limits.hold(imagined)
    assert ended.reward.T.tolist() == [[3.0, 0.0, 0.0, 3.0], [3.0, 0.0, 3.0, 1.0]]
    assert ended.keep.T.tolist() == [[0.5, 0.0, 0.5, 0.5], [0.5] * 4]
    assert ended.running.T.tolist() == [[1.0, 0.5, 0.0, 0.0], [1.0, 0.5, 0.25, 0.125]]
    assert limits.figures() == {"excessive_pay": 0.5}
