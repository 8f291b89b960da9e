"""Overcooked against overcooked_ai's own classes (see oracle.py); POPGEN_ORACLE_STEPS sets the length."""

from __future__ import annotations

import os

import numpy as np
import pytest

from popgen.envs.overcooked import OvercookedEnv, layout_names
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.bridge import from_overcooked_ai, infer_joint_action, to_overcooked_ai, to_overcooked_mdp
from tests.envs.oracle import LAYOUTS, MODES, Comparison, OvercookedGridworld

STEPS = int(os.environ.get("POPGEN_ORACLE_STEPS", "20000"))
ONE_PLAYER_OR_FOUR = {"cramped_room_single", "multiplayer_schelling"}


@pytest.mark.parametrize("cooking", MODES)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_play_is_that_of_overcooked_ai(layout, cooking):
    report = Comparison(layout, cooking, seed=1).run(STEPS)
    often = max(1, STEPS // 800)
    assert report.steps >= STEPS
    assert report.events.min() >= often, "every event must have been compared often"
    assert report.raw_events.min() >= often and report.raw_events[:2].sum() > report.events[:2].sum()
    assert report.counter_pickups >= often and report.drops >= often
    assert report.reward >= 20 * often / 2
    # only full pots cook by themselves, so only then is every soup the ordered one
    assert (report.unpaid == 0) == (cooking == "auto")


@pytest.mark.parametrize("cooking", MODES)
def test_tomatoes_mixes_and_bonus_orders(cooking):
    report = Comparison("counter_circuit", cooking, seed=2).run(4000)
    assert report.events[: k.DELIVERS_SOUP].min() >= 5 and report.events[k.DELIVERS_SOUP :].sum() >= 4
    # 47 and 55, and in interact mode 68 with its bonus
    assert len(report.events) == (7 if cooking == "interact" else 6)
    assert report.reward > 0 and report.unpaid > 0


@pytest.mark.parametrize("cooking", MODES)
def test_every_layout_of_overcooked_ai(cooking):
    names = [name for name in layout_names() if name not in ONE_PLAYER_OR_FOUR]
    assert len(names) >= 40
    reports = [Comparison(name, cooking, seed=3).run(96) for name in names]
    assert sum(report.events[k.POTS_INGREDIENT] for report in reports) > 50


def test_a_grid_given_as_text():
    rows = ["XPXXPX", "O1 X T", "X  X2X", "XD XSX", "XXXXXX"]
    params = {"grid": "/".join(rows)}
    report = Comparison("mine", "interact", 4, mdp=OvercookedGridworld.from_grid(rows), **params).run(2400)
    # without orders every recipe pays 20
    assert report.events.min() >= 5 and report.unpaid == 0
    assert report.reward == 20 * report.events[k.DELIVERS_SOUP]


RULES = {
    "start_all_orders": [{"ingredients": ["onion"] * 3}, {"ingredients": ["onion", "tomato", "tomato"]}],
    "start_bonus_orders": [{"ingredients": ["onion"] * 3}],
    "recipe_values": [10, 30],
    "cook_time": 7,
}
TWO = {"start_all_orders": [{"ingredients": ["onion", "onion"]}]}
GAMES = {
    "by name": ("cramped_room", {}),
    "orders and a bonus": ("counter_circuit", {}),
    "a start state": ("tutorial_1", {}),
    "a grid": ("mine", {"grid": "XPXXPX/O1 X T/X  X2X/XD XSX/XXXXXX"}),
    "a grid and rules": ("mine", {"grid": "XPXPX/O1 2T/X   X/XDXSX", "rules": RULES}),
    "soups of two": ("mine", {"grid": "XPXPX/O1 2T/X   X/XDXSX", "rules": {"max_num_ingredients": 2, **TWO}}),
}


@pytest.mark.parametrize("cooking", MODES)
@pytest.mark.parametrize("game", GAMES)
def test_the_game_that_is_made_of_an_environment_is_its_game(game, cooking):
    name, params = GAMES[game]
    mdp = to_overcooked_mdp(OvercookedEnv(name, 1, cooking=cooking, **params))
    assert getattr(mdp, "old_dynamics", False) == (cooking == "auto")
    report = Comparison(name, cooking, 5, mdp=mdp, **params).run(min(STEPS // 2, 3200))
    whole = report.steps >= 3200
    assert report.events[k.POTS_INGREDIENT] > (10 if whole else 5)
    assert report.events[k.DELIVERS_SOUP :].sum() > 2 or not whole


@pytest.mark.parametrize("horizon", [30, 400, 1000])
def test_urgency_follows_the_horizon(horizon):
    env = OvercookedEnv("cramped_room", 1, horizon=horizon)
    mdp = OvercookedGridworld.from_layout_name("cramped_room")
    state = mdp.get_standard_start_state()
    for time in {0, max(0, horizon - 41), max(0, horizon - 40), max(0, horizon - 39), horizon - 1}:
        state.timestep = time
        row = from_overcooked_ai(env, state)
        assert env.time(row) == time
        want = np.stack(mdp.lossless_state_encoding(state, horizon))
        assert np.array_equal(env.encode(row, "lossless"), want)
        assert np.array_equal(env.features_to_lossless(env.encode(row)), want)


def test_states_come_back_from_overcooked_ai():
    env = OvercookedEnv("forced_coordination_tomato", 64, cooking="interact")
    rng = np.random.default_rng(5)
    for _ in range(300):
        env.step(rng.choice(6, size=(64, 2), p=(0.12, 0.12, 0.12, 0.12, 0.02, 0.5)))
    rows = env.get_state()
    assert len({tuple(row) for row in rows}) > 50
    for row in rows:
        state = to_overcooked_ai(env, row)
        assert np.array_equal(from_overcooked_ai(env, state), row)
        assert env.time(from_overcooked_ai(env, state, time=258)) == 258


def test_an_uncooked_soup_in_a_hand_is_refused():
    env = OvercookedEnv("cramped_room", 1)
    row = env.get_state()[0]
    row[k.HELD] = k.FIRST_SOUP + 5
    state = to_overcooked_ai(env, row)
    state.players[0].held_object._cooking_tick = 3
    with pytest.raises(ValueError, match="ready"):
        from_overcooked_ai(env, state)


@pytest.mark.parametrize("seat", [0, 1])
def test_the_partners_action_is_inferred_from_its_effect(seat):
    env = OvercookedEnv("cramped_room", 1)
    rng = np.random.default_rng(6)
    exact = 0
    for _ in range(400):
        before, actions = env.get_state()[0], rng.integers(6, size=(1, 2))
        env.step(actions)
        after = env.get_state()[0]
        guess = infer_joint_action(env, before, after, seat, int(actions[0, seat]))
        joint = actions[0].copy()
        joint[1 - seat] = guess
        assert np.array_equal(env.simulate(before, joint)[0], after)
        joint[1 - seat] = k.STAY
        assert (guess == k.STAY) == np.array_equal(env.simulate(before, joint)[0], after)
        exact += guess == actions[0, 1 - seat]
    assert 200 < exact < 400


def test_an_impossible_transition_has_no_partner_action():
    env = OvercookedEnv("cramped_room", 1)
    before = env.get_state()[0]
    after = before.copy()
    after[k.HELD + 1] = k.DISH
    with pytest.raises(ValueError, match="no action"):
        infer_joint_action(env, before, after, 0, k.STAY)
