"""The PettingZoo view: PettingZoo's own tests for every registered environment, and what it hands through."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

from popgen.envs import env_names, make_env
from popgen.envs.parallel import PopgenParallelEnv, parallel_env
from popgen.errors import UserError

AGENTS = ["player_0", "player_1"]


def every_view():
    return [(name, view) for name in env_names() for view in make_env(name).spec.views]


@pytest.mark.parametrize("render_mode", ["rgb_array", "ansi"])
@pytest.mark.parametrize("name", env_names())
def test_pettingzoo_parallel_api(name, render_mode):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(parallel_env(name, render_mode=render_mode), num_cycles=450)


@pytest.mark.parametrize(("name", "view"), every_view())
def test_pettingzoo_seeds(name, view):
    parallel_seed_test(lambda: parallel_env(name, view=view, reward="events"), num_cycles=100)


@pytest.mark.parametrize(("name", "view"), every_view())
def test_observations_lie_in_their_spaces(name, view):
    env = parallel_env(name, view=view)
    observations, _ = env.reset(seed=1)
    rng = np.random.default_rng(1)
    while env.agents:
        assert list(observations) == AGENTS
        for agent in AGENTS:
            assert env.observation_space(agent).contains(observations[agent])
        assert env.state_space.contains(env.state())
        np.testing.assert_array_equal(env.state(), np.stack([observations[agent] for agent in AGENTS]))
        actions = rng.integers(env.action_space(AGENTS[0]).n, size=2)
        observations, *_ = env.step(dict(zip(AGENTS, actions, strict=True)))


@pytest.mark.parametrize("name", env_names())
def test_follows_the_batched_environment(name):
    inner = make_env(name, seed=11)
    by_environment, by_events = (parallel_env(name, reward=reward) for reward in ("environment", "events"))
    weights = np.array(inner.spec.event_weights)
    rng, joint, occurred = np.random.default_rng(0), np.zeros(2, dtype=np.int64), 0
    for seed in range(3):
        inner.reset(seed=seed)
        by_environment.reset(seed=seed)
        by_events.reset(seed=seed)
        while by_environment.agents:
            joint = np.where(rng.random(2) < 0.6, joint, rng.integers(inner.spec.num_actions, size=2))
            actions, batch = dict(zip(AGENTS, joint, strict=True)), inner.step(joint[None])
            observations, rewards, terminated, truncated, infos = by_environment.step(actions)
            assert rewards == dict.fromkeys(AGENTS, float(batch.reward[0]))
            assert by_events.step(actions)[1] == dict.fromkeys(AGENTS, float((batch.events[0] * weights).sum()))
            assert terminated == dict.fromkeys(AGENTS, bool(batch.terminated[0]))
            assert truncated == dict.fromkeys(AGENTS, bool(batch.truncated[0]))
            for player, agent in enumerate(AGENTS):
                np.testing.assert_array_equal(observations[agent], inner.observe()[0, player])
                assert list(infos[agent]["events"]) == list(inner.spec.event_names)
                assert list(infos[agent]["events"].values()) == batch.events[0, player].tolist()
                assert infos[agent]["score"] == batch.score[0]
            occurred += int(batch.events.sum())
        assert batch.done[0] and by_events.agents == []
    assert occurred > 0


@pytest.mark.parametrize("name", env_names())
def test_reset_to_a_given_state(name):
    inner = make_env(name, seed=2)
    rng = np.random.default_rng(3)
    for _ in range(5):
        inner.step(rng.integers(inner.spec.num_actions, size=(1, 2)))
    row = inner.get_state()[0]
    for given in (row, row.tolist()):
        env = parallel_env(name)
        observations, infos = env.reset(options={"state": given})
        np.testing.assert_array_equal(env.env.get_state()[0], row)
        np.testing.assert_array_equal(observations["player_1"], inner.observe()[0, 1])
        assert set(infos["player_0"]["events"].values()) == {0} and infos["player_0"]["score"] == 0.0
    with pytest.raises(ValueError, match="states"):
        env.reset(options={"state": row[:-1]})


@pytest.mark.parametrize("name", env_names())
def test_render_modes(name):
    picture = parallel_env(name, render_mode="rgb_array")
    text, silent = parallel_env(name, render_mode="ansi"), parallel_env(name)
    for env in (picture, text, silent):
        env.reset(seed=0)
    frame = picture.render()
    assert frame.ndim == 3 and frame.shape[2] == 3 and frame.dtype == np.uint8 and len(np.unique(frame)) > 2
    assert text.render() == text.env.render_text(0) and len(text.render().splitlines()) > 1
    assert silent.render() is None
    assert set(picture.metadata["render_modes"]) == {"rgb_array", "ansi"}
    assert picture.metadata["name"] == name


def test_reset_hands_the_seed_on():
    env = parallel_env("rendezvous/mppmr", start_noise=0.2, seed=1)
    starts = [env.reset(seed=seed)[0]["player_0"].tolist() for seed in (5, None, 6, 5)]
    assert starts[3] == starts[0]
    assert starts[1] != starts[0] != starts[2] != starts[1]


def test_a_finished_episode_must_be_reset():
    env = parallel_env("rendezvous/mppmr", horizon=1)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(dict.fromkeys(AGENTS, 0))
    env.reset()
    _, _, terminated, truncated, _ = env.step(dict.fromkeys(AGENTS, 0))
    assert terminated == dict.fromkeys(AGENTS, True) and truncated == dict.fromkeys(AGENTS, False)
    with pytest.raises(RuntimeError, match="reset"):
        env.step(dict.fromkeys(AGENTS, 0))


def test_actions_are_checked():
    env = parallel_env("rendezvous/mppmr")
    env.reset()
    with pytest.raises(ValueError, match="player_1"):
        env.step({"player_0": 0})
    with pytest.raises(ValueError, match="actions"):
        env.step({"player_0": 0, "player_1": 5})


@pytest.mark.parametrize(
    ("options", "field"),
    [({"view": "pixels"}, "view"), ({"reward": "shaped"}, "reward"), ({"render_mode": "human"}, "render_mode")],
)
def test_unknown_choices_are_user_errors(options, field):
    with pytest.raises(UserError) as caught:
        parallel_env("rendezvous/mppmr", **options)
    assert caught.value.field == field


def test_a_batch_is_refused():
    with pytest.raises(UserError, match="num_envs"):
        PopgenParallelEnv(make_env("rendezvous/mppmr", 2))


@pytest.mark.parametrize("action", [2.7, "2", None, np.float32(1.0), [1], np.array([1.5])])
def test_an_action_that_is_no_whole_number_is_refused_and_not_cast(action):
    env = parallel_env("overcooked/cramped_room")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="player_0 plays .* no whole number"):
        env.step({"player_0": action, "player_1": 4})


@pytest.mark.parametrize("action", [2, np.int64(2), np.uint8(2), np.array(2), np.array([2]), True])
def test_every_integer_type_is_an_action(action):
    env = parallel_env("overcooked/cramped_room")
    env.reset(seed=0)
    assert env.step({"player_0": action, "player_1": 4})[1]


@pytest.mark.parametrize(("dtype", "kept"), [("float32", "float32"), ("float64", "float64"), (None, "uint8")])
def test_observations_come_in_the_type_that_a_network_takes(dtype, kept):
    """RLlib's default network takes no bytes; the values are the same."""
    env, plain = parallel_env("overcooked/cramped_room", dtype=dtype), parallel_env("overcooked/cramped_room")
    (seen, _), (bytes_, _) = env.reset(seed=3), plain.reset(seed=3)
    for agent in env.possible_agents:
        assert seen[agent].dtype == env.observation_space(agent).dtype == np.dtype(kept)
        assert env.observation_space(agent).contains(seen[agent])
        assert (seen[agent] == bytes_[agent]).all()


def test_a_type_that_cannot_hold_the_values_is_refused():
    with pytest.raises(UserError, match="dtype"):
        parallel_env("rendezvous/mppmr", dtype="uint8")
