"""Every registered environment keeps the protocol of popgen/envs/contract.py; nothing here knows a game."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from popgen.envs import BatchedEnv, env_names, make_env
from popgen.errors import UserError

BATCH = 6
pytestmark = pytest.mark.parametrize("name", env_names())


def play(env: BatchedEnv, steps: int, seed: int = 0) -> list:
    """StepBatches of seeded random actions; finished rows are reset."""
    rng, batches = np.random.default_rng(seed), []
    for _ in range(steps):
        batches.append(env.step(rng.integers(env.spec.num_actions, size=(env.num_envs, env.spec.num_players))))
        env.reset(indices=np.flatnonzero(batches[-1].done))
    return batches


def test_spec_is_complete_and_consistent(name):
    spec = make_env(name).spec
    assert spec.name == name and spec.num_players == 2 and spec.horizon >= 1
    assert len(spec.action_names) == spec.num_actions == len(set(spec.action_names))
    assert len(spec.event_weights) == spec.num_events == len(set(spec.event_names)) > 0
    assert spec.score_name and len(spec.fingerprint) == 64 and int(spec.fingerprint, 16) > 0
    features = spec.views["features"]
    assert len(features.shape) == 1
    for view in spec.views.values():
        assert view.scale >= 1.0 or view.binary
        assert view.swap is None or sorted(view.swap) == list(range(view.shape[0]))


def test_params_make_the_same_environment_again(name):
    spec = make_env(name, seed=5).spec
    again = make_env(spec.name, 3, **json.loads(json.dumps(spec.params))).spec
    assert again.fingerprint == spec.fingerprint
    assert dataclasses.asdict(again) == dataclasses.asdict(spec)


def test_simulate_is_step_for_any_leading_shape(name):
    env = make_env(name, BATCH, seed=3)
    play(env, 12, seed=1)
    env.set_time(np.arange(BATCH) + env.spec.horizon - BATCH + 1)
    before, rng = env.get_state(), np.random.default_rng(0)
    actions = rng.integers(env.spec.num_actions, size=(BATCH, 2))
    following, simulated = env.simulate(before.reshape(2, BATCH // 2, -1), actions.reshape(2, BATCH // 2, 2))
    assert np.array_equal(env.get_state(), before), "simulate must not touch the environment's own states"
    batch = env.step(actions)
    assert np.array_equal(following.reshape(before.shape), env.get_state()) and batch.done.any()
    for field in dataclasses.fields(batch):
        stepped, pure = getattr(batch, field.name), getattr(simulated, field.name)
        assert pure.shape[:2] == (2, BATCH // 2) and np.array_equal(pure.reshape(stepped.shape), stepped), field.name
    single, one = env.simulate(before[0], actions[0])
    assert np.array_equal(single, following[0, 0])
    assert one.reward.shape == () and one.events.shape == batch.events[0].shape
    for wrong in (actions[:1], actions[0] + env.spec.num_actions):
        with pytest.raises(ValueError):
            env.simulate(before[0], wrong)


def test_step_shapes_and_dtypes(name):
    env = make_env(name, BATCH)
    assert isinstance(env, BatchedEnv) and env.num_envs == BATCH
    (batch,) = play(env, 1)
    for array, shape, dtype in [
        (batch.reward, (BATCH,), np.float32),
        (batch.score, (BATCH,), np.float32),
        (batch.events, (BATCH, 2, env.spec.num_events), np.uint8),
        (batch.terminated, (BATCH,), np.bool_),
        (batch.truncated, (BATCH,), np.bool_),
    ]:
        assert (array.shape, array.dtype) == (shape, dtype)
    states = env.get_state()
    assert (states.shape, str(states.dtype)) == ((BATCH, env.spec.state_size), env.spec.state_dtype)


def test_step_results_are_not_overwritten_by_the_next_step(name):
    env = make_env(name, BATCH)
    first = play(env, 1)[0]
    kept = [np.array(array) for array in dataclasses.astuple(first)]
    observation, states = env.observe(), env.get_state()
    kept_observation, kept_states = observation.copy(), states.copy()
    play(env, 40)
    for array, copy in zip(dataclasses.astuple(first), kept, strict=True):
        np.testing.assert_array_equal(array, copy)
    np.testing.assert_array_equal(observation, kept_observation)
    np.testing.assert_array_equal(states, kept_states)


def test_encode_takes_any_leading_shape(name):
    env = make_env(name, BATCH)
    play(env, 9)
    states = env.get_state()
    for view, seen in env.spec.views.items():
        flat = env.encode(states, view)
        assert (flat.shape, str(flat.dtype)) == ((BATCH, 2, *seen.shape), seen.dtype)
        np.testing.assert_array_equal(flat, env.observe(view))
        np.testing.assert_array_equal(env.encode(states.reshape(2, 3, -1), view).reshape(flat.shape), flat)
        np.testing.assert_array_equal(env.encode(states[4], view), flat[4])
        np.testing.assert_array_equal(env.encode(states[::-1], view), flat[::-1])
        assert env.encode(states[:0], view).shape == (0, 2, *seen.shape)
        largest = seen.scale if seen.maxima is None else np.array(seen.maxima)
        assert (flat <= largest).all() and (not seen.binary or set(np.unique(flat)) <= {0, 1})
        if seen.swap is not None:
            np.testing.assert_array_equal(flat[:, 1], flat[:, 0][:, list(seen.swap)])
    with pytest.raises(ValueError, match="view"):
        env.encode(states, "no_such_view")


def test_state_is_all_that_determines_the_future(name):
    env = make_env(name, BATCH, seed=1)
    play(env, 13, seed=4)
    kept = env.get_state()
    other = make_env(name, BATCH, seed=2)
    play(other, 3, seed=9)
    order = np.array([5, 0, 3, 1, 4, 2])
    other.set_state(kept[order], indices=order)
    rng = np.random.default_rng(6)
    for _ in range(30):
        actions = rng.integers(env.spec.num_actions, size=(BATCH, 2))
        mine, theirs = env.step(actions), other.step(actions)
        for left, right in zip(dataclasses.astuple(mine), dataclasses.astuple(theirs), strict=True):
            np.testing.assert_array_equal(left, right)
        np.testing.assert_array_equal(env.get_state(), other.get_state())
    assert (env.get_state() != kept).any()
    env.get_state()[:] = 0
    np.testing.assert_array_equal(env.get_state(), other.get_state())
    np.testing.assert_array_equal(env.get_state(np.array([2, 0])), other.get_state()[[2, 0]])


def test_set_state_of_some_rows_leaves_the_others(name):
    env = make_env(name, BATCH)
    start = env.get_state()
    play(env, 5)
    played = env.get_state()
    env.set_state(start[:2], indices=np.array([1, 4]))
    after = env.get_state()
    np.testing.assert_array_equal(after[[1, 4]], start[:2])
    np.testing.assert_array_equal(after[[0, 2, 3, 5]], played[[0, 2, 3, 5]])
    assert (played != start).any(axis=1).all()


def test_bad_states_and_actions_are_refused(name):
    env = make_env(name, BATCH)
    states = env.get_state()
    for bad in (states[:-1], states[:, :-1], states.astype(np.complex128)):
        with pytest.raises(ValueError):
            env.set_state(bad)
    good = np.zeros((BATCH, 2), dtype=np.int64)
    too_large, negative = good.copy(), good.copy()
    too_large[3, 1], negative[0, 0] = env.spec.num_actions, -1
    for bad in (good[:-1], good[:, :1], too_large, negative):
        with pytest.raises(ValueError):
            env.step(bad)
    np.testing.assert_array_equal(env.get_state(), states)


def test_seeds_decide_everything(name):
    first, second = make_env(name, BATCH, seed=21), make_env(name, BATCH, seed=21)
    third = make_env(name, BATCH, seed=22)
    third.reset(seed=21)
    runs = [(play(env, 60), env.get_state()) for env in (first, second, third)]
    for batches, states in runs[1:]:
        np.testing.assert_array_equal(states, runs[0][1])
        for mine, theirs in zip(batches, runs[0][0], strict=True):
            np.testing.assert_array_equal(mine.events, theirs.events)
            np.testing.assert_array_equal(mine.reward, theirs.reward)


def test_done_happens_once_and_nothing_resets_by_itself(name):
    env = make_env(name, BATCH)
    horizon = env.spec.horizon
    env.set_time(np.arange(horizon - BATCH, horizon))
    assert env.time(env.get_state()).tolist() == list(range(horizon - BATCH, horizon))
    still = np.zeros((BATCH, 2), dtype=np.int64)
    batch = env.step(still)
    assert batch.done.tolist() == [False] * (BATCH - 1) + [True]
    assert not (batch.truncated & batch.terminated).any()
    np.testing.assert_array_equal(batch.done, batch.truncated | batch.terminated)
    times = env.time(env.get_state())
    assert times.tolist() == list(range(horizon - BATCH + 1, horizon + 1)) and times.dtype == np.int64
    env.reset(indices=np.flatnonzero(batch.done))
    assert env.time(env.get_state()).tolist() == [*range(horizon - BATCH + 1, horizon), 0]
    assert env.step(still).done.tolist() == [False] * (BATCH - 2) + [True, False]


def test_time_takes_any_leading_shape(name):
    env = make_env(name, BATCH)
    env.set_time(np.arange(BATCH))
    states = env.get_state()
    np.testing.assert_array_equal(env.time(states.reshape(3, 2, -1)), np.arange(BATCH).reshape(3, 2))
    assert env.time(states[2]) == 2


def test_renders_each_row(name):
    env = make_env(name, 2)
    env.step(np.array([[1, 2], [0, 0]]))
    env.step(np.array([[1, 2], [0, 0]]))
    assert env.render_text(0) != env.render_text(1)
    picture = env.render_rgb(1)
    assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    assert (env.render_rgb(0) != picture).any()


def test_bad_names_and_parameters_are_user_errors(name):
    family = name.partition("/")[0]
    for bad in ("", "chess/board", family, f"{family}/no_such_variant"):
        with pytest.raises(UserError) as caught:
            make_env(bad)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no_such_parameter"):
        make_env(name, no_such_parameter=1)
    with pytest.raises(UserError, match="num_envs"):
        make_env(name, 0)
