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

# people's rates in 400 steps, read off the recordings by another program: each layout's means in the order of MEASURES,
# then deviations; None where that program has none
RATES: dict[str, tuple[list[float], list[float | None]]] = {
    "asymmetric_advantages": (
        [8.79, 13.97, 4.59, 4.44, 60.2, 179, 0.30],
        [2.88, 10.69, 3.24, 3.28, 19.6, None, None],
    ),
    "coordination_ring": ([5.11, 8.26, 2.64, 2.62, 101.8, 200, 0.25], [1.17, 2.37, 1.46, 1.43, 20.9, None, None]),
    "cramped_room": ([5.92, 9.27, 3.04, 2.96, 47.6, 113, 0.36], [1.12, 5.52, 2.72, 2.66, 13.0, None, None]),
    "forced_coordination": ([5.65, 9.11, 2.95, 2.84, 35.9, 160, 13.2], [1.46, 9.77, 3.18, 3.07, 16.5, None, None]),
    "counter_circuit_o_1order": ([4.07, 6.74, 2.10, 2.08, 122.0, 201, 1.1], [0.79, 2.33, 0.98, 0.98, 29.8, None, None]),
}
CLOSE = [0.005, 0.005, 0.005, 0.005, 0.055, 0.5, 0.05]
"""Half a unit of the last digit that it gives, but for moves (60.15 here in asymmetric_advantages) and counter pick-ups
(0.31 here, there)."""


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
    for layout, (means, deviations) in RATES.items():
        rates = measure_people([game for game in games if game.layout == layout])
        for name, mean, deviation, wanted, spread, half in zip(
            MEASURES, rates.mean, rates.deviation, means, deviations, CLOSE, strict=True
        ):
            assert mean == pytest.approx(wanted, abs=half + 1e-9), (layout, name)
            assert spread is None or deviation == pytest.approx(spread, abs=half + 1e-9), (layout, name)
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
