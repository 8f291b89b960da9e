"""Layouts by name, file and text; rules in files; what is refused and how it is told."""

from __future__ import annotations

import json

import numpy as np
import pytest

from popgen.envs import make_env
from popgen.envs.overcooked import OvercookedEnv, layout_names
from popgen.envs.overcooked.layout import load_layout
from popgen.envs.overcooked.rules import SOUPS, resolve
from popgen.errors import UserError

GOOD = "XXPXX/O1 2O/X   X/XDXSX"
ONIONS = [{"ingredients": ["onion"] * n} for n in (1, 2, 3)]

BAD_GRIDS = {
    "empty": ("", "empty"),
    "no pot": ("XXXXX/O1 2O/XDXSX", "no pot"),
    "no ingredient": ("XXPXX/X1 2X/XDXSX", "no ingredient dispenser"),
    "no dishes": ("XXPXX/O1 2O/XXXSX", "no dish dispenser"),
    "no serving": ("XXPXX/O1 2O/XDXXX", "no serving location"),
    "one player": ("XXPXX/O1  O/XDXSX", "exactly two players"),
    "three players": ("XXPXX/O123O/XDXSX", "exactly two players"),
    "the same player twice": ("XXPXX/O1 1O/XDXSX", "exactly two players"),
    "unknown character": ("XXPXX/O1?2O/XDXSX", "unknown characters '?'"),
    "ragged": ("XXPXX/O1 2/XDXSX", "different lengths"),
    "open border": ("X XX/O12P/XDSX", "border"),
    "open corner": ("X PXX/O1 2O/XDXSX", "border"),
    "player in the border": ("XXPXX/1  2O/XDOSX", "border"),
    "too large": ("X" * 20 + "/" + ("X" + " " * 18 + "X/") * 12 + "X" * 20, "too many"),
    "unreachable dispenser": ("XXPXXO/O1 2XX/XDXSXX", "no player can reach the onion dispenser at column 5, row 0"),
    "unreachable pot": ("XXPXXP/O1 2XX/XDXSXX", "no player can reach the pot"),
    "unreachable serving": ("XXPXXX/O1 2XS/XDXXXX", "no player can reach the serving location"),
    "behind a wall": ("XXPXXXX/O1 2X T/XDXSXXX", "no player can reach the tomato dispenser"),
    "ingredient apart from the pot": ("XOXXXXPX/D1XXX 2S/XXXXXXXX", "no ingredient can be brought"),
    "dish apart from the pot": ("XPXXXXX/O1X X2D/XXXXXSX", "no dish can be brought"),
    "serving apart from the pot": ("XPXXXXX/O1X X2X/XDXXXSX", "no soup can be brought"),
}


