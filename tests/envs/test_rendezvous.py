"""Rendezvous against a formula of its own, written in plain scalars, and by hand."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from popgen.envs import make_env
from popgen.envs.rendezvous import RendezvousEnv, worst_reward
from popgen.errors import UserError

STAY, LEFT, RIGHT, DOWN, UP = range(5)
PUSH = {STAY: (0.0, 0.0), LEFT: (-1.0, 0.0), RIGHT: (1.0, 0.0), DOWN: (0.0, -1.0), UP: (0.0, 1.0)}


def scalar_step(
    state, actions, *, dt=0.1, damping=0.25, force=5.0, bound=1.5, horizon=50, exit_reward=-4.303300858899106
):
    """One step in Python floats: (next state, reward, leavers, terminated, truncated)."""
    players, after = (list(state[0:4]), list(state[4:8])), []
    for (x, y, vx, vy), action in zip(players, actions, strict=True):
        ux, uy = PUSH[int(action)]
        vx, vy = vx * (1.0 - damping) + force * ux * dt, vy * (1.0 - damping) + force * uy * dt
        after.append((x + vx * dt, y + vy * dt, vx, vy))
    (x0, y0, *_), (x1, y1, *_) = after
    cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
    nearest = min(math.sqrt((lx - cx) ** 2 + (ly - cy) ** 2) for lx in (-0.75, 0.75) for ly in (-0.75, 0.75))
    reward = 1.0 - nearest - math.sqrt((x0 - x1) ** 2 + (y0 - y1) ** 2)
    leavers = [abs(x) > bound or abs(y) > bound for x, y, _, _ in after]
    time = state[8] + 1
    if any(leavers):
        reward += (horizon - time) * exit_reward
    return [*after[0], *after[1], time], reward, leavers, any(leavers), time >= horizon and not any(leavers)


def drifting_actions(rng, steps, envs):
    """Random actions that persist for a few steps; the first environments often leave, the last mostly stay."""
    actions = rng.integers(0, 5, size=(steps, envs, 2)).astype(np.uint8)
    actions[rng.random(actions.shape) < np.linspace(0.0, 0.95, envs)[:, None]] = STAY
    keep = rng.random(actions.shape) < np.linspace(0.9, 0.0, envs)[:, None]
    for t in range(1, steps):
        actions[t] = np.where(keep[t], actions[t - 1], actions[t])
    return actions


def body(x, y, vx=0.0, vy=0.0):
    return [x, y, vx, vy]


def state_of(first, second, time=0):
    return np.array([[*first, *second, time]], dtype=np.float64)


def test_equal_to_scalar_formula_on_25_600_steps():
    envs, steps = 64, 400
    env = RendezvousEnv("mppmr", envs, seed=3, start_noise=0.5, ending="truncated")
    rows = [list(row) for row in env.get_state()]
    exits = truncations = 0
    for joint in drifting_actions(np.random.default_rng(7), steps, envs):
        batch = env.step(joint)
        states = env.get_state()
        for b in range(envs):
            rows[b], reward, leavers, terminated, truncated = scalar_step(rows[b], joint[b])
            assert rows[b] == list(states[b])
            assert np.float32(reward) == batch.reward[b] == batch.score[b]
            assert leavers == list(batch.events[b, :, 0] == 1)
            assert (terminated, truncated) == (batch.terminated[b], batch.truncated[b])
        exits, truncations = exits + batch.terminated.sum(), truncations + batch.truncated.sum()
        finished = np.flatnonzero(batch.done)
        env.reset(indices=finished)
        for b in finished:
            rows[b] = list(env.get_state()[b])
    assert exits > 100 and truncations > 100


def test_one_push_by_hand():
    env = RendezvousEnv()
    env.step(np.array([[RIGHT, UP]]))
    # 5 * 0.1 = 0.5 of velocity, 0.05 of distance
    np.testing.assert_allclose(env.get_state()[0], [0.35, 0, 0.5, 0, -0.3, 0.05, 0, 0.5, 1], atol=1e-15)
    env.step(np.array([[STAY, UP]]))
    np.testing.assert_allclose(env.get_state()[0], [0.3875, 0, 0.375, 0, -0.3, 0.1375, 0, 0.875, 2], atol=1e-15)


def test_position_first_moves_with_the_old_velocity():
    env = RendezvousEnv(integration="position_first")
    env.step(np.array([[RIGHT, STAY]]))
    np.testing.assert_allclose(env.get_state()[0, :4], [0.3, 0, 0.5, 0], atol=1e-15)
    env.step(np.array([[STAY, STAY]]))
    np.testing.assert_allclose(env.get_state()[0, :4], [0.35, 0, 0.375, 0], atol=1e-15)


@pytest.mark.parametrize("integration", ["velocity_first", "position_first"])
def test_dynamics_are_linear(integration):
    env = RendezvousEnv(integration=integration)
    rng = np.random.default_rng(0)
    first, second = np.zeros((2, 500, 9))
    first[:, :8], second[:, :8] = rng.normal(size=(2, 500, 8))
    still, pushed = np.zeros((500, 2), dtype=np.uint8), rng.integers(0, 5, size=(500, 2))

    def moved(states, actions):
        return env.simulate(states, actions)[0][:, :8]

    mixed = 0.3 * first + 1.7 * second
    np.testing.assert_allclose(moved(mixed, still), 0.3 * moved(first, still) + 1.7 * moved(second, still), atol=1e-12)
    kick = moved(np.zeros((500, 9)), pushed)
    np.testing.assert_allclose(moved(first, pushed), moved(first, still) + kick, atol=1e-12)
    opposite = np.array([STAY, RIGHT, LEFT, UP, DOWN])[pushed]
    np.testing.assert_allclose(moved(np.zeros((500, 9)), opposite), -kick, atol=0)
    assert np.abs(kick).max() > 0.1


def test_simulate_is_pure_and_equals_step():
    env = RendezvousEnv(num_envs=5, start_noise=0.2, seed=1)
    before, actions = env.get_state(), np.array([[0, 1], [2, 3], [4, 0], [1, 1], [3, 2]])
    given = before.copy()
    following, simulated = env.simulate(given, actions)
    assert (given == before).all() and (env.get_state() == before).all()
    stepped = env.step(actions)
    assert (env.get_state() == following).all()
    assert (simulated.reward == stepped.reward).all() and (simulated.events == stepped.events).all()
    folded, outcome = env.simulate(before[1:].reshape(2, 2, 9), actions[1:].reshape(2, 2, 2))
    assert (folded == following[1:].reshape(2, 2, 9)).all()
    assert (outcome.events == stepped.events[1:].reshape(2, 2, 2, 1)).all()
    assert (outcome.reward == stepped.reward[1:].reshape(2, 2)).all()
    single, outcome = env.simulate(before[0], actions[0])
    assert (single == following[0]).all() and outcome.reward.shape == () and outcome.reward == stepped.reward[0]


def test_restart_from_a_state_gives_the_same_future():
    env = RendezvousEnv(num_envs=8, seed=5, start_noise=0.3)
    script = drifting_actions(np.random.default_rng(2), 20, 8)
    for joint in script[:7]:
        env.step(joint)
    kept = env.get_state()
    rewards = [env.step(joint).reward for joint in script[7:]]
    other = RendezvousEnv(num_envs=8, seed=99)
    other.set_state(kept[::-1].copy(), indices=np.arange(7, -1, -1))
    assert (other.get_state() == kept).all()
    assert (np.array(rewards) == np.array([other.step(joint).reward for joint in script[7:]])).all()
    assert (env.get_state() == other.get_state()).all()


def test_getting_a_state_gives_a_copy():
    env = RendezvousEnv(num_envs=2)
    env.get_state()[:] = 7
    env.get_state(np.array([1]))[:] = 7
    assert env.get_state().max() < 1


@pytest.mark.parametrize(
    ("first", "second", "leavers"),
    [
        (body(1.48, 0, 1.0), body(0, 0), [1, 0]),
        (body(0, 0), body(0, -1.48, 0, -1.0), [0, 1]),
        (body(-1.48, 0, -1.0), body(0, 1.48, 0, 1.0), [1, 1]),
        (body(1.48, 0, -1.0), body(0, 0), [0, 0]),
        (body(1.5, -1.5), body(-1.5, 1.5), [0, 0]),
    ],
)
def test_an_exit_counts_for_the_leaver_only(first, second, leavers):
    env = RendezvousEnv()
    env.set_state(state_of(first, second, 4))
    batch = env.step(np.array([[STAY, STAY]]))
    assert batch.events[0, :, 0].tolist() == leavers
    assert batch.terminated[0] == any(leavers) and not batch.truncated[0]


def test_penalty_by_hand():
    start = state_of(body(1.48, 0.75, 1.0), body(1.48, 0.75), 29)
    actions = np.array([[STAY, STAY]])
    # Player 0 arrives at x = 1.48 + 0.75 * 0.1 = 1.555; the centroid is (1.5175, 0.75), 20 steps remain.
    plain = 1 - (1.5175 - 0.75) - 0.075
    for options, expected in [
        ({}, plain + 20 * (1 - 0.75 * 2**0.5 - 3 * 2**0.5)),
        ({"distance": "centroid"}, plain + 0.0375 + 20 * (1 - 0.75 * 2**0.5 - 1.5 * 2**0.5)),
        ({"exit_reward": -2.5}, plain - 50),
        ({"exit_penalty": "none"}, plain),
    ]:
        _, batch = RendezvousEnv(**options).simulate(start, actions)
        assert batch.terminated[0]
        assert batch.reward[0] == pytest.approx(expected, abs=1e-5)


def test_leaving_at_the_last_step_is_terminal_and_free():
    _, batch = RendezvousEnv().simulate(state_of(body(1.48, 0, 1.0), body(0, 0), 49), np.array([[0, 0]]))
    assert batch.terminated[0] and not batch.truncated[0]
    assert batch.reward[0] > -4.4


@pytest.mark.parametrize("ending", ["terminal", "truncated"])
def test_the_horizon_is_a_true_end_or_a_cut(ending):
    env = RendezvousEnv(num_envs=3, horizon=4, ending=ending)
    env.set_time(np.array([0, 2, 3]))
    batches = [env.step(np.zeros((3, 2), dtype=np.uint8)) for _ in range(2)]
    over = [[False, False, True], [False, True, True]]
    none = [[False] * 3] * 2
    assert [batch.terminated.tolist() for batch in batches] == (over if ending == "terminal" else none)
    assert [batch.truncated.tolist() for batch in batches] == (none if ending == "terminal" else over)
    assert env.time(env.get_state()).tolist() == [2, 4, 5]
    still = 1 - 0.75 * 2**0.5 - 0.6
    assert batches[1].reward == pytest.approx([still] * 3, abs=1e-6)  # the horizon itself costs nothing


def test_rules_that_differ_in_the_ending_are_different_rules():
    assert RendezvousEnv().spec.fingerprint != RendezvousEnv(ending="truncated").spec.fingerprint
    with pytest.raises(UserError, match="ending"):
        RendezvousEnv(ending="open")


@pytest.mark.parametrize("distance", ["full", "centroid"])
@pytest.mark.parametrize(("bounds", "landmark"), [(1.5, 0.75), (1.5, 0.0), (2.0, 2.0), (1.0, 0.2)])
def test_worst_reward_is_the_least_on_a_grid(distance, bounds, landmark):
    env = RendezvousEnv(distance=distance, bounds=bounds, landmark_distance=landmark, start_distance=0.1)
    axis = np.linspace(-bounds, bounds, 13)
    places = np.stack(np.meshgrid(axis, axis, axis, axis), axis=-1).reshape(-1, 4)
    states = np.zeros((len(places), 9))
    states[:, [0, 1, 4, 5]] = places
    _, batch = env.simulate(states, np.zeros((len(places), 2), dtype=np.uint8))
    assert not batch.terminated.any()
    assert batch.reward.min() == pytest.approx(worst_reward(bounds, landmark, distance), abs=1e-5)
    assert env.exit_reward == worst_reward(bounds, landmark, distance)


def test_features_by_hand():
    env = RendezvousEnv()
    states = state_of(body(0.1, 0.2, 0.3, 0.4), body(0.5, 0.6, 0.7, 0.8), 10)
    own, other = env.encode(states)[0]
    np.testing.assert_allclose(own[:8], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8], rtol=1e-6)
    np.testing.assert_allclose(own[8:16], [-0.85, -0.95, -0.85, 0.55, 0.65, -0.95, 0.65, 0.55], rtol=1e-6)
    np.testing.assert_allclose(own[16:24], [-1.25, -1.35, -1.25, 0.15, 0.25, -1.35, 0.25, 0.15], rtol=1e-5)
    assert own[24] == np.float32(0.2)
    np.testing.assert_array_equal(other, own[list(env.spec.views["features"].swap)])


def test_seat_symmetry():
    env = RendezvousEnv()
    rng = np.random.default_rng(4)
    states = np.zeros((300, 9))
    states[:, :8] = rng.uniform(-1.6, 1.6, size=(300, 8))
    actions = rng.integers(0, 5, size=(300, 2))
    seats = [4, 5, 6, 7, 0, 1, 2, 3, 8]
    following, batch = env.simulate(states, actions)
    mirrored, swapped = env.simulate(states[:, seats], actions[:, ::-1])
    assert (mirrored == following[:, seats]).all()
    assert (swapped.reward == batch.reward).all() and (swapped.events == batch.events[:, ::-1]).all()
    assert batch.terminated.any() and not batch.terminated.all()


def test_features_stay_within_the_scale_of_the_view():
    env = RendezvousEnv(num_envs=4)
    for joint in ([RIGHT, LEFT], [UP, DOWN]):
        env.reset()
        for _ in range(50):
            batch = env.step(np.tile(joint, (4, 1)))
            assert np.abs(env.observe()).max() <= env.spec.views["features"].scale
            if batch.done.any():
                break
        assert batch.terminated.all()


def test_start_noise_is_seeded_bounded_and_drawn_per_row():
    env = RendezvousEnv(num_envs=500, seed=8, start_noise=0.25)
    starts = env.get_state()
    shift = starts[:, [0, 1, 4, 5]] - [0.3, 0, -0.3, 0]
    assert np.abs(shift).max() <= 0.25 and np.abs(shift).max() > 0.24 and abs(shift.mean()) < 0.02
    assert (starts[:, [2, 3, 6, 7, 8]] == 0).all()
    env.reset(indices=np.array([3, 5]))
    changed = (env.get_state() != starts).any(axis=1)
    assert np.flatnonzero(changed).tolist() == [3, 5]
    env.reset(seed=8)
    assert (env.get_state() == starts).all()


def test_without_noise_the_start_is_lipos():
    assert RendezvousEnv(num_envs=2, seed=1).get_state().tolist() == [[0.3, 0, 0, 0, -0.3, 0, 0, 0, 0]] * 2


def test_fingerprint_follows_the_rules_not_the_seed():
    base = RendezvousEnv(seed=1)
    assert RendezvousEnv(num_envs=4, seed=2).spec.fingerprint == base.spec.fingerprint
    assert RendezvousEnv(exit_reward=base.exit_reward).spec.fingerprint == base.spec.fingerprint
    changes = [
        {"timestep": 0.2},
        {"damping": 0.3},
        {"sensitivity": 4.0},
        {"bounds": 1.6},
        {"landmark_distance": 0.5},
        {"start_distance": 0.2},
        {"start_noise": 0.1},
        {"horizon": 60},
        {"distance": "centroid"},
        {"exit_penalty": "none"},
        {"exit_reward": -1.0},
        {"integration": "position_first"},
    ]
    prints = {RendezvousEnv(**change).spec.fingerprint for change in changes} | {base.spec.fingerprint}
    assert len(prints) == len(changes) + 1
    for change in changes:
        spec = RendezvousEnv(**change).spec
        assert make_env(spec.name, **json.loads(json.dumps(spec.params))).spec == spec


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("timestep", 0.0),
        ("timestep", -0.1),
        ("timestep", math.nan),
        ("timestep", "0.1"),
        ("damping", -0.01),
        ("damping", 1.01),
        ("damping", math.nan),
        ("sensitivity", -1.0),
        ("sensitivity", math.inf),
        ("bounds", 0.0),
        ("landmark_distance", 1.6),
        ("landmark_distance", -0.1),
        ("start_distance", 2.0),
        ("start_noise", -0.1),
        ("start_noise", 1.3),
        ("horizon", 0),
        ("horizon", 2.5),
        ("horizon", True),
        ("distance", "euclid"),
        ("exit_penalty", "some"),
        ("exit_reward", 1.0),
        ("exit_reward", math.nan),
        ("integration", "leapfrog"),
    ],
)
def test_bad_parameters_are_told_in_one_line(field, value):
    with pytest.raises(UserError) as caught:
        make_env("rendezvous/mppmr", **{field: value})
    assert caught.value.field == f"env.{field}"
    assert "\n" not in str(caught.value)


def test_contradicting_exit_parameters_are_refused():
    with pytest.raises(UserError, match=r"env\.exit_reward"):
        make_env("rendezvous/mppmr", exit_penalty="none", exit_reward=-1.0)


def test_states_that_are_no_states_are_refused():
    env = RendezvousEnv(num_envs=2)
    good = env.get_state()
    for bad in (good[:1], good[:, :8], good.astype(np.float32), np.full((2, 9), np.nan)):
        with pytest.raises(ValueError, match="states"):
            env.set_state(bad)
    assert (env.get_state() == good).all()


def test_pictures_show_both_players_and_the_landmarks():
    env = RendezvousEnv(num_envs=2)
    env.set_state(state_of(body(1.5, 1.5), body(-1.5, -1.5), 3), indices=np.array([1]))
    lines = env.render_text(1).splitlines()
    assert (len(lines), {len(line) for line in lines[:-1]}) == (16, {31})
    assert lines[0][-1] == "0" and lines[14][0] == "1" and sum(line.count("L") for line in lines) == 4
    assert "step 3/50" in lines[-1]
    env.set_state(state_of(body(0, 0), body(0, 0)), indices=np.array([1]))
    assert env.render_text(1).splitlines()[7][15] == "8"
    picture = env.render_rgb(0)
    assert picture.shape == (256, 256, 3) and picture.dtype == np.uint8
    middle, offset = 128, 0.3 * 224 / 3
    assert tuple(picture[middle, round(middle + offset)]) == (0, 114, 178)
    assert tuple(picture[middle, round(middle - offset)]) == (255, 255, 255)
    assert tuple(picture[middle, round(middle - offset) - 4]) == (213, 94, 0)
    assert tuple(picture[middle - 56, middle + 56]) == (160, 160, 160)
