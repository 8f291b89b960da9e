"""Events of transitions: against overcooked_ai's objects, by hand, and what must always hold."""

from __future__ import annotations

import numpy as np
import pytest
from overcooked_ai_py.mdp.actions import Action

from popgen.envs import make_env
from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.bridge import to_overcooked_ai, to_overcooked_mdp
from popgen.envs.overcooked.transition_events import EVENTS, HSP_EVENTS, find_transition_events, hsp_events
from popgen.envs.overcooked.transition_events_bench import measure_rate
from popgen.envs.player_events import (
    SPARSE_REWARD,
    count_diversity_events,
    count_player_events,
    name_diversity_events,
)
from tests.envs.cooks import Cook, Kitchen
from tests.envs.slow_events import read_events

LAYOUTS = (
    "cramped_room",
    "asymmetric_advantages",
    "coordination_ring",
    "forced_coordination",
    "counter_circuit_o_1order",
)
MIXED = "XXPXX/O1 2T/X   X/XDSXX"
INDEX = {name: position for position, name in enumerate(EVENTS)}
COUNTERS = tuple(INDEX[f"put_{thing}_on_counter"] for thing in ("onion", "tomato", "dish", "soup"))
NORTH, SOUTH, EAST, WEST, STAY, INTERACT = range(6)