@pytest.mark.parametrize("case", BAD_GRIDS)
def test_bad_grids_are_told_in_one_line(case):
    grid, message = BAD_GRIDS[case]
    with pytest.raises(UserError, match=message) as caught:
        OvercookedEnv("mine", grid=grid)
    assert caught.value.field == "env.grid" and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("params", "field", "message"),
    [
        ({"layout": "cramped_rom"}, "env.layout", "did you mean cramped_room"),
        ({"layout": "zzz"}, "env.layout", "unknown layout 'zzz'"),
        ({"layout": "custom"}, "env.grid", "is missing: 'custom' is no layout"),
        ({"layout": "no/such.layout"}, "env.layout", "there is no file no/such.layout"),
        ({"layout": "/etc/passwd"}, "env.layout", "unknown layout"),
        ({"layout": "cramped_room_single"}, "env.layout", "exactly two players"),
        ({"layout": "multiplayer_schelling"}, "env.layout", "has players 1234"),
        ({"cooking": "atuo"}, "env.cooking", "did you mean 'auto'"),
        ({"events": "all"}, "env.events", "choose dispenser or raw"),
        ({"horizon": 0}, "env.horizon", "from 1 to 65535"),
        ({"horizon": 70_000}, "env.horizon", "from 1 to 65535"),
        ({"horizon": 3.5}, "env.horizon", "whole number"),
        ({"num_envs": 0}, "num_envs", "at least 1"),
        ({"grid": 5}, "env.grid", "must be text"),
        ({"rules": {"cook_time": 5}}, "env.rules", "with env.grid only"),
    ],
)
def test_bad_parameters_are_told_in_one_line(params, field, message):
    with pytest.raises(UserError, match=message) as caught:
        OvercookedEnv(**{"layout": "cramped_room", **params})
    assert caught.value.field == field and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ("cook_time", "must be a mapping"),
        ({"recipe_valeus": [1]}, "did you mean 'recipe_values'"),
        ({"start_all_orders": ONIONS, "recipe_values": [1]}, "as long as start_all_orders"),
        ({"start_all_orders": ONIONS, "recipe_values": 20}, "must be a list"),
        ({"start_all_orders": ONIONS[:1], "recipe_values": ["ten"]}, "must be a number"),
        ({"delivery_reward": 1e60}, "must be a number of at most 1,000,000"),
        ({"delivery_reward": float("inf")}, "must be a number"),
        ({"delivery_reward": float("nan")}, "must be a number"),
        ({"start_all_orders": ONIONS[:1] * 2}, "twice"),
        ({"start_all_orders": ONIONS[:1], "start_bonus_orders": ONIONS[1:2]}, "that start_all_orders does not"),
        ({"start_all_orders": [{"ingredients": ["leek"]}]}, "is no recipe"),
        ({"start_all_orders": [{"ingredients": ["onion"] * 4}]}, "is no recipe"),
        ({"start_all_orders": ["onion"]}, "no ingredients"),
        ({"onion_time": 5}, "come together"),
        ({"onion_time": 5, "tomato_time": 5, "cook_time": 9}, "exclude each other"),
        ({"cook_time": 251}, "from 0 to 250"),
        ({"cook_time": 7.5}, "whole number"),
        ({"max_num_ingredients": 4}, "1 to 3"),
        ({"start_state": {"players": []}}, "start_state"),
    ],
)
def test_bad_rules_are_told_in_one_line(rules, message):
    with pytest.raises(UserError, match=message) as caught:
        OvercookedEnv("mine", grid=GOOD, rules=rules)
    assert "\n" not in str(caught.value)


def test_good_grids_in_both_notations():
    one = OvercookedEnv("one", grid=GOOD)
    other = OvercookedEnv("other", grid="\n  " + GOOD.replace("/", "\n    ") + "\n")
    assert one.spec.fingerprint == other.spec.fingerprint and one.spec.name != other.spec.name
    assert one.spec.params["grid"] == GOOD


def test_areas_may_be_joined_by_counters_alone():
    layout = load_layout("mine", "XXXXX/O1X2P/XDXSX")
    assert not layout.areas[0] & layout.areas[1]
    assert load_layout("forced_coordination").usable("P") == [(3, 0), (4, 1)]


def test_the_fingerprint_is_of_the_rules_not_of_the_name(tmp_path):
    named = OvercookedEnv("cramped_room")
    grid = "/".join(named.layout.rows)
    # with automatic cooking only soups of three onions exist, and they pay 20 by default too
    assert OvercookedEnv("x", grid=grid).spec.fingerprint == named.spec.fingerprint
    others = [
        OvercookedEnv("cramped_room", cooking="interact"),
        OvercookedEnv("cramped_room", events="raw"),
        OvercookedEnv("cramped_room", horizon=399),
        OvercookedEnv("x", grid=grid, rules={"cook_time": 19}),
        OvercookedEnv("x", grid=grid, rules={"delivery_reward": 19}),
        OvercookedEnv("x", grid=grid.replace("1", "3").replace("2", "1").replace("3", "2")),
    ]
    assert len({named.spec.fingerprint, *(env.spec.fingerprint for env in others)}) == 7


def test_a_layout_file_anywhere_is_self_contained(tmp_path):
    path = tmp_path / "mine.layout"
    rules = {"start_all_orders": ONIONS, "recipe_values": [4, 9, 20], "recipe_times": [5, 10, 15]}
    path.write_text(
        repr({"grid": GOOD.replace("/", "\n      "), **rules, "order_bonus": 3, "rew_shaping_params": None})
    )
    env = make_env(f"overcooked/{path}", 2, cooking="interact")
    assert env.spec.name == "overcooked/mine"
    path.unlink()
    again = make_env(env.spec.name, 2, **json.loads(json.dumps(env.spec.params)))
    assert again.spec == env.spec
    assert again.rules.reward[1, 0] == 4 and again.rules.cook_time[2, 0] == 10 and again.rules.reward[2, 1] == 0


