"""MEP's and TrajeDi's rewards against brute force on three members and ten steps."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from popgen.losses.population_diversity import divergence_rewards, population_surprise, trajectory_divergence

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


def test_rewards_of_divergence_by_hand() -> None:
    """Two steps, whole episodes compared: the member's 1/2 beside 1/4, then 4/5 beside 1/5. The first step is worth
    ln 4/3; the second makes both steps' parts ln 16/9, and is paid what is new."""
    log_probs = torch.tensor([[0.5, 0.8], [0.25, 0.2]], dtype=torch.float64).log()[:, :, None]
    ends = torch.tensor([[False], [True]])
    found = divergence_rewards(log_probs, 0, ends, 1.0)[:, 0]
    first, both = math.log(4 / 3), math.log(16 / 9)
    assert found.tolist() == pytest.approx([first, 2 * both - first])


@pytest.mark.parametrize("kernel", [0.0, 0.5, 1.0])
def test_rewards_add_up_to_the_divergence_of_an_episode_and_look_at_no_later_action(kernel: float) -> None:
    """Two games side by side, of which one has two episodes; with kernel 0 the rewards are the parts themselves."""
    rng = np.random.default_rng(5)
    log_probs = torch.cat([played(policies(), rng.integers(0, ACTIONS, STEPS)) for _ in range(2)], -1)
    ends = torch.zeros(STEPS, 2, dtype=torch.bool)
    ends[3, 0] = ends[-1] = True
    parts, rewards = (function(log_probs, 1, ends, kernel) for function in (trajectory_divergence, divergence_rewards))
    for game, episode in ((0, slice(0, 4)), (0, slice(4, STEPS)), (1, slice(0, STEPS))):
        assert float(rewards[episode, game].sum()) == pytest.approx(float(parts[episode, game].sum()), abs=1e-9)
    if kernel == 0.0:
        torch.testing.assert_close(rewards, parts)
    changed = log_probs.clone()
    changed[:, 6:] = log_probs[:, 6:].roll(1, 0)
    again = divergence_rewards(changed, 1, ends, kernel)
    torch.testing.assert_close(again[:6], rewards[:6])
    assert not torch.allclose(again[6:], rewards[6:])


def enumerate_games(members: int, steps: int, seed: int) -> tuple[Tensor, Tensor]:
    """Logits (K, T, last action, A) of random members with two actions, and the log-probabilities (K, T, games) that
    they give every game there is."""
    logits = torch.randn(members, steps, 3, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    logits.requires_grad_()
    actions = torch.tensor(list(itertools.product(range(2), repeat=steps)))
    before = torch.cat([torch.full((len(actions), 1), 2), actions[:, :-1]], 1)
    log_probs = torch.log_softmax(logits, -1)[:, torch.arange(steps), before, actions]
    return logits, log_probs.transpose(1, 2)


def gradients(members: int, kernel: float, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Of the divergence by member 0's logits: the whole, its score-function part, and what policy gradients with the
    rewards' undiscounted returns learn."""
    logits, log_probs = enumerate_games(members, 4, seed)
    ends = torch.zeros(log_probs.shape[1:], dtype=torch.bool)
    ends[-1] = True
    chances, known = log_probs.sum(1).exp(), log_probs.detach()
    returns = divergence_rewards(known, 0, ends, kernel).flip(0).cumsum(0).flip(0)
    worth = torch.stack([chances[k] * trajectory_divergence(log_probs, k, ends, kernel) for k in range(members)]).sum()
    score = (chances[0] * trajectory_divergence(known, 0, ends, kernel)).sum()
    learned = (chances[0].detach() * log_probs[0] * returns).sum()
    found = [torch.autograd.grad(one, logits, retain_graph=True)[0][0] for one in (worth, score, learned)]
    return found[0], found[1], found[2]


@pytest.mark.parametrize("members", [2, 3])
@pytest.mark.parametrize("kernel", [0.0, 0.3, 0.5, 1.0])
def test_returns_of_the_rewards_are_the_divergences_score_function_gradient(members: int, kernel: float) -> None:
    """Brute force over all games of four steps, of members who heed the last action."""
    for seed in range(3):
        _, score, learned = gradients(members, kernel, seed)
        torch.testing.assert_close(learned, score, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize(("kernel", "share"), [(0.0, 0.975), (0.5, 0.77), (1.0, 1.0)])
def test_what_the_score_function_has_of_the_whole_gradient(kernel: float, share: float) -> None:
    """Along the whole one, over twenty random populations: what `popgen.methods.mappo.trajedi` says is left out."""
    found = [gradients(members, kernel, seed) for members in (2, 3) for seed in range(10)]
    kept = sum(float((learned * whole).sum()) for whole, _, learned in found)
    assert kept / sum(float(whole.square().sum()) for whole, *_ in found) == pytest.approx(share, abs=0.005)