def record_cooks(env: OvercookedEnv, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States (T, N, S) and actions (T, N, 2) of scripted cooks."""
    rng, kitchen = np.random.default_rng(seed), Kitchen(env)
    cooks = [[Cook(kitchen, seat, rng, 0.3) for seat in (0, 1)] for _ in range(env.num_envs)]
    states = np.empty((steps, env.num_envs, env.spec.state_size), np.uint8)
    actions = np.empty((steps, env.num_envs, 2), np.uint8)
    env.reset()
    for t in range(steps):
        states[t] = env.get_state()
        actions[t] = [[cook.act(row) for cook in pair] for pair, row in zip(cooks, states[t], strict=True)]
        env.step(actions[t])
    return states, actions


@pytest.mark.parametrize("cooking", ("auto", "interact"))
@pytest.mark.parametrize("layout", (*LAYOUTS, "mixed"))
def test_equal_to_overcooked_ai(layout: str, cooking: str) -> None:
    grid = MIXED if layout == "mixed" else None
    env = OvercookedEnv(layout, 4, cooking=cooking, grid=grid)
    mdp = to_overcooked_mdp(env)
    states, actions = record_cooks(env, 300, seed=1)
    got = find_transition_events(env, states, actions)
    for t, n in np.ndindex(got.shape[:2]):
        joint = tuple(Action.INDEX_TO_ACTION[action] for action in actions[t, n])
        want = read_events(mdp, to_overcooked_ai(env, states[t, n]), joint)
        if not np.array_equal(got[t, n], want):
            found, asked = ([[EVENTS[i] for i in np.flatnonzero(seat)] for seat in rows] for rows in (got[t, n], want))
            raise AssertionError(f"{found} is not {asked} in {states[t, n]} with {joint}")
    seen = got.reshape(-1, len(EVENTS)).sum(0)
    absent = {name for name in EVENTS if "tomato" in name and grid is None}
    absent |= {"start_pot"} if cooking == "auto" else set()
    rare = {"put_soup_on_counter", "take_soup_from_counter", "take_tomato_from_counter", "put_tomato_on_counter"}
    assert {name for name in EVENTS if not seen[INDEX[name]]} <= absent | rare | {"put_dish_on_counter"}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_always_holds(layout: str) -> None:
    env = OvercookedEnv(layout, 16)
    states, actions = record_cooks(env, 400, seed=2)
    events = find_transition_events(env, states, actions).astype(int)
    outcomes = [i for i, name in enumerate(EVENTS) if name not in ("useful_dish", "walk", "idle_move")]
    assert (events[..., outcomes].sum(-1) == 1).all()
    assert (events[..., INDEX["walk"]] + events[..., INDEX["idle_move"]] <= events[..., INDEX["move"]]).all()
    # conservation: what a player took less what it put is what it holds
    total = events.sum(0)
    held = env.get_state()[:, k.HELD : k.TIME]
    taken = {"onion": 0, "dish": 0, "soup": 0}
    for thing, code in (("onion", k.ONION), ("dish", k.DISH)):
        taken[thing] = (
            total[..., INDEX[f"take_{thing}_from_counter"]] + total[..., INDEX[f"take_{thing}_from_dispenser"]]
        )
        taken[thing] -= total[..., INDEX[f"put_{thing}_on_counter"]]
        taken[thing] -= total[..., INDEX["put_onion_in_pot" if thing == "onion" else "take_soup_from_pot"]]
        assert np.array_equal(taken[thing], held == code)
    soups = total[..., INDEX["take_soup_from_pot"]] + total[..., INDEX["take_soup_from_counter"]]
    soups -= total[..., INDEX["put_soup_on_counter"]] + total[..., INDEX["deliver_soup"]]
    assert np.array_equal(soups, held >= k.FIRST_SOUP)
    counters = env.get_state()[:, k.POTS + 2 * len(env.tables.pots) :]
    for thing, code in (("onion", k.ONION), ("dish", k.DISH)):
        lies = total[..., INDEX[f"put_{thing}_on_counter"]] - total[..., INDEX[f"take_{thing}_from_counter"]]
        assert np.array_equal(lies.sum(-1), (counters == code).sum(-1))


def test_equal_to_the_simulators_own_events() -> None:
    env = OvercookedEnv("counter_circuit_o_1order", 16)
    states, actions = record_cooks(env, 400, seed=3)
    own = env.simulate(states, actions)[1].events
    events = find_transition_events(env, states, actions)
    names = ("take_onion_from_dispenser", "take_dish_from_dispenser", "put_onion_in_pot", "take_soup_from_pot")
    for column, name in enumerate((*names, "deliver_soup")):
        assert np.array_equal(own[..., column], events[..., INDEX[name]])


def names_of(env: OvercookedEnv, state: np.ndarray, joint: tuple[int, int]) -> tuple[set[str], set[str]]:
    events = find_transition_events(env, state, np.array(joint))
    return tuple({EVENTS[i] for i in np.flatnonzero(seat)} for seat in events)  # type: ignore[return-value]


def test_by_hand() -> None:
    """cramped_room: O at (0, 1) and (4, 1), P at (2, 0), D at (1, 3), S at (3, 3); players at (1, 2) and (3, 1)."""
    env = OvercookedEnv("cramped_room", 1)
    start = env.get_state()[0]
    assert names_of(env, start, (STAY, STAY)) == ({"stay"}, {"stay"})
    assert names_of(env, start, (NORTH, EAST)) == ({"move", "walk"}, {"move"})  # player 2 turns to the onions
    assert names_of(env, start, (WEST, NORTH)) == ({"move"}, {"move", "idle_move"})
    assert names_of(env, start, (INTERACT, INTERACT)) == ({"idle_interact_empty"}, {"idle_interact_counter"})
    facing = start.copy()
    facing[k.ORIENT : k.ORIENT + 2] = SOUTH, EAST
    assert names_of(env, facing, (INTERACT, INTERACT)) == (
        {"take_dish_from_dispenser"},
        {"take_onion_from_dispenser"},
    )
    facing[k.POTS] = k.FIRST_SOUP  # one onion in the pot: a dish is of use, with full hands nothing happens
    facing[k.HELD + 1] = k.ONION
    assert names_of(env, facing, (INTERACT, INTERACT)) == (
        {"take_dish_from_dispenser", "useful_dish"},
        {"idle_interact_empty"},
    )
    facing[k.HELD + 1] = k.DISH  # a dish is out already
    assert names_of(env, facing, (INTERACT, STAY)) == ({"take_dish_from_dispenser"}, {"stay"})


def test_two_players_at_one_pot() -> None:
    """Player 1's interact comes first: the third onion fills the pot, and player 2's is refused."""
    env = OvercookedEnv("cramped_room", 1)
    state = env.get_state()[0]
    width = env.layout.width
    state[:2] = width * 1 + 1, width * 1 + 3  # left and right of the cell below the pot
    state[0], state[k.ORIENT] = width + 2, NORTH
    assert names_of(env, state, (NORTH, WEST)) == ({"move", "idle_move"}, {"move"})  # blocked, but turns
    state[k.HELD], state[k.POTS] = k.ONION, 0
    assert names_of(env, state, (INTERACT, STAY))[0] == {"put_onion_in_pot"}
    state[k.POTS], state[k.POTS + 1] = 9, 0  # three onions, full
    assert names_of(env, state, (INTERACT, STAY))[0] == {"idle_interact_refused"}
    state[k.HELD], state[k.POTS + 1] = k.DISH, 1
    assert names_of(env, state, (INTERACT, STAY))[0] == {"take_soup_from_pot"}
    state[k.POTS + 1] = 5
    assert names_of(env, state, (INTERACT, STAY))[0] == {"idle_interact_refused"}


def test_hsps_names_and_bad_input() -> None:
    assert len(HSP_EVENTS) == 17
    events = np.eye(len(EVENTS), dtype=np.uint8)
    columns = hsp_events(events)
    assert columns.shape == (len(EVENTS), 17)
    left_out = {name for name in EVENTS if not columns[INDEX[name]].any()}
    tomato = {"put_tomato_on_counter", "take_tomato_from_counter", "take_tomato_from_dispenser"}
    assert left_out == tomato | {"start_pot", "walk", "idle_interact_refused"}
    env = OvercookedEnv("cramped_room", 3)
    states = env.get_state()
    before = states.copy()
    assert find_transition_events(env, states, np.full((3, 2), INTERACT)).shape == (3, 2, len(EVENTS))
    assert np.array_equal(states, before)
    for wrong in (np.zeros((2, 2), int), np.full((3, 2), 6), np.full((3, 2), -1), np.zeros((3, 2))):
        with pytest.raises(ValueError):
            find_transition_events(env, states, wrong)
    with pytest.raises(ValueError):
        find_transition_events(env, states[:, 1:], np.zeros((3, 2), int))


def test_it_is_fast() -> None:
    """The bar is 3 million a second on an idle core; machines that run tests are busy."""
    assert measure_rate(OvercookedEnv("counter_circuit_o_1order", 1024), 0.5) > 1e6


def test_br_div_counts_thirteen_of_hsps_events_and_the_reward_of_who_delivers() -> None:
    """Cooks in a kitchen; a delivery is worth the same each time, so that its two columns are one up to a factor."""
    env = OvercookedEnv("cramped_room", 4, horizon=300)
    rng, kitchen = np.random.default_rng(3), Kitchen(env)
    cooks = [[Cook(kitchen, seat, rng, 0.3) for seat in (0, 1)] for _ in range(env.num_envs)]
    names, total, reward = name_diversity_events(env), 0.0, np.zeros(4)
    every = np.zeros((4, 2, len(names)))
    hsp = np.zeros((4, 2, len(HSP_EVENTS)))
    for _ in range(300):
        states = env.get_state()
        actions = np.array(
            [[cook.act(row) for cook in pair] for pair, row in zip(cooks, states, strict=True)], np.uint8
        )
        result = env.step(actions)
        every += count_diversity_events(env, states, actions, result)
        hsp += count_player_events(env, states, actions, result)
        reward += result.reward
        total += result.score.sum()
    dropped = {"MOVEMENT", "IDLE_MOVEMENT", "IDLE_INTERACT_X", "IDLE_INTERACT_EMPTY"}
    assert len(names) == 14 and set(names) == set(HSP_EVENTS) - dropped | {SPARSE_REWARD}
    kept = [list(HSP_EVENTS).index(name) for name in names[:-1]]
    np.testing.assert_array_equal(every[..., :-1], hsp[..., kept])
    assert total > 8 and every[..., -1].sum(-1).tolist() == reward.tolist()
    np.testing.assert_allclose(every[..., -1], every[..., names.index("delivery")] * reward.sum() / total)
    assert (every[..., -1] > 0).any(0).all(), "both seats deliver"


def test_br_div_of_another_environment_counts_its_own_events() -> None:
    env = make_env("rendezvous/mppmr", 2)
    states, actions = env.get_state(), np.zeros((2, 2), np.uint8)
    result = env.step(actions)
    assert name_diversity_events(env) == env.spec.event_names
    np.testing.assert_array_equal(count_diversity_events(env, states, actions, result), result.events)