def test_layout_files_are_read_never_run(tmp_path):
    path = tmp_path / "evil.layout"
    path.write_text(f"{{'grid': open({str(tmp_path / 'made')!r}, 'w').name}}")
    with pytest.raises(UserError, match=r"cannot read evil\.layout"):
        OvercookedEnv(str(path))
    assert not (tmp_path / "made").exists()
    for text in ("", "[1, 2]", "{'grid': 5}", "{'no': 1}", "{'grid': '''XX", "\x00", "float('x')"):
        path.write_text(text)
        with pytest.raises(UserError) as caught:
            OvercookedEnv(str(path))
        assert "\n" not in str(caught.value)
    told = {"['X']": "it is no dict", "{'grid': 5}": "it has no 'grid' of text", "{'n': 2**9}": "no literal"}
    for text, reason in told.items():
        path.write_text(text)
        with pytest.raises(UserError, match=f": {reason}") as caught:
            OvercookedEnv(str(path))
        assert "object" not in str(caught.value), "an address in memory tells nobody anything"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError):
        OvercookedEnv(str(path))


def test_layout_names_are_those_of_the_installed_package():
    assert {"cramped_room", "counter_circuit", "tutorial_3"} <= set(layout_names())


def test_recipe_rules_take_overcooked_ais_precedence():
    assert set(resolve({}, "f").reward.values()) == {20.0}
    per_item = resolve({"onion_value": 21, "tomato_value": 13, "onion_time": 15, "tomato_time": 7}, "f")
    assert {soup: per_item.reward[soup] for soup in SOUPS} == {(o, t): 21 * o + 13 * t for o, t in SOUPS}
    assert per_item.cook_time[2, 1] == 37
    # a fixed figure of 0 counts as absent
    assert resolve({"cook_time": 0, "delivery_reward": 0}, "f") == resolve({}, "f")
    # a table's 0 does not
    assert resolve({"start_all_orders": ONIONS[2:], "recipe_times": [0]}, "f").cook_time[3, 0] == 0
    bonus = resolve({"start_all_orders": ONIONS, "start_bonus_orders": ONIONS[:1], "order_bonus": 3}, "f")
    assert (bonus.reward[1, 0], bonus.reward[2, 0], bonus.reward[0, 1]) == (60, 20, 0)


def test_a_start_state_is_where_episodes_begin():
    env = OvercookedEnv("tutorial_1", 1)
    text = env.render_text()
    assert "Poo" in text and "←1" in text and "↑2" in text
    env.step(np.array([[0, 0]]))
    env.reset()
    assert env.render_text() == text


def write_layout(tmp_path, **keys):
    """A layout file with the good grid and the given keys, as the environment's name."""
    path = tmp_path / "kitchen.layout"
    path.write_text(repr({"grid": GOOD.replace("/", "\n"), **keys}))
    return f"overcooked/{path}"


def soup(*names):
    return {"ingredients": list(names)}


@pytest.mark.parametrize("orders", [[soup("onion", "onion")], [soup("onion")], [soup("tomato")] * 1])
def test_a_kitchen_in_which_no_order_can_be_cooked_is_refused(tmp_path, orders):
    name = write_layout(tmp_path, start_all_orders=orders)
    with pytest.raises(UserError, match="no order can be cooked and paid.*cooking=interact") as caught:
        make_env(name, cooking="auto")
    assert "\n" not in str(caught.value)


def test_worthless_orders_are_refused_too(tmp_path):
    name = write_layout(tmp_path, start_all_orders=[soup("onion", "onion", "onion")], recipe_values=[0])
    with pytest.raises(UserError, match="no order can be cooked and paid"):
        make_env(name)


def test_orders_that_cannot_be_cooked_are_named(tmp_path):
    orders = [soup("onion", "onion", "onion"), soup("onion", "onion")]
    name = write_layout(tmp_path, start_all_orders=orders)
    assert make_env(name, cooking="auto").spec.notes == (
        "orders that cannot be cooked here with cooking=auto are left out: onion + onion",
    )
    assert make_env(name, cooking="interact").spec.notes == ()
    assert make_env("overcooked/cramped_room").spec.notes == ()


