"""The reward that agents learn from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from popgen.envs import make_env
from popgen.envs.reward import covered_steps, rewards_events, training_reward


def test_overcooked_pays_for_events_of_both_players_once() -> None:
    env = make_env("overcooked/cramped_room", 2)
    batch = env.step(np.full((2, 2), 4))
    events = np.zeros_like(batch.events)
    events[0, 0, 0] = 1  # takes an ingredient: 1
    events[0, 1, 3] = 1  # takes a soup: 3
    events[1, 1, 4] = 1  # delivers: 12, not the environment's 20
    given = training_reward(env.spec, replace(batch, events=events, reward=np.array([0, 20], np.float32)))
    assert rewards_events(env.spec)
    assert given.dtype == np.float32
    np.testing.assert_array_equal(given, [4.0, 12.0])


def test_rendezvous_pays_its_own_reward_with_any_leading_shape() -> None:
    env = make_env("rendezvous/mppmr", 6)
    states = env.get_state().reshape(2, 3, -1)
    _, batch = env.simulate(states, np.ones((2, 3, 2), np.int64))
    assert not rewards_events(env.spec)
    np.testing.assert_array_equal(training_reward(env.spec, batch), batch.reward)
    assert batch.reward.shape == (2, 3)


def test_events_of_another_environment_are_refused() -> None:
    batch = make_env("rendezvous/mppmr", 1).step(np.zeros((1, 2), np.int64))
    with pytest.raises(ValueError, match="expected 5 kinds"):
        training_reward(make_env("overcooked/cramped_room", 1).spec, batch)


def test_the_reward_of_an_early_end_stands_for_the_steps_that_were_left() -> None:
    covered = covered_steps(np.array([False, True, True]), np.array([10, 10, 50]), 50)
    assert covered.dtype == np.float32 and covered.tolist() == [1.0, 41.0, 1.0]
