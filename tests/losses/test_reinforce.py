from __future__ import annotations

import pytest
import torch

from popgen.losses.policy_losses import SIGN, ReturnScale, floor_reward, reinforce, signed_advantage
from popgen.types import Kind


def test_the_gradient_is_that_of_reinforce() -> None:
    # One decision among three actions, p = softmax(0, ln 2, ln 3) = (1, 2, 3) / 6; action 1 was taken.
    logits = torch.tensor([1.0, 2.0, 3.0]).log().requires_grad_()
    log_probs = torch.log_softmax(logits, -1)
    entropy = -(log_probs.exp() * log_probs).sum()
    loss = reinforce(log_probs[1], torch.tensor(4.0), entropy, torch.tensor(0.5), entropy_scale=0.0)
    loss.backward()
    # d(-w A ln p_1) / d logits = -w A (one-hot - p)
    probs = torch.tensor([1.0, 2.0, 3.0]) / 6
    torch.testing.assert_close(logits.grad, -0.5 * 4.0 * (torch.tensor([0.0, 1.0, 0.0]) - probs))


def test_the_entropy_bonus_flattens() -> None:
    logits = torch.tensor([1.0, 2.0, 3.0]).log().requires_grad_()
    log_probs = torch.log_softmax(logits, -1)
    entropy = -(log_probs.exp() * log_probs).sum()
    reinforce(log_probs[1], torch.tensor(0.0), entropy, torch.tensor(1.0), entropy_scale=2.0).backward()
    probs = torch.tensor([1.0, 2.0, 3.0]) / 6
    # dH / d logits = -p (ln p + H)
    torch.testing.assert_close(logits.grad, 2.0 * probs * (probs.log() + entropy.detach()))


def test_the_mean_is_over_all_decisions_and_weights_are_not_renormalised() -> None:
    log_prob = torch.tensor([[-1.0, -2.0], [-3.0, -4.0]])
    advantage = torch.tensor([[1.0, 1.0], [2.0, -1.0]])
    weight = torch.tensor([[1.0, 1.0], [0.5, 0.0]])
    loss = reinforce(log_prob, advantage, torch.ones(2, 2), weight, entropy_scale=0.1)
    # -((-1 + 0.1) + (-2 + 0.1) + 0.5 (-6 + 0.1) + 0) / 4
    assert float(loss) == pytest.approx((0.9 + 1.9 + 2.95) / 4)


def test_neither_advantage_nor_weight_is_trained() -> None:
    tensors = [torch.ones(3, requires_grad=True) for _ in range(4)]
    reinforce(tensors[0], tensors[1], tensors[2], tensors[3], entropy_scale=0.5).backward()
    assert tensors[1].grad is None and tensors[3].grad is None
    torch.testing.assert_close(tensors[0].grad, torch.full((3,), -1 / 3))
    torch.testing.assert_close(tensors[2].grad, torch.full((3,), -0.5 / 3))


def test_return_scale_is_the_range_between_two_percentiles() -> None:
    scale = ReturnScale((5.0, 95.0))
    # 0, 1, ..., 100: the 5th percentile is 5, the 95th is 95; the bias correction makes the first value exact.
    assert float(scale.update(torch.arange(101.0).reshape(1, 101))) == pytest.approx(90.0, rel=1e-5)
    # The same shape, ten times as wide, with weights 0.99 * 0.01 and 0.01.
    second = float(scale.update(10 * torch.arange(101.0)))
    assert second == pytest.approx((0.99 * 90 + 900) / 1.99, rel=1e-4)
    assert float(scale.value()) == second


def test_return_scale_is_never_below_one() -> None:
    scale = ReturnScale((5.0, 95.0))
    assert float(scale.value()) == 1.0
    assert float(scale.update(torch.linspace(0, 0.1, 50))) == 1.0
    assert float(scale.update(torch.full((50,), 7.0))) == 1.0


def test_signs() -> None:
    assert SIGN == {Kind.SP: 1.0, Kind.MP: 1.0, Kind.XP: -1.0}
    advantage = torch.tensor([3.0, 1.0, -1.0])
    torch.testing.assert_close(signed_advantage(Kind.SP, advantage, weight=1.0, unit=2.0), advantage / 2)
    torch.testing.assert_close(signed_advantage(Kind.MP, advantage, weight=0.5, unit=1.0), advantage / 2)
    # Centred (mean 1), then negated: the action that cross-play gained most from is pushed down most.
    crossed = signed_advantage(Kind.XP, advantage, weight=0.25, unit=torch.tensor(2.0))
    torch.testing.assert_close(crossed, torch.tensor([-0.25, 0.0, 0.25]))
    moved = signed_advantage(Kind.XP, advantage + 100, weight=0.25, unit=2.0)
    torch.testing.assert_close(moved, crossed)


def test_no_step_of_cross_play_counts_less_than_the_floor() -> None:
    reward, covered = torch.tensor([-0.5, -2.0, -60.0, -10.0]), torch.tensor([1.0, 1.0, 20.0, 20.0])
    assert floor_reward(reward, covered, -1.0).tolist() == [-0.5, -1.0, -20.0, -10.0]
    assert floor_reward(reward, covered, None) is reward
