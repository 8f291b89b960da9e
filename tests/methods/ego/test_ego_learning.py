"""Egos' networks, play and updates: memory through resets, equality after a restart, the bandit that is learned."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from support.small import kitchen

from popgen.methods.ego.augmented_starts import AugmentedStarts
from popgen.methods.ego.config import AugmentConfig, EgoConfig, HiptConfig
from popgen.methods.ego.ego_learner import EgoLearner, EgoSetup
from popgen.methods.ego.ego_networks import EgoSizes, build_network
from popgen.methods.ego.partner_seats import PartnerSeats
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.policies.simple_policies import RandomPolicy

HORIZON = 20
SMALL: dict[str, Any] = {
    **{"units": 8, "head_units": 4, "critic_units": 8, "steps": 1000, "envs": 8},
    **{"unroll": 10, "sequence": 5, "minibatches": 2, "epochs": 1},
}
LEVELS = HiptConfig(skills=3, duration_least=2, duration_most=4)
SETUPS = {
    "fcp": EgoSetup(EgoConfig(**SMALL)),
    "prioritised": EgoSetup(EgoConfig(**SMALL, sampling="prioritised")),
    "varied": EgoSetup(EgoConfig(**SMALL), augment=AugmentConfig(kept=16)),
    "hipt": EgoSetup(EgoConfig(**SMALL), levels=LEVELS),
    "conv": EgoSetup(EgoConfig(**SMALL, network="conv_lstm", channels=2), levels=LEVELS),
    "sp": EgoSetup(EgoConfig(**SMALL), self_play=True),
    "sp_aug": EgoSetup(EgoConfig(**SMALL), augment=AugmentConfig(kept=16), self_play=True),
}


def make_learner(setup: EgoSetup, seed: int = 0) -> EgoLearner:
    env = kitchen(setup.ego.envs, HORIZON)
    view = env.spec.views["features"]
    partners = [FeedForwardPolicy(view, env.spec.num_actions, units=4, layers=1, seed=k) for k in range(2)]
    return EgoLearner(setup, env, [] if setup.self_play else [*partners, RandomPolicy(6)], seed)


@pytest.mark.parametrize("network", ["features_gru", "conv_lstm"])
def test_a_sequence_with_resets_equals_steps_with_a_fresh_memory(network: str) -> None:
    spec = kitchen().spec
    net = build_network(EgoSizes(network=network, units=8, channels=2, head_units=4), spec, 0)
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(12, 3, 8, generator=generator)
    first = torch.zeros(12, 3, dtype=torch.bool)
    first[0], first[4, 1], first[7, 0], first[7, 2] = True, True, True, True
    whole = net.remember(inputs, torch.randn(3, net.state_size, generator=generator), first)
    for row, cuts in enumerate(([0, 7, 12], [0, 4, 12], [0, 7, 12])):
        for begin, end in zip(cuts, cuts[1:], strict=False):
            state = torch.zeros(1, net.state_size)
            for t in range(begin, end):
                alone = net.remember(inputs[t : t + 1, row : row + 1], state, torch.zeros(1, 1, dtype=torch.bool))
                state = alone.state
                torch.testing.assert_close(alone.outputs[0, 0], whole.outputs[t, row])


@pytest.mark.parametrize("name", SETUPS)
def test_a_learner_that_continues_from_its_state_learns_the_same(name: str) -> None:
    whole, before = make_learner(SETUPS[name]), make_learner(SETUPS[name])
    for _ in range(3):
        whole.iterate()
        before.iterate()
    after = make_learner(SETUPS[name], seed=0)
    after.load_state(before.state())
    for _ in range(2):
        expected, got = whole.iterate(), after.iterate()
        assert expected == got
    weights = after.policy.weights()
    assert all(np.array_equal(value, weights[key]) for key, value in whole.policy.weights().items())


@pytest.mark.parametrize("name", ["fcp", "hipt", "sp"])
def test_what_the_update_recomputes_is_what_the_rollout_did(name: str) -> None:
    learner = make_learner(SETUPS[name])
    for _ in range(2):
        rollout = learner.sampler.play()
    net, time = learner.net, len(rollout.reward)
    for start in range(0, time, 5):
        part = slice(start, start + 5)
        encoded = net.encode(rollout.seen[part].flatten(0, 1), rollout.extras[part].flatten(0, 1))
        memory = net.remember(encoded.unflatten(0, (5, -1)), rollout.state[start // 5], rollout.is_first[part]).outputs
        skill = None if rollout.choices is None else rollout.choices.skill[part]
        log_probs = torch.log_softmax(net.action_logits(memory, skill), -1)
        got = log_probs.gather(-1, rollout.actions[part].unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(got, rollout.log_prob[part])


def test_the_ego_that_acts_is_the_ego_that_learned() -> None:
    """The saved policy, asked for the same steps, has the memory that the rollout had."""
    learner = make_learner(SETUPS["sp"])
    learner.sampler.env.set_time(np.zeros(8, np.int64))
    env, policy = kitchen(8, HORIZON), learner.policy
    rollout = learner.sampler.play()
    policy.reset(8, 0)
    previous = np.zeros((8, 2), np.uint8)
    for t in range(10):
        policy.act(env.observe(), previous, np.full(8, t == 0))
        previous = rollout.actions[t].numpy().astype(np.uint8).reshape(8, 2)
        env.step(previous)
        if t == 4:
            torch.testing.assert_close(torch.from_numpy(policy.memory()["state"]), rollout.state[1])


def test_partners_share_the_seats_evenly_or_by_rank() -> None:
    seats = PartnerSeats(3, 4, 2, None, 0)
    counts = np.zeros(6)
    for _ in range(6):
        np.add.at(counts, seats.cell, 1)
        seats.move_on(np.arange(4))
    assert counts.tolist() == [4] * 6
    ranked = PartnerSeats(2, 4, 2, 1.0, 0)
    ranked.note_returns(np.arange(4), np.array([4.0, 2.0, 3.0, 1.0]))
    assert ranked.probabilities().tolist() == [0.1, 0.3, 0.2, 0.4]
    ranked.note_returns(np.array([0]), np.array([24.0]))
    assert ranked.mean[0] == 5.0
    unseen = PartnerSeats(4, 8, 2, 3.0, 0)
    assert unseen.probabilities().tolist() == [0.125] * 8
    unseen.note_returns(np.array([0, 1]), np.array([2.0, 2.0]))  # ranks 1.5, 1.5 and six times 5.5
    unseen._priority = 1.0
    assert np.allclose(unseen.probabilities(), [1.5 / 36, 1.5 / 36, *[5.5 / 36] * 6])


def test_augmented_starts_are_states_of_play_moved_on() -> None:
    env = kitchen(8, HORIZON)
    starts = AugmentedStarts(AugmentConfig(share=1.0, random_steps=3, kept=4), env, 5, 0)
    assert not starts.begin(np.arange(8)).any()  # nothing was seen yet
    fresh = env.get_state()
    env.step(np.full((8, 2), 3))
    moved = env.get_state()
    env.set_time(np.full(8, 13))
    starts.see(env.get_state())
    env.reset()
    draws = deepcopy(starts._rng)
    assert starts.begin(np.array([1, 6])).all()
    assert (env.time(env.get_state()) == [0, 10, 0, 0, 0, 0, 10, 0]).all() or (
        env.time(env.get_state())[[1, 6]] >= 10
    ).all()
    draws.random(2), draws.integers(1, size=2)
    assert starts.take_simulated() == draws.integers(4, size=2).sum() > 0 and starts.take_simulated() == 0
    assert np.array_equal(env.get_state()[0], fresh[0]) and not np.array_equal(moved[1], fresh[1])


def test_an_ego_learns_to_play() -> None:
    """Beside an idle partner an ego that is paid for every onion it takes comes to take more of them."""
    config = EgoConfig(
        **{
            **SMALL,
            "learning_rate": 3e-3,
            "units": 32,
            "envs": 64,
            "unroll": 20,
            "sequence": 20,
            "epochs": 4,
            "steps": 10**6,
        }
    )
    env = kitchen(64, HORIZON)
    learner = EgoLearner(EgoSetup(config), env, [RandomPolicy(6, [0.0] * 4 + [1.0, 0.0])], 0)
    first = learner.sampler.play().reward.sum()
    for _ in range(30):
        learner.iterate()
    assert learner.sampler.play().reward.sum() > 2 * first + 10
