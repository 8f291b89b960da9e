"""MEP's and TrajeDi's rewards against brute force on three members and ten steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from popgen.losses.population_diversity import population_surprise, trajectory_divergence

MEMBERS, STEPS, ACTIONS = 3, 10, 4


def policies(seed: int = 0) -> np.ndarray:
    """(K, T, A): each member's probabilities at the states of one trajectory."""
    logits = np.random.default_rng(seed).normal(size=(MEMBERS, STEPS, ACTIONS))
    return np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)


def played(probabilities: np.ndarray, actions: np.ndarray) -> torch.Tensor:
    """(K, T, 1) log-probabilities of the actions (T,)."""
    return torch.from_numpy(np.log(probabilities[:, np.arange(STEPS), actions]))[:, :, None]


def test_the_population_is_surprised_by_what_its_mean_policy_seldom_does() -> None:
    probabilities, actions = policies(), np.random.default_rng(1).integers(0, ACTIONS, STEPS)
    surprise = population_surprise(played(probabilities, actions), floor=1e-5)[:, 0]
    for t in range(STEPS):
        mean = sum(probabilities[k, t, actions[t]] for k in range(MEMBERS)) / MEMBERS
        assert float(surprise[t]) == pytest.approx(-math.log(mean), abs=1e-6)


def test_the_expected_surprise_is_the_populations_entropy() -> None:
    mean = policies().mean(0)
    each = [
        population_surprise(played(policies(), np.full(STEPS, a)), floor=1e-9)[:, 0].numpy() for a in range(ACTIONS)
    ]
    expected = sum(mean[:, a] * each[a] for a in range(ACTIONS))
    np.testing.assert_allclose(expected, -(mean * np.log(mean)).sum(-1), atol=1e-9)


def test_a_probability_counts_as_the_floor_at_least() -> None:
    log_probs = torch.full((2, 1), -40.0)
    assert float(population_surprise(log_probs, floor=1e-3)) == pytest.approx(-math.log(1e-3))


@pytest.mark.parametrize("kernel", [0.0, 0.5, 1.0])
def test_divergence_is_the_definition(kernel: float) -> None:
    """Two episodes of four and six steps: weighted sums over the steps of the same episode."""
    log_probs = played(policies(), np.random.default_rng(2).integers(0, ACTIONS, STEPS))
    ends = torch.zeros(STEPS, 1, dtype=torch.bool)
    ends[3] = True
    found = trajectory_divergence(log_probs, 1, ends, kernel)[:, 0]
    for t in range(STEPS):
        episode = range(4) if t < 4 else range(4, STEPS)
        weighted = [sum(kernel ** abs(t - u) * float(log_probs[k, u, 0]) for u in episode) for k in range(MEMBERS)]
        mean = sum(math.exp(value) for value in weighted) / MEMBERS
        assert float(found[t]) == pytest.approx(weighted[1] - math.log(mean), abs=1e-6)


def test_divergence_of_equals_is_zero_and_of_strangers_ln_k() -> None:
    """A member whose actions nobody else would take earns ln K at every step, the most there is."""
    ends = torch.zeros(STEPS, 1, dtype=torch.bool)
    equal = torch.full((MEMBERS, STEPS, 1), -1.2)
    assert float(trajectory_divergence(equal, 0, ends, 0.5).abs().max()) < 1e-6
    alone = torch.full((MEMBERS, STEPS, 1), -80.0)
    alone[2] = -0.1
    np.testing.assert_allclose(trajectory_divergence(alone, 2, ends, 0.5).numpy(), math.log(MEMBERS), atol=1e-6)


def test_mean_divergence_of_single_actions_is_that_of_jensen_and_shannon() -> None:
    """With kernel 0: each member's own actions, weighted by its own probabilities, at one state."""
    probabilities = policies()[:, :1].repeat(STEPS, 1)
    ends = torch.zeros(STEPS, 1, dtype=torch.bool)
    total = 0.0
    for own in range(MEMBERS):
        for action in range(ACTIONS):
            log_probs = played(probabilities, np.full(STEPS, action))
            total += probabilities[own, 0, action] * float(trajectory_divergence(log_probs, own, ends, 0.0)[0, 0])
    mean = probabilities[:, 0].mean(0)
    entropy = lambda p: -(p * np.log(p)).sum(-1)  # noqa: E731
    assert total / MEMBERS == pytest.approx(entropy(mean) - entropy(probabilities[:, 0]).mean(), abs=1e-9)
