from __future__ import annotations

import math

import pytest
import torch
from support.small import random_probs

from popgen.methods.xpm_wm import latent_filter as latents


def test_probabilities_run_over_the_classes_and_keep_a_uniform_share() -> None:
    logits = torch.tensor([[math.log(1.0), 0.0], [math.log(3.0), 50.0]])  # (C, G): two groups of two classes
    torch.testing.assert_close(
        latents.probabilities(logits, 0.0), torch.tensor([[0.25, 0.0], [0.75, 1.0]]), atol=1e-6, rtol=0
    )
    mixed = latents.probabilities(logits, 0.1)
    torch.testing.assert_close(mixed, torch.tensor([[0.275, 0.05], [0.725, 0.95]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(mixed.sum(-2), torch.ones(2))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_samples_are_one_hot_and_as_frequent_as_their_probabilities(dtype: torch.dtype) -> None:
    probs, count = random_probs(5, 3, seed=2).to(dtype), 20_000
    sample = latents.sample_one_hot(probs.expand(count, 5, 3), torch.Generator().manual_seed(0))
    assert sample.dtype == dtype and not sample.requires_grad
    assert ((sample == 0) | (sample == 1)).all() and (sample.sum(-2) == 1).all()
    wanted = probs.double() / probs.double().sum(-2, keepdim=True)
    deviation = (wanted * (1 - wanted) / count).sqrt()
    assert ((sample.double().mean(0) - wanted).abs() < 4 * deviation).all()


def test_groups_are_drawn_independently() -> None:
    sample = latents.sample_one_hot(torch.full((20_000, 2, 2), 0.5), torch.Generator().manual_seed(1))
    both = sample[:, 0, 0] * sample[:, 0, 1]
    assert float(both.mean()) == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / 20_000))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_mode_is_the_likeliest_class_and_the_first_of_equals(dtype: torch.dtype) -> None:
    probs = torch.tensor([[0.2, 0.25, 0.4, 0.0], [0.5, 0.25, 0.2, 0.0], [0.3, 0.25, 0.4, 1.0], [0.0, 0.25, 0.0, 0.0]])
    mode = latents.mode_one_hot(probs.to(dtype).requires_grad_())
    assert mode.argmax(0).tolist() == [1, 0, 0, 2] and (mode.sum(0) == 1).all() and not mode.requires_grad
    many = random_probs(50, 8, 6).to(dtype)
    assert torch.equal(latents.mode_one_hot(many).argmax(-2), many.argmax(-2))


def test_an_impossible_class_is_never_drawn() -> None:
    probs = torch.tensor([0.0, 0.5, 0.0, 0.5, 0.0]).reshape(5, 1).expand(5000, 5, 1)
    counts = latents.sample_one_hot(probs, torch.Generator().manual_seed(3)).sum((0, 2))
    assert (counts > 0).tolist() == [False, True, False, True, False]


def test_the_same_generator_gives_the_same_sample() -> None:
    probs = random_probs(50, 4, 3)
    draws = [latents.sample_one_hot(probs, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)]
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])


def test_straight_through_is_the_sample_forwards_and_the_probabilities_backwards() -> None:
    probs = random_probs(7, 4, 3).requires_grad_()
    sample = latents.straight_through(probs, torch.Generator().manual_seed(0))
    torch.testing.assert_close(sample.detach(), latents.sample_one_hot(probs, torch.Generator().manual_seed(0)))
    weight = torch.randn(7, 4, 3, generator=torch.Generator().manual_seed(1))
    (weight * sample).sum().backward()
    torch.testing.assert_close(probs.grad, weight)


def test_kl_by_hand() -> None:
    p = torch.tensor([[0.5, 0.9], [0.5, 0.1]])  # (C, G)
    q = torch.tensor([[0.25, 0.5], [0.75, 0.5]])
    first = 0.5 * math.log(0.5 / 0.25) + 0.5 * math.log(0.5 / 0.75)
    second = 0.9 * math.log(0.9 / 0.5) + 0.1 * math.log(0.1 / 0.5)
    assert float(latents.kl_divergence(p, q)) == pytest.approx(first + second, rel=1e-5)
    assert float(latents.kl_divergence(p, p)) == 0.0
    assert latents.kl_divergence(random_probs(3, 5, 4, 2), random_probs(3, 5, 4, 2, seed=1)).shape == (3, 5)


def test_masks_share_the_joint_groups_and_split_the_rest() -> None:
    masks = latents.player_masks(groups=6, joint_groups=2, classes=3).reshape(2, 3, 6)
    for player, kept in enumerate(([1, 1, 1, 1, 0, 0], [1, 1, 0, 0, 1, 1])):
        for row in masks[player]:
            assert row.tolist() == kept


def test_indices_and_back() -> None:
    one_hot = latents.sample_one_hot(random_probs(6, 5, 4), torch.Generator().manual_seed(0))
    indices = latents.to_indices(one_hot)
    assert indices.shape == (6, 4) and indices.dtype == torch.uint8
    assert torch.equal(one_hot.gather(-2, indices.long().unsqueeze(-2)), torch.ones(6, 1, 4))
    assert torch.equal(latents.from_indices(indices, 5), one_hot)
