"""The recorded games: all of them follow from our rules, step by step, and only the known files are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.bridge import to_overcooked_ai
from popgen.errors import UserError
from popgen.humans import recordings
from popgen.humans.behaviour import MEASURES, measure_people
from popgen.humans.recordings import FILES, LAYOUTS, HumanGame, load_games, make_human_env, read_recorded_bytes
from tests.envs.slow_events import read_events

# people's rates in 400 steps, read off the recordings by another program
DISHES = {
    "asymmetric_advantages": (8.79, 2.88),
    "coordination_ring": (5.11, 1.17),
    "cramped_room": (5.92, 1.12),
    "forced_coordination": (5.65, 1.46),
    "counter_circuit_o_1order": (4.07, 0.79),
}


@pytest.fixture(scope="module")
def games() -> list[HumanGame]:
    return load_games()


def test_every_recorded_transition_is_ours(games: list[HumanGame]) -> None:
    steps = 0
    for game in games:
        env = make_human_env(game.layout)
        following, result = env.simulate(game.states[:-1], game.actions)
        assert np.array_equal(following, game.states[1:])
        assert np.array_equal(result.score, game.dishes)
        steps += game.steps
    assert steps == 91_102
    assert len(games) == 76


def test_interact_cooking_is_not_what_was_recorded(games: list[HumanGame]) -> None:
    game = next(game for game in games if game.layout == "cramped_room")
    env = OvercookedEnv("cramped_room", 1, cooking="interact")
    assert not np.array_equal(env.simulate(game.states[:-1], game.actions)[0], game.states[1:])


def test_games_are_split_by_half_and_pair(games: list[HumanGame]) -> None:
    count = {(layout, half): 0 for layout in LAYOUTS for half in FILES}
    for game in games:
        count[game.layout, game.half] += 1
        assert make_human_env(game.layout).time(game.states).tolist() == list(range(game.steps + 1))
    assert sorted(count.values()) == [6, 6, 7, 8, 8, 8, 8, 8, 8, 9]
    seats = {(game.layout, game.half, game.pair) for game in games}
    assert len(seats) == len(games)
    assert not {(game.layout, game.pair) for game in games if game.half == "train"} & {
        (game.layout, game.pair) for game in games if game.half == "test"
    }


def test_peoples_rates_are_the_known_ones(games: list[HumanGame]) -> None:
    for layout, (mean, deviation) in DISHES.items():
        rates = measure_people([game for game in games if game.layout == layout])
        assert rates.mean[0] == pytest.approx(mean, abs=0.005)
        assert rates.deviation[0] == pytest.approx(deviation, abs=0.005)
    assert list(MEASURES)[0] == "dishes (team)"


def test_events_of_recorded_steps_equal_a_slow_reading(games: list[HumanGame]) -> None:
    from overcooked_ai_py.mdp.actions import Action

    from popgen.envs.overcooked.bridge import to_overcooked_mdp
    from popgen.envs.overcooked.transition_events import find_transition_events

    for layout in LAYOUTS:
        game = next(game for game in games if game.layout == layout)
        env = make_human_env(layout)
        mdp = to_overcooked_mdp(env)
        events = find_transition_events(env, game.states[:-1], game.actions)
        for t in range(0, game.steps, 7):
            joint = tuple(Action.INDEX_TO_ACTION[action] for action in game.actions[t])
            assert np.array_equal(events[t], read_events(mdp, to_overcooked_ai(env, game.states[t]), joint))


def test_only_the_known_files_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Spec:
        submodule_search_locations = (str(tmp_path),)

    monkeypatch.setattr(recordings.importlib.util, "find_spec", lambda name: Spec)
    with pytest.raises(UserError, match="cannot be read.*pip install overcooked-ai==1.1.0"):
        read_recorded_bytes("train")
    folder = tmp_path / "data" / "human_data"
    folder.mkdir(parents=True)
    (folder / FILES["train"].name).write_bytes(bytes(FILES["train"].size))
    with pytest.raises(UserError, match="is not the known file"):
        read_recorded_bytes("train")
    monkeypatch.setattr(recordings.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="is not installed"):
        read_recorded_bytes("test")


def test_other_layouts_have_no_people() -> None:
    with pytest.raises(UserError, match="choose one of cramped_room"):
        load_games(layouts=["bottleneck"])
    assert k.POTS == 8
