"""Feed-forward networks: what they read, and critics whose normalisation never changes a value."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from popgen.envs import make_env
from popgen.envs.contract import ViewSpec
from popgen.nets.feed_forward import FeedForwardNet, Sizes, ValueNet, joint, joint_copies, orthogonal
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.policy_registry import build_policy

FLAT = ViewSpec((3,), "float32", False, 2.0)
GRID = ViewSpec((4, 3, 2), "uint8", False, 20.0, maxima=(1.0, 20.0))
CNN = Sizes(8, 1, "leaky_relu", (3, 3), 5)


def critic(seed: int = 0, view: ViewSpec = FLAT) -> ValueNet:
    sizes = CNN if len(view.shape) == 3 else Sizes(8, 1)
    return ValueNet(view, 2, sizes, torch.Generator().manual_seed(seed))


def test_entries_are_divided_by_their_largest_values() -> None:
    net = FeedForwardNet(FLAT, 4, 2, Sizes(8, 1))
    by_hand = torch.tensor([[1.0, 0.5, 2.0, 0.0, 1.0]])
    for part in net:
        by_hand = part(by_hand)
    assert torch.equal(net(torch.tensor([[2.0, 1.0, 4.0]]), torch.tensor([[0.0, 1.0]])), by_hand)
    grid = FeedForwardNet(GRID, 4, 2, CNN)
    obs = torch.zeros(1, 4, 3, 2)
    obs[..., 1] = 20
    scaled = (obs / 20).permute(0, 3, 1, 2)
    for part in list(grid)[:4]:
        scaled = part(scaled)
    values = torch.cat([scaled.flatten(1), torch.zeros(1, 2)], -1)
    for part in list(grid)[4:]:
        values = part(values)
    assert torch.equal(grid(obs.byte(), torch.zeros(1, 2)), values)


@pytest.mark.parametrize(("view", "sizes"), [(FLAT, CNN), (GRID, Sizes()), (GRID, Sizes(kernels=(4,)))])
def test_sizes_must_fit_the_view(view: ViewSpec, sizes: Sizes) -> None:
    with pytest.raises(ValueError, match="kernels"):
        FeedForwardNet(view, 4, 2, sizes)


def test_the_joint_observation_is_one_players_where_the_other_is_its_permutation() -> None:
    obs = torch.arange(12.0).view(2, 2, 3)
    swapped = ViewSpec((3,), "float32", False, swap=(2, 1, 0))
    assert joint_copies(swapped) == 1 and torch.equal(joint(obs, swapped), obs[:, 0])
    assert joint_copies(FLAT) == 2 and joint(obs, FLAT)[1].tolist() == [6, 7, 8, 9, 10, 11]
    grid = torch.rand(5, 6, 2, 4, 3, 2)
    assert joint(grid, GRID).shape == (5, 6, 4, 3, 4)


def test_a_policy_starts_out_nearly_uniform() -> None:
    net = FeedForwardNet(FLAT, 4, 2, Sizes(32, 2))
    orthogonal(net, 0.01, torch.Generator().manual_seed(1))
    probabilities = net(torch.randn(100, 3), torch.eye(2).repeat(50, 1)).softmax(-1)
    assert (probabilities - 0.25).abs().max() < 0.01
    twice = FeedForwardNet(FLAT, 4, 2, Sizes(32, 2))
    orthogonal(twice, 0.01, torch.Generator().manual_seed(1))
    assert all(torch.equal(a, b) for a, b in zip(net.parameters(), twice.parameters(), strict=True))


@pytest.mark.parametrize("view", [FLAT, GRID])
def test_new_statistics_change_no_value(view: ViewSpec) -> None:
    net, extras = critic(view=view), torch.eye(2).repeat(8, 1)
    obs = torch.rand(16, *view.shape[:-1], 2 * view.shape[-1])
    net.see(torch.tensor([100.0, 300.0]), 0.9)
    before = net.value(obs, extras)
    assert before.mean() > 0.0
    net.see(torch.tensor([-50.0, 10.0, 7.0]), 0.9)
    torch.testing.assert_close(net.value(obs, extras), before, rtol=1e-4, atol=1e-2)


def test_returns_are_normalised_by_moving_statistics() -> None:
    net = critic()
    assert net.normalised(torch.tensor([3.0])).item() == 3.0  # nothing seen yet
    net.see(torch.tensor([1.0, 3.0]), 0.5)
    mean, deviation = net.statistics()
    assert (mean.item(), deviation.item()) == (2.0, 1.0)
    net.see(torch.tensor([6.0, 6.0]), 0.5)  # a third of the weight is left for the first: (2 + 2 * 6) / 3
    mean, deviation = net.statistics()
    assert mean.item() == pytest.approx(14 / 3)
    assert deviation.item() == pytest.approx(np.sqrt((5 + 2 * 36) / 3 - (14 / 3) ** 2), rel=1e-5)


def test_a_convolutional_policy_saves_and_loads() -> None:
    env = make_env("overcooked/cramped_room", 3)
    view = env.spec.views["lossless"]
    policy = FeedForwardPolicy(view, 6, kernels=(3,), channels=4, units=8, layers=1, name="lossless", seed=2)
    again = build_policy("feed_forward", policy.config(), policy.weights(), env.spec)
    obs, previous, first = env.observe("lossless"), np.zeros((3, 2), np.uint8), np.ones(3, bool)
    for other in (policy, again):
        other.reset(3, seed=4)
    assert again.view == "lossless" and (policy.act(obs, previous, first) == again.act(obs, previous, first)).all()
    with pytest.raises(ValueError, match="no view"):
        build_policy("feed_forward", {**policy.config(), "name": "pixels"}, policy.weights(), env.spec)


def test_a_plain_policy_keeps_its_short_config() -> None:
    policy = FeedForwardPolicy(FLAT, 4, units=8, layers=1)
    assert policy.config() == {"units": 8, "layers": 1, "greedy": False}
    assert set(policy.weights()) == {"0.weight", "0.bias", "2.weight", "2.bias"}