@pytest.mark.parametrize(("old", "cooking"), [(True, "auto"), (False, "interact")])
def test_a_file_says_how_pots_start(tmp_path, old, cooking):
    name = write_layout(tmp_path, start_all_orders=ONIONS[2:], old_dynamics=old)
    assert make_env(name).spec.params["cooking"] == cooking
    again = make_env(name, **{k: v for k, v in make_env(name).spec.params.items() if k in ("cooking", "events")})
    assert again.spec.fingerprint == make_env(name).spec.fingerprint
    with pytest.raises(UserError, match=f"old_dynamics={old} means {cooking}"):
        make_env(name, cooking="interact" if old else "auto")


def test_old_dynamics_must_be_a_truth_value(tmp_path):
    with pytest.raises(UserError, match="old_dynamics must be True or False"):
        make_env(write_layout(tmp_path, old_dynamics="yes"))


KEYS_OF_2019 = {"cook_time": 20, "num_items_for_soup": 3, "delivery_reward": 20, "rew_shaping_params": None}


@pytest.mark.parametrize("orders", [None, ["onion"], ["any"], ["onion", "onion"]])
def test_the_format_of_2019_is_read_as_what_it_is(tmp_path, orders):
    env = make_env(write_layout(tmp_path, start_order_list=orders, **KEYS_OF_2019))
    assert env.spec.params["cooking"] == "auto"
    assert env.rules.reward[3, 0] == 20 and env.rules.cook_time[3, 0] == 20 and env.rules.reward[2, 0] == 0
    assert (
        env.spec.fingerprint
        == make_env("overcooked/x", grid=GOOD, rules={"start_all_orders": ONIONS[2:]}).spec.fingerprint
    )


def test_soups_of_two_in_the_format_of_2019(tmp_path):
    env = make_env(write_layout(tmp_path, start_order_list=["onion"], num_items_for_soup=2, cook_time=5))
    assert env.rules.max_ingredients == 2 and env.rules.reward[2, 0] == 20 and env.rules.reward[1, 0] == 0


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"start_order_list": ["leek"]}, "list of 'onion', 'tomato' and 'any'"),
        ({"start_order_list": "onion"}, "list of 'onion', 'tomato' and 'any'"),
        ({"start_order_list": None, "num_items_for_soup": 4}, "num_items_for_soup must be 1 to 3"),
        ({"start_order_list": None, "start_all_orders": ONIONS[2:]}, "of different formats"),
        ({"start_order_list": ["tomato"]}, "no order can be cooked and paid"),
    ],
)
def test_mistakes_in_the_format_of_2019(tmp_path, keys, message):
    with pytest.raises(UserError, match=message) as caught:
        make_env(write_layout(tmp_path, **keys))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("word", "python"), [("null", "None"), ("true", "True"), ("false", "False")])
def test_json_words_are_told_with_their_line(tmp_path, word, python):
    path = tmp_path / "json.layout"
    path.write_text(f'{{"grid": """{GOOD.replace("/", chr(10))}""",\n "unused": {word}}}')
    with pytest.raises(UserError, match=f"line 5: {word}, write {python}"):
        make_env(f"overcooked/{path}")


def test_a_byte_order_mark_is_no_part_of_a_layout(tmp_path):
    path = tmp_path / "bom.layout"
    path.write_text("\ufeff" + repr({"grid": GOOD.replace("/", "\n")}), encoding="utf-8")
    assert make_env(f"overcooked/{path}").spec.name == "overcooked/bom"


def test_soups_of_different_worth_are_different_events(tmp_path):
    """10 for one onion and 20 for three: half the weight of the dearest one."""
    rules = {"start_all_orders": [ONIONS[0], ONIONS[2]], "recipe_values": [10, 20]}
    spec = make_env("overcooked/x", grid=GOOD, rules=rules, cooking="interact").spec
    assert spec.event_names[4:] == ("delivers_soup_worth_10", "delivers_soup_worth_20")
    assert spec.event_weights == (1.0, 1.0, 1.0, 3.0, 6.0, 12.0)
    assert make_env("overcooked/x", grid=GOOD, rules=rules).spec.event_names[4:] == ("delivers_soup",)
