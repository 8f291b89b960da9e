"""A population as one talks to it in Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import popgen
from popgen.envs import make_env
from popgen.envs.parallel import parallel_env
from popgen.errors import UserError
from popgen.methods.xpm_wm.actor_critic import WorldModelPolicy
from popgen.methods.xpm_wm.config import XpmWmRun


@pytest.fixture(scope="module")
def population(random_population: Path) -> popgen.population.Population:
    return popgen.load_population(random_population)


def test_two_members_play_as_the_matrix_says(population: popgen.population.Population) -> None:
    episodes = population.play(1, 2, episodes=20, seed=3)
    again = population.play(1, 2, episodes=20, seed=3)
    assert len(episodes) == 20 and episodes.seats.tolist() == [[0, 1]] * 20
    np.testing.assert_array_equal(episodes.reward, again.reward)
    frame = episodes.to_frame()
    assert list(frame.columns) == [
        "seat_0",
        "shaped_0",
        "seat_1",
        "shaped_1",
        "score",
        "reward",
        "length",
        "terminated",
    ]
    assert frame.shape == (20, 8) and (frame["length"] == 20).all()
    assert population.play(2, episodes=1).seats.tolist() == [[0, 0]]  # alone: with itself
    assert population.play("idle", 1, episodes=2).events[:, 0].sum() == 0


@pytest.mark.parametrize(
    ("players", "error", "told"),
    [
        ((1, 3), IndexError, "no member 3"),
        ((0,), IndexError, "no member 0"),
        ((1, 2, 1), ValueError, "3 given for 2 seats"),
        ((), ValueError, "0 given for 2 seats"),
        (("greedy", 1), ValueError, "'random' or 'idle'"),
        ((1.5, 1), TypeError, "must be an integer"),
    ],
)
def test_who_cannot_play_is_told(
    players: tuple[object, ...], error: type[Exception], told: str, population: popgen.population.Population
) -> None:
    with pytest.raises(error, match=told):
        population.play(*players, episodes=1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="episodes must be at least 1"):
        population.play(1, 2, episodes=0)


def test_the_matrix_is_a_frame(population: popgen.population.Population) -> None:
    matrix = popgen.evaluate_population(population, episodes=2)
    frame = matrix.to_frame()
    assert frame.shape == (2, 2) and frame.loc["1", "2"] == matrix.score(1, 2).mean


def test_what_is_printed_is_worth_reading(population: popgen.population.Population) -> None:
    for thing, said in (
        (population, "<Population of 2 members by xpm_wm in overcooked/cramped_room, seed 0: "),
        (population.make_env(num_envs=3), "<OvercookedEnv overcooked/cramped_room: 3 environments, 20 steps"),
        (make_env("rendezvous/mppmr"), "<RendezvousEnv rendezvous/mppmr: 1 environment, 50 steps"),
        (population.play(1, 2, episodes=2), "<2 episodes: score 0.00 (from 0 to 0), "),
        (
            popgen.evaluate_population(population, episodes=1),
            "<SP/XP of 2 members of xpm_wm in overcooked/cramped_room",
        ),
    ):
        assert repr(thing).startswith(said) and len(repr(thing)) < 300, repr(thing)
    assert len(repr(population.spec)) < 2000


def test_an_environment_by_the_names_of_its_arguments() -> None:
    with make_env("overcooked/cramped_room", num_envs=8, horizon=10) as env:
        assert env.num_envs == 8 and env.observe().shape[0] == 8
    assert make_env("rendezvous/mppmr", np.int64(2)).num_envs == 2
    for wrong in (0, -1, 2.5, True, "8"):
        with pytest.raises(UserError, match="^num_envs: must be a whole number"):
            make_env("overcooked/cramped_room", num_envs=wrong)  # type: ignore[arg-type]


def test_acting_before_a_reset_or_on_other_rows_is_told() -> None:
    config, env = XpmWmRun(), make_env("overcooked/cramped_room", num_envs=2)
    policy = WorldModelPolicy(config.world_model, config.agent, env.spec)
    actions, first = np.zeros((2, 2), np.uint8), np.ones(2, bool)
    with pytest.raises(RuntimeError, match=r"reset for nothing yet: call reset\(batch=2, seed=...\) first"):
        policy.act(env.observe(policy.view), actions, first)
    policy.reset(batch=3, seed=0)
    with pytest.raises(RuntimeError, match="act on 2 rows, but reset for 3 rows"):
        policy.act(env.observe(policy.view), actions, first)


@pytest.mark.parametrize("view", ["features", "lossless"])
def test_observations_of_another_dtype_have_the_same_values(view: str) -> None:
    plain, wide = (
        parallel_env("overcooked/cramped_room", view=view),
        parallel_env("overcooked/cramped_room", view=view, dtype="float32"),
    )
    for env in (plain, wide):
        env.reset()
    for _ in range(3):
        before, after = (env.step({"player_0": 5, "player_1": 0})[0]["player_0"] for env in (plain, wide))
        assert (before.dtype, after.dtype) == (np.uint8, np.float32)
        np.testing.assert_array_equal(before, after)
    space = wide.observation_space("player_0")
    assert space.dtype == np.float32 and space.contains(after) and wide.state().dtype == np.float32
    assert wide.state_space.contains(wide.state())


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("overcooked/cramped_room", "complex64"),
        ("overcooked/cramped_room", "bytes9"),
        ("rendezvous/mppmr", "uint8"),
        ("overcooked/cramped_room", "bool"),
    ],
)
def test_a_dtype_that_would_change_values_is_refused(name: str, dtype: str) -> None:
    with pytest.raises(UserError, match="^dtype: "):
        parallel_env(name, dtype=dtype)
