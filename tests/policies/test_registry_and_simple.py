from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.small import AGENT, MODEL

from popgen.envs import EnvSpec, make_env
from popgen.play.policy import Policy
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.policy_registry import POLICIES, build_policy, policy_class
from popgen.policies.simple_policies import IdlePolicy, RandomPolicy


@pytest.fixture(scope="module")
def spec() -> EnvSpec:
    return make_env("rendezvous/mppmr", 1).spec


def example(kind: str, spec: EnvSpec) -> Policy:
    if kind == "world_model":
        return policy_class(kind)(MODEL, AGENT, spec)  # type: ignore[call-arg]
    if kind == "feed_forward":
        return FeedForwardPolicy(spec.views["features"], spec.num_actions, units=8, seed=3)
    if kind == "encoded":
        sizes = {"units": 8, "latent": 3, "encoder_units": 8, "encoder_layers": 1}
        return policy_class(kind)(spec.views["features"], spec.num_actions, seed=3, **sizes)  # type: ignore[call-arg]
    probabilities = [0.5, 0.5, 0.0, 0.0, 0.0]
    return RandomPolicy(spec.num_actions, probabilities) if kind == "random" else IdlePolicy(spec.action_names, "up")


# A clone of a human needs a kitchen: tests/humans/test_clones.py holds the same of it.
@pytest.mark.parametrize("kind", sorted(POLICIES.keys() - {"human_clone"}))
def test_every_kind_keeps_the_contract_and_survives_its_parts(kind: str, spec: EnvSpec) -> None:
    policy = example(kind, spec)
    assert isinstance(policy, Policy) and policy.kind == kind and type(policy) is policy_class(kind)
    again = build_policy(kind, policy.config(), policy.weights(), spec)
    for name, array in again.weights().items():
        np.testing.assert_array_equal(array, policy.weights()[name])
    rng = np.random.default_rng(0)
    shape = spec.views[policy.view].shape
    played = []
    for each in (policy, again, policy):
        rng = np.random.default_rng(0)
        each.reset(6, 11)
        previous, first, rows = np.zeros((6, 2), np.uint8), np.ones(6, bool), []
        for _ in range(5):
            previous = each.act(rng.normal(size=(6, 2, *shape)).astype(np.float32), previous, first)
            assert previous.shape == (6, 2) and previous.dtype == np.uint8 and previous.max() < spec.num_actions
            first = np.zeros(6, bool)
            rows.append(previous)
        played.append(np.stack(rows))
    np.testing.assert_array_equal(played[0], played[1])
    np.testing.assert_array_equal(played[0], played[2])


@pytest.mark.parametrize("kind", sorted(POLICIES.keys() - {"human_clone"}))
def test_every_kind_says_that_it_was_not_reset_or_for_another_batch(kind: str, spec: EnvSpec) -> None:
    policy = example(kind, spec)
    shape = spec.views[policy.view].shape

    def act(rows: int) -> np.ndarray:
        return policy.act(np.zeros((rows, 2, *shape), np.float32), np.zeros((rows, 2), np.uint8), np.ones(rows, bool))

    with pytest.raises(RuntimeError, match=r"act on 3 rows, but reset for nothing yet: call reset\(batch=3, seed"):
        act(3)
    policy.reset(2, seed=0)
    assert act(2).shape == (2, 2)
    with pytest.raises(RuntimeError, match=r"act on 3 rows, but reset for 2 rows"):
        act(3)


@pytest.mark.parametrize(
    ("kind", "config", "weights", "told"),
    [
        ("pickle", {}, {}, "unknown policy kind"),
        ("random", {"probabilities": [1.0]}, {}, "non-negative numbers"),
        ("random", {"probabilities": [0.5, 0.6, 0, 0, -0.1]}, {}, "non-negative numbers"),
        ("random", {"colour": 1}, {}, "unexpected keyword"),
        ("random", {}, {"w": np.zeros(1)}, "expected no tensors"),
        ("idle", {"action": "sleep"}, {}, "no action 'sleep'"),
        ("feed_forward", {"units": 8}, {}, "is missing"),
        ("feed_forward", {"units": -8}, {}, "cannot be built"),
    ],
)
def test_ill_fitting_parts_are_refused(
    kind: str, config: dict[str, Any], weights: dict, told: str, spec: EnvSpec
) -> None:
    with pytest.raises(ValueError, match=told):
        build_policy(kind, config, weights, spec)


def test_feed_forward_refuses_other_shapes_and_unknown_tensors(spec: EnvSpec) -> None:
    policy = example("feed_forward", spec)
    with pytest.raises(ValueError, match=r"0\.weight.*shape"):
        build_policy("feed_forward", {"units": 9}, policy.weights(), spec)
    with pytest.raises(ValueError, match="extra"):
        build_policy("feed_forward", policy.config(), policy.weights() | {"extra": np.zeros(2)}, spec)


def test_random_follows_its_probabilities() -> None:
    policy = RandomPolicy(3, [0.2, 0.0, 0.8])
    policy.reset(20_000, 5)
    obs = np.zeros((20_000, 2, 1))
    shares = np.bincount(policy.act(obs, obs, obs).ravel(), minlength=3) / 40_000
    np.testing.assert_allclose(shares, [0.2, 0.0, 0.8], atol=0.01)
    uniform = RandomPolicy(3)
    uniform.reset(20_000, 5)
    shares = np.bincount(uniform.act(obs, obs, obs).ravel(), minlength=3) / 40_000
    np.testing.assert_allclose(shares, 1 / 3, atol=0.01)


def test_idle_plays_stay() -> None:
    policy = IdlePolicy(("north", "stay"))
    policy.reset(2, seed=0)
    np.testing.assert_array_equal(policy.act(np.zeros((2, 2, 1)), np.zeros((2, 2)), np.ones(2)), np.ones((2, 2)))


def test_feed_forward_sees_only_its_own_view_and_its_seat(spec: EnvSpec) -> None:
    policy = FeedForwardPolicy(spec.views["features"], spec.num_actions, greedy=True, seed=1)
    policy.reset(64, seed=0)
    obs = np.random.default_rng(0).normal(size=(64, 2, *spec.views["features"].shape)).astype(np.float32)
    other = obs.copy()
    other[:, 1] = obs[:, 0]
    previous, first = np.zeros((64, 2), np.uint8), np.ones(64, bool)
    a, b = policy.act(obs, previous, first), policy.act(other, previous, first)
    np.testing.assert_array_equal(a[:, 0], b[:, 0])
    assert (a[:, 1] != b[:, 1]).any()
    assert (b[:, 0] != b[:, 1]).any(), "the same view in another seat can mean another action"
    with pytest.raises(ValueError, match="obs"):
        policy.act(obs[:, :, 1:], previous, first)
