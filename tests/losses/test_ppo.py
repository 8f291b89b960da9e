from __future__ import annotations

import math

import pytest
import torch

from popgen.losses.policy_losses import clipped_surrogate, negated_surrogate


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [  # clip 0.2; slope: d loss / d log_prob
        (1.0, 2.0, -2.0, -2.0),
        (1.1, 2.0, -2.2, -2.2),
        (1.5, 2.0, -2.4, 0.0),  # far enough in the good direction
        (0.5, 2.0, -1.0, -1.0),  # on the way back
        (1.5, -2.0, 3.0, 3.0),
        (0.5, -2.0, 1.6, 0.0),
    ],
)
def test_the_surrogate_by_hand(ratio: float, advantage: float, loss: float, slope: float) -> None:
    old = torch.tensor(-1.3)
    log_prob = (old + math.log(ratio)).requires_grad_()
    value = clipped_surrogate(log_prob, old, torch.tensor(advantage), clip=0.2)
    assert float(value.detach()) == pytest.approx(loss, rel=1e-5)
    value.backward()
    assert float(log_prob.grad) == pytest.approx(slope, rel=1e-5)


def test_negating_the_clipped_loss_leaves_the_improving_direction_unclipped() -> None:
    """Lowering a return with A = 2 means lowering pi: at r = 0.5 the signed advantage has stopped, the other not."""
    old = torch.tensor(-1.3)
    for function, advantage, slope in ((clipped_surrogate, -2.0, 0.0), (negated_surrogate, 2.0, 1.0)):
        log_prob = (old + math.log(0.5)).requires_grad_()
        function(log_prob, old, torch.tensor(advantage), clip=0.2).backward()
        assert float(log_prob.grad) == pytest.approx(slope, abs=1e-6)
