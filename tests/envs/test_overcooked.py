"""Overcooked by hand: rules that are easy to miss, observations, events, pictures."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from popgen.envs import make_env
from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.rules import SOUP_CODE

NORTH, SOUTH, EAST, WEST, STAY, INTERACT = range(6)
POT = k.POTS  # contents of cramped_room's only pot; the cooking byte follows


def kitchen(cooking="auto", **changes):
    """cramped_room with state bytes changed: both stand below the pot's row, cells are y * 5 + x."""
    env = OvercookedEnv("cramped_room", 1, cooking=cooking, **changes.pop("params", {}))
    row = env.get_state()[0]
    for name, value in changes.items():
        row[{"cells": slice(0, 2), "sides": slice(2, 4), "held": slice(4, 6), "pot": slice(8, 10)}[name]] = value
    env.set_state(row[None])
    return env


def shown(env, seat=0):
    """Names of the features that are 1."""
    return {name for name, bit in zip(env.feature_names, env.observe()[0, seat], strict=True) if bit}


def test_the_third_onion_already_ticks():
    env = kitchen(cells=(7, 13), sides=(NORTH, SOUTH), held=(k.ONION, 0), pot=(SOUP_CODE[2, 0], 0))
    batch = env.step(np.array([[INTERACT, STAY]]))
    assert batch.events[0].tolist() == [[0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]
    assert "pot_2,0_cooks_19" in shown(env)
    assert env.observe("lossless")[0, 0, 2, 0, k.C_COOK] == 19
    for left in range(18, -1, -1):
        env.step(np.array([[STAY, STAY]]))
        assert f"pot_2,0_cooks_{left}" in shown(env)
    assert env.observe("lossless")[0, 1, 2, 0, k.C_DONE] == 1
    env.step(np.array([[STAY, STAY]]))
    assert "pot_2,0_cooks_0" in shown(env)


def test_an_empty_hand_starts_a_pot_in_interact_mode_only():
    for cooking, byte in (("interact", 20), ("auto", 0)):
        env = kitchen(cooking, cells=(7, 13), pot=(SOUP_CODE[1, 0], 0))
        env.step(np.array([[INTERACT, STAY]]))
        assert env.get_state()[0, POT + 1] == byte
    env = kitchen("interact", cells=(7, 13), pot=(SOUP_CODE[3, 0], 0))
    env.step(np.array([[STAY, STAY]]))
    assert env.get_state()[0, POT + 1] == 0, "a full pot waits for its interact"


@pytest.mark.parametrize(("soup", "pays"), [((3, 0), 20), ((2, 0), 0), ((1, 0), 0)])
def test_only_soups_that_are_paid_for_are_events(soup, pays):
    env = kitchen("interact", cells=(6, 13), sides=(NORTH, SOUTH), held=(0, SOUP_CODE[soup]))
    batch = env.step(np.array([[STAY, INTERACT]]))
    assert batch.reward.tolist() == [pays] and batch.score.tolist() == [pays > 0]
    assert batch.events[0].tolist() == [[0] * 5, [0, 0, 0, 0, int(pays > 0)]]
    assert env.get_state()[0, k.HELD + 1] == 0


def test_both_may_be_paid_in_one_step():
    env = OvercookedEnv(
        "two", 1, grid="XSPOX/X1 2X/XDXSX", rules={"start_all_orders": [{"ingredients": ["onion"] * 3}]}
    )
    row = env.get_state()[0]
    row[2:6] = NORTH, SOUTH, SOUP_CODE[3, 0], SOUP_CODE[3, 0]
    env.set_state(row[None])
    batch = env.step(np.array([[INTERACT, INTERACT]]))
    assert batch.reward.tolist() == [40] and batch.score.tolist() == [2]


def test_interacts_come_before_moves_and_player_one_first():
    # both reach for the soup with a dish: only the first gets it
    env = OvercookedEnv("one", 1, grid="XXOXX/S 1 X/XXPXX/X 2 D/XXXXX")
    row = env.get_state()[0]
    row[k.ORIENT : k.TIME] = SOUTH, NORTH, k.DISH, k.DISH
    row[POT : POT + 2] = SOUP_CODE[3, 0], 1
    env.set_state(row[None])
    batch = env.step(np.array([[INTERACT, INTERACT]]))
    assert batch.events[0, :, k.TAKES_SOUP].tolist() == [1, 0]
    # who turns away in the same step has not turned yet for the other's interact
    env = kitchen(cells=(6, 8), sides=(WEST, EAST))
    batch = env.step(np.array([[INTERACT, WEST]]))
    assert batch.events[0, :, k.TAKES_INGREDIENT].tolist() == [1, 0]
    assert env.get_state()[0, :4].tolist() == [6, 7, WEST, WEST]


@pytest.mark.parametrize(
    ("cells", "actions", "after"),
    [
        ((6, 7), (EAST, WEST), (6, 7)),  # they would swap
        ((6, 8), (EAST, WEST), (6, 8)),  # they would meet
        ((6, 7), (EAST, STAY), (6, 7)),  # one stands still
        ((6, 7), (EAST, INTERACT), (6, 7)),
        ((6, 7), (EAST, NORTH), (6, 7)),  # the other is stopped by the pot
        ((6, 7), (EAST, EAST), (7, 8)),  # one follows the other
        ((6, 7), (EAST, SOUTH), (7, 12)),
    ],
)
def test_collisions_stop_both_but_turn_them(cells, actions, after):
    env = kitchen(cells=cells, sides=(NORTH, SOUTH))
    env.step(np.array([actions]))
    row = env.get_state()[0]
    assert tuple(row[:2]) == after
    turned = [action if action < STAY else side for action, side in zip(actions, (NORTH, SOUTH), strict=True)]
    assert row[2:4].tolist() == turned


def test_pickups_from_counters_count_only_as_raw_events():
    for events, counted in (("dispenser", 0), ("raw", 1)):
        for item, event in ((k.ONION, k.TAKES_INGREDIENT), (k.DISH, k.TAKES_DISH), (SOUP_CODE[3, 0], k.TAKES_SOUP)):
            env = kitchen(cells=(6, 13), held=(item, 0), params={"events": events})
            assert env.step(np.array([[INTERACT, STAY]])).events.sum() == 0, "putting down is no event"
            batch = env.step(np.array([[INTERACT, STAY]]))
            assert env.get_state()[0, k.HELD] == item
            assert batch.events[0, 0, event] == batch.events.sum() == counted


def test_features_hold_what_can_vary_and_nothing_else():
    env = OvercookedEnv("cramped_room")
    # 2 x (6 cells + 4 sides + onion, dish, soup) + pot (3 onions + 20 steps) + 5 counters x 3 + urgency
    assert len(env.feature_names) == len(set(env.feature_names)) == 2 * (6 + 4 + 3) + 23 + 15 + 1
    assert not any("tomato" in name for name in env.feature_names)
    assert shown(env) == {"self_at_1,2", "other_at_3,1", "self_faces_north", "other_faces_north"}
    assert shown(env, 1) == {"other_at_1,2", "self_at_3,1", "self_faces_north", "other_faces_north"}
    # soups of one and two onions can be made by hand
    by_hand = OvercookedEnv("cramped_room", cooking="interact").feature_names
    assert {"self_holds_soup_onions>=2", "counter_1,0_soup_onions>=3"} <= set(by_hand)
    env.set_time(np.array([361]))
    assert "urgency" in shown(env) and env.observe("lossless")[..., k.C_URGENCY].all()
    env.set_time(np.array([360]))
    assert "urgency" not in shown(env) and not env.observe("lossless")[..., k.C_URGENCY].any()


@pytest.mark.parametrize("layout", ["cramped_room", "forced_coordination", "counter_circuit", "tutorial_1"])
@pytest.mark.parametrize("cooking", ["auto", "interact"])
def test_features_determine_the_state_but_for_time(layout, cooking):
    env = OvercookedEnv(layout, 128, cooking=cooking)
    rng = np.random.default_rng(0)
    for _ in range(200):
        env.step(rng.choice(6, size=(128, 2), p=(0.12, 0.12, 0.12, 0.12, 0.02, 0.5)))
    rows, features = env.get_state(), env.observe()
    timeless = [column for column in range(rows.shape[1]) if column not in (k.TIME, k.TIME + 1)]
    assert np.array_equal(env.features_to_states(features[:, 0])[:, timeless], rows[:, timeless])
    swapped = rows.copy()
    for first in (0, k.ORIENT, k.HELD):
        swapped[:, [first, first + 1]] = rows[:, [first + 1, first]]
    assert np.array_equal(env.features_to_states(features[:, 1])[:, timeless], swapped[:, timeless])
    both = features.reshape(8, 16, 2, -1)
    assert np.array_equal(env.features_to_lossless(both), env.encode(rows.reshape(8, 16, -1), "lossless"))
    with pytest.raises(ValueError, match="features"):
        env.features_to_states(features[..., :-1])


def test_observations_can_be_written_into_an_array():
    env = OvercookedEnv("cramped_room", 3)
    out = np.full((3, 2, 65), 7, np.uint8)
    assert env.observe(out=out) is out and np.array_equal(out, env.observe())
    for bad in (out[:2], out.astype(np.int8), np.asfortranarray(out)):
        with pytest.raises(ValueError, match="out"):
            env.observe(out=bad)


def test_no_state_makes_a_kernel_write_outside_its_arrays():
    env = OvercookedEnv("mdp_test", 1, cooking="interact")
    rng = np.random.default_rng(0)
    rows = rng.integers(0, 256, (4096, env.spec.state_size), np.uint8)
    for view, spec in env.spec.views.items():
        size = 4096 * 2 * int(np.prod(spec.shape))
        guarded = np.full(size + 2048, 99, np.uint8)
        env.encode(rows, view, guarded[1024:-1024].reshape(4096, 2, *spec.shape))
        assert (guarded[:1024] == 99).all() and (guarded[-1024:] == 99).all()
    guarded = np.full(rows.size + 2048, 99, np.uint8)
    states = guarded[1024:-1024]
    states[:] = rows.reshape(-1)
    tables, outputs = env.tables, (np.empty(4096, np.float32), np.empty(4096, np.float32))
    events, truncated = np.zeros((4096, 2, 5), np.uint8), np.empty(4096, bool)
    actions = rng.integers(0, 6, (4096, 2), np.uint8)
    sizes = (states, env.spec.state_size, actions, tables.table, tables.values, tables.meta)
    k.step(*sizes, *outputs, events, truncated)
    assert (guarded[:1024] == 99).all() and (guarded[-1024:] == 99).all()


def test_the_horizon_truncates_and_never_terminates():
    env = OvercookedEnv("cramped_room", 2, horizon=3)
    still = np.full((2, 2), STAY)
    for step in (1, 2, 3):
        batch = env.step(still)
        assert batch.truncated.tolist() == [step == 3] * 2 and not batch.terminated.any()
    env = OvercookedEnv("cramped_room", 1, horizon=65_535)
    env.set_time(np.array([65_534]))
    assert env.step(still[:1]).truncated.all()
    assert env.time(env.get_state()).tolist() == [65_535]
    env.step(still[:1])
    assert env.time(env.get_state()).tolist() == [65_535], "the time must not wrap"
    with pytest.raises(ValueError, match="time"):
        env.set_time(np.array([65_536]))


def test_a_later_process_finds_the_compiled_kernels():
    code = (
        "from popgen.envs.overcooked import OvercookedEnv, kernels as k; import numpy as np;"
        "env = OvercookedEnv('coordination_ring', 2); env.step(np.zeros((2, 2), np.uint8));"
        "env.observe(); env.observe('lossless'); env.features_to_lossless(env.observe());"
        "names = (k.step, k.encode_features, k.encode_lossless, k.decode_features);"
        "print([sum(f.stats.cache_hits.values()) for f in names])"
    )
    OvercookedEnv("cramped_room").features_to_lossless(make_env("overcooked/cramped_room").observe())
    OvercookedEnv("cramped_room").step(np.zeros((1, 2), np.uint8))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "[1, 1, 1, 1]"


def test_text_shows_players_pots_and_counters():
    env = kitchen(cells=(6, 12), sides=(WEST, SOUTH), held=(k.DISH, SOUP_CODE[3, 0]), pot=(SOUP_CODE[3, 0], 6))
    row = env.get_state()
    row[0, POT + 2] = k.ONION
    env.set_state(row)
    lines = env.render_text().splitlines()
    assert lines[0] == "step 0 of 400"
    assert [line.split() for line in lines[1:]] == [
        ["X", "Xo", "Pooo5", "X", "X"],
        ["O", "←1d", "O"],
        ["X", "↓2[ooo]", "X"],
        ["X", "D", "X", "S", "X"],
    ]


def test_pictures_show_every_change():
    changes = [
        {},
        {"cells": (7, 13)},
        {"sides": (EAST, NORTH)},
        {"held": (k.ONION, 0)},
        {"held": (k.DISH, 0)},
        {"held": (0, SOUP_CODE[3, 0])},
        {"pot": (SOUP_CODE[1, 0], 0)},
        {"pot": (SOUP_CODE[3, 0], 0)},
        {"pot": (SOUP_CODE[3, 0], 11)},
        {"pot": (SOUP_CODE[3, 0], 1)},
    ]
    pictures = [kitchen(**change).render_rgb() for change in changes]
    assert all(picture.shape == (128, 160, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)
