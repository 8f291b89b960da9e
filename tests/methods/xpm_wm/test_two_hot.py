from __future__ import annotations

import math

import pytest
import torch

from popgen.methods.xpm_wm.actor_critic import TwoHot


def test_bins_by_hand() -> None:
    # Five bins over symlog -2 .. 2: symexp(x) = sign(x) (e^|x| - 1).
    expected = [-(math.e**2 - 1), -(math.e - 1), 0.0, math.e - 1, math.e**2 - 1]
    torch.testing.assert_close(TwoHot(5, limit=2.0).bins, torch.tensor(expected))
    assert TwoHot(4, limit=2.0).bins.tolist() == pytest.approx([expected[i] for i in (0, 1, 3, 4)])


@pytest.mark.parametrize("bins", [3, 4, 15, 64, 65, 255])
def test_the_grid_is_antisymmetric_so_that_flat_logits_mean_zero(bins: int) -> None:
    two_hot = TwoHot(bins)
    assert len(two_hot.bins) == bins and (two_hot.bins.diff() > 0).all()
    assert torch.equal(two_hot.bins, -two_hot.bins.flip(0))
    # Bins reach 1,100; the sum of pairs that cancel is exact up to rounding of the partial sums.
    assert two_hot.mean(torch.zeros(3, bins)).abs().max() < 1e-4


def test_mean_by_hand() -> None:
    two_hot = TwoHot(3, limit=math.log(11.0))  # -10, 0, 10
    logits = torch.tensor([[1.0, 2.0, 5.0], [2.0, 1.0, 1.0]]).log()
    torch.testing.assert_close(two_hot.mean(logits), torch.tensor([(5 - 1) / 8 * 10, -2.5]))


@pytest.mark.parametrize(
    ("target", "encoding"),
    [
        (0.0, [0, 1, 0]),
        (10.0, [0, 0, 1]),
        (-10.0, [1, 0, 0]),
        (2.5, [0, 0.75, 0.25]),
        (-7.0, [0.7, 0.3, 0]),
        (1e9, [0, 0, 1]),
        (-1e9, [1, 0, 0]),
    ],
)
def test_loss_is_the_cross_entropy_of_the_two_neighbours(target: float, encoding: list[float]) -> None:
    two_hot = TwoHot(3, limit=math.log(11.0))
    probs = torch.tensor([0.2, 0.3, 0.5])
    loss = two_hot.loss(probs.log(), torch.tensor(target))
    assert float(loss) == pytest.approx(-float((torch.tensor(encoding) * probs.log()).sum()), rel=1e-5)


def test_the_loss_is_least_where_the_mean_is_the_target() -> None:
    two_hot, target = TwoHot(65), torch.tensor([-300.0, -0.3, 0.0, 0.02, 17.0, 900.0])
    logits = torch.zeros(6, 65, requires_grad=True)
    optimiser = torch.optim.Adam([logits], lr=0.3)
    for _ in range(300):
        optimiser.zero_grad()
        two_hot.loss(logits, target).sum().backward()
        optimiser.step()
    torch.testing.assert_close(two_hot.mean(logits.detach()), target, rtol=0.02, atol=0.05)


def test_the_target_is_not_trained() -> None:
    target = torch.tensor([1.0], requires_grad=True)
    logits = torch.zeros(1, 15, requires_grad=True)
    TwoHot(15).loss(logits, target).sum().backward()
    assert target.grad is None and logits.grad is not None and logits.grad.any()
