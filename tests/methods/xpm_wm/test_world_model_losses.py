from __future__ import annotations

import math

import pytest
import torch
from support.small import random_probs

from popgen.methods.xpm_wm import world_model as losses
from popgen.methods.xpm_wm.latent_filter import kl_divergence


def test_masked_mean() -> None:
    values = torch.tensor([[1.0, 2.0], [3.0, 40.0]])
    assert float(losses.masked_mean(values, torch.tensor([[1.0, 1.0], [1.0, 0.0]]))) == 2.0
    assert float(losses.masked_mean(values, torch.zeros(2, 2))) == 0.0


def test_bernoulli_reconstruction_by_hand() -> None:
    # Probabilities 0.75 and 0.5 of two pixels, targets 1 and 0, of one player at one time.
    logits, target = torch.tensor([math.log(3.0), 0.0]), torch.tensor([1.0, 0.0])
    loss = losses.reconstruction_loss(logits.reshape(1, 1, 2), target.reshape(1, 1, 2), binary=True)
    assert loss.shape == (1, 1) and float(loss) == pytest.approx(-math.log(0.75) - math.log(0.5))


def test_counts_weigh_as_the_root_of_the_largest() -> None:
    # One plane of 0 and 1, one of counts up to 16; shares 1 and 4 / 16, probabilities 0.75 and 0.5.
    outputs, target = torch.tensor([math.log(3.0), 0.0]).reshape(1, 1, 2), torch.tensor([1.0, 0.25]).reshape(1, 1, 2)
    loss = losses.reconstruction_loss(outputs, target, binary=True, largest=torch.tensor([1.0, 16.0]))
    assert float(loss) == pytest.approx(-math.log(0.75) - 4 * math.log(0.5))
    outputs.requires_grad_()
    losses.reconstruction_loss(outputs, target, binary=True, largest=torch.tensor([1.0, 16.0])).sum().backward()
    torch.testing.assert_close(outputs.grad.flatten(), torch.tensor([0.75 - 1.0, 4 * (0.5 - 0.25)]))


def test_gaussian_reconstruction_sums_over_players_and_pixels() -> None:
    means, target = torch.zeros(2, 3, 2, 4, 5), torch.zeros(2, 3, 2, 4, 5)
    target[1, 2, 0, 1, 1], target[1, 2, 1, 3, 4] = 2.0, 1.0
    expected = torch.zeros(2, 3)
    expected[1, 2] = 0.5 * (4.0 + 1.0)
    torch.testing.assert_close(losses.reconstruction_loss(means, target, binary=False), expected)


def test_event_loss_sums_over_events() -> None:
    logits = torch.tensor([[[0.0, math.log(9.0)]]])
    loss = losses.event_loss(logits, torch.tensor([[[1.0, 1.0]]]))
    assert float(loss) == pytest.approx(-math.log(0.5) - math.log(0.9))


def test_balanced_kl_weighs_and_routes_the_two_directions() -> None:
    q_logits = torch.randn(1, 1, 4, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    p_logits = torch.randn(1, 1, 4, 3, generator=torch.Generator().manual_seed(1)).requires_grad_()

    def gradients(dyn: float, rep: float) -> tuple[torch.Tensor, torch.Tensor]:
        q_logits.grad = p_logits.grad = None
        q, p = torch.softmax(q_logits, -2), torch.softmax(p_logits, -2)
        loss, kl = losses.balanced_kl(q, p, dyn=dyn, rep=rep, free_nats=0.0)
        torch.testing.assert_close(loss.detach(), (dyn + rep) * kl)
        torch.testing.assert_close(kl, kl_divergence(q, p).detach())
        loss.sum().backward()
        return q_logits.grad.clone(), p_logits.grad.clone()

    q, p = (torch.softmax(x, -2).detach() for x in (q_logits, p_logits))
    q_grad, p_grad = gradients(2.0, 0.0)
    assert not q_grad.any()
    # d KL[q || p] / d (logits of p) = p - q
    torch.testing.assert_close(p_grad, 2.0 * (p - q))
    q_grad, p_grad = gradients(0.0, 0.5)
    assert not p_grad.any()
    # d KL[q || p] / d (logits of q) = q (ln q/p - KL of the group)
    log_ratio = (q / p).log()
    torch.testing.assert_close(q_grad, 0.5 * q * (log_ratio - (q * log_ratio).sum(-2, keepdim=True)))


def test_free_nats_bound_each_term_and_stop_its_gradient() -> None:
    logits = torch.tensor([[0.1], [0.0]]).reshape(1, 1, 2, 1).requires_grad_()
    prior = torch.full((1, 1, 2, 1), 0.5)
    loss, kl = losses.balanced_kl(torch.softmax(logits, -2), prior, dyn=1.0, rep=0.25, free_nats=1.0)
    assert 0.0 < float(kl) < 0.01 and float(loss.detach()) == pytest.approx(1.25)
    loss.sum().backward()
    assert not logits.grad.any()
    sharp = torch.tensor([0.999, 0.001]).reshape(1, 1, 2, 1).expand(1, 1, 2, 4)
    loss, kl = losses.balanced_kl(sharp, prior.expand(1, 1, 2, 4), dyn=1.0, rep=0.25, free_nats=1.0)
    assert float(kl) > 2.0 and float(loss) == pytest.approx(1.25 * float(kl), rel=1e-6)


def test_predecessor_kl_trains_the_posterior_only() -> None:
    ours, theirs = (random_probs(3, 2, 4, 3, seed=seed).requires_grad_() for seed in (0, 1))
    loss = losses.predecessor_kl(ours, theirs)
    torch.testing.assert_close(loss, (ours * (ours.log() - theirs.log())).sum((-2, -1)))
    loss.sum().backward()
    assert theirs.grad is None and ours.grad is not None and ours.grad.any()


def test_event_counts_by_hand() -> None:
    # Two steps of two rows, one player each way, three events; row 1 of step 1 is masked.
    logits = torch.full((2, 2, 2, 3), -1.0)
    target = torch.zeros(2, 2, 2, 3)
    logits[0, 0, 0, 0], target[0, 0, 0, 0] = 1.0, 1.0  # a hit
    logits[0, 1, 1, 0] = 1.0  # predicted by mistake
    target[1, 0, 1, 0] = 1.0  # missed
    logits[0, 0, 0, 1], target[0, 0, 1, 1] = 1.0, 1.0  # the right event, the wrong player: both wrong
    logits[1, 1, 0, 2], target[1, 1, 0, 2] = 1.0, 1.0  # a hit where nothing counts
    counts = losses.event_counts(logits, target, torch.tensor([[1.0, 1.0], [1.0, 0.0]]))
    assert {name: value.tolist() for name, value in counts.items()} == {
        "hits": [1.0, 0.0, 0.0],
        "predicted": [2.0, 1.0, 0.0],
        "actual": [2.0, 1.0, 0.0],
    }
    nothing = losses.event_counts(logits, target, torch.zeros(2, 2))
    assert all(value.tolist() == [0.0, 0.0, 0.0] for value in nothing.values())
