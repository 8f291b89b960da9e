"""What a recipe pays and how long it cooks, from the order and recipe keys of a layout file.

The keys and their precedence are those of overcooked_ai 1.1.0. Soups are known only by their counts of
onions and tomatoes; each has one object code.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from popgen.envs.overcooked.kernels import FIRST_SOUP
from popgen.errors import UserError

NOTHING = 0
MAX_INGREDIENTS = 3
MAX_COOK_TIME = 250  # a pot's byte also tells idle and ready
MAX_VALUE = 1_000_000  # of a recipe: sums of rewards stay exact

SOUPS: tuple[tuple[int, int], ...] = tuple(
    (total - tomatoes, tomatoes) for total in range(1, MAX_INGREDIENTS + 1) for tomatoes in range(total + 1)
)
"""(onions, tomatoes) of soup code FIRST_SOUP + i."""

SOUP_CODE: dict[tuple[int, int], int] = {soup: FIRST_SOUP + i for i, soup in enumerate(SOUPS)}
NUM_CODES = FIRST_SOUP + len(SOUPS)

_ORDER_KEYS = ("start_all_orders", "start_bonus_orders", "order_bonus", "start_state")
_RECIPE_KEYS = (
    "recipe_values", "recipe_times", "delivery_reward", "cook_time", "max_num_ingredients",
    "onion_value", "tomato_value", "onion_time", "tomato_time",
)  # fmt: skip
_COOKING_KEYS = ("old_dynamics",)
_KEYS_OF_2019 = ("start_order_list", "num_items_for_soup")
_IGNORED_KEYS = ("rew_shaping_params", "layout_name", "num_items_for_soup", "unused")
_CLASHES = (
    ("tomato_value", "delivery_reward"), ("tomato_value", "recipe_values"), ("recipe_values", "delivery_reward"),
    ("tomato_time", "cook_time"), ("tomato_time", "recipe_times"), ("recipe_times", "cook_time"),
)  # fmt: skip


@dataclass(frozen=True)
class Rules:
    """Resolved recipe rules: `reward` and `cook_time` per (onions, tomatoes), what a full pot holds, and the soups that
    the layout itself names as orders."""

    reward: dict[tuple[int, int], float]
    cook_time: dict[tuple[int, int], int]
    max_ingredients: int
    ordered: tuple[tuple[int, int], ...] = ()

    def pot_contents(
        self, onions: bool, tomatoes: bool, initial: Iterable[tuple[int, int]] = ()
    ) -> list[tuple[int, int]]:
        """All that pots can hold, from empty or `initial` pots, when these ingredients can be had."""
        found, front = set(initial), [(0, 0), *initial]
        while front:
            o, t = front.pop()
            for more in [(o + 1, t)] * onions + [(o, t + 1)] * tomatoes:
                if sum(more) <= self.max_ingredients and more not in found:
                    found.add(more)
                    front.append(more)
        return [soup for soup in SOUPS if soup in found]

    def is_full(self, soup: tuple[int, int]) -> bool:
        return sum(soup) >= self.max_ingredients


def rule_keys(config: Mapping[str, Any], field: str) -> dict[str, Any]:
    """The keys of a layout file that matter to the rules.

    Raises:
        UserError: a key that no layout file has.
    """
    known = _ORDER_KEYS + _RECIPE_KEYS + _COOKING_KEYS
    if not isinstance(config, Mapping):
        raise UserError(field, f"rules must be a mapping, got {type(config).__name__}", "write key: value")
    if "start_order_list" in config:
        config = translate_2019(config, field)
    for key in config:
        if key not in known + _IGNORED_KEYS:
            close = difflib.get_close_matches(str(key), known, 1)
            raise UserError(field, f"unknown key {key!r}", f"did you mean {close[0]!r}?" if close else "remove it")
    return {key: config[key] for key in known if key in config}


def translate_2019(config: Mapping[str, Any], field: str) -> dict[str, Any]:
    """The rule keys of a layout file in overcooked_ai's format of 2019, in which a soup has one kind of ingredient.

    There, `start_order_list` names ingredients ("onion" is a soup of `num_items_for_soup` onions) or is None, which
    takes any soup, and a full pot cooks by itself. A list's order of delivery is not kept: each of its soups is paid
    at any time.

    Raises:
        UserError: an order or a size that the format does not know, or keys of both formats.
    """
    both = sorted(set(config) & set(_ORDER_KEYS))
    if both:
        raise UserError(field, f"start_order_list and {both[0]} are of different formats", "remove one of them")
    size, orders = config.get("num_items_for_soup", MAX_INGREDIENTS), config["start_order_list"]
    if isinstance(size, bool) or size not in range(1, MAX_INGREDIENTS + 1):
        raise UserError(field, f"num_items_for_soup must be 1 to {MAX_INGREDIENTS}, got {size!r}")
    kinds = ("onion", "tomato")
    if orders is not None and not (isinstance(orders, list | tuple) and set(orders) <= {*kinds, "any"}):
        problem = f"start_order_list must be None or a list of 'onion', 'tomato' and 'any', got {orders!r}"
        raise UserError(field, problem, "correct it")
    paid = [kind for kind in kinds if not orders or "any" in orders or kind in orders]
    others = {key: value for key, value in config.items() if key not in _KEYS_OF_2019}
    return others | {
        "start_all_orders": [{"ingredients": [kind] * size} for kind in paid],
        "max_num_ingredients": size,
        "old_dynamics": config.get("old_dynamics", True),
    }


def check_orders(rules: Rules, soups: list[tuple[int, int]], field: str) -> None:
    """Some soup that can be cooked must be paid for, or a whole training earns nothing.

    Raises:
        UserError: none is.
    """
    if not any(rules.reward.get(soup, 0.0) > 0.0 for soup in soups):
        sizes = sorted({sum(soup) for soup in soups})
        problem = f"no order can be cooked and paid: soups here have {' or '.join(map(str, sizes))} ingredients"
        fix = "choose env.params.cooking=interact for smaller soups, or correct the orders, values and dispensers"
        raise UserError(field, problem, fix)


def describe_left_out(rules: Rules, soups: list[tuple[int, int]], cooking: str) -> tuple[str, ...]:
    """A sentence about ordered soups that this kitchen cannot cook; none if there are none."""
    missing = [soup for soup in rules.ordered if rules.reward[soup] > 0.0 and soup not in soups]
    if not missing:
        return ()
    names = ", ".join(" + ".join(["onion"] * onions + ["tomato"] * tomatoes) for onions, tomatoes in missing)
    return (f"orders that cannot be cooked here with cooking={cooking} are left out: {names}",)


def resolve(config: Mapping[str, Any], field: str) -> Rules:
    """Rewards and cook times of every soup.

    Args:
        config: the rule keys of a layout (see `rule_keys`).
        field: what to blame in errors.

    Raises:
        UserError: keys that exclude each other, or values overcooked_ai would not take.
    """
    _check_types(config, field)
    _check_clashes(config, field)
    size = config.get("max_num_ingredients", MAX_INGREDIENTS)
    if size not in range(1, MAX_INGREDIENTS + 1):
        raise UserError(field, f"max_num_ingredients must be 1 to {MAX_INGREDIENTS}, got {size!r}")
    named = list(_read_recipes(config.get("start_all_orders") or [], field))
    # a start state brings its own orders, and an empty list means every recipe
    start = config.get("start_state")
    orders = list(_read_recipes((start.get("all_orders") if start else config.get("start_all_orders")) or [], field))
    bonus = list(_read_recipes((start.get("bonus_orders") if start else config.get("start_bonus_orders")) or [], field))
    soups = [soup for soup in SOUPS if sum(soup) <= size]
    ordered = tuple(soup for soup in orders if soup in soups)
    orders = orders or soups
    for name, listed in (("start_all_orders", orders), ("start_bonus_orders", bonus)):
        if len(set(listed)) != len(listed):
            raise UserError(field, f"{name} holds a recipe twice", "remove the duplicate")
    if not set(bonus) <= set(orders):
        raise UserError(field, "start_bonus_orders holds a recipe that start_all_orders does not", "add it to both")
    factor = config.get("order_bonus", 2)
    reward, cook_time = {}, {}
    for soup in soups:
        value = _read_figure(config, soup, named, "delivery_reward", "recipe_values", "value")
        reward[soup] = float(value * (factor if soup in bonus else 1)) if soup in orders else 0.0
        cook_time[soup] = _cook_time(_read_figure(config, soup, named, "cook_time", "recipe_times", "time"), field)
    return Rules(reward, cook_time, size, ordered)


def _check_types(config: Mapping[str, Any], field: str) -> None:
    for key in ("start_all_orders", "start_bonus_orders", "recipe_values", "recipe_times"):
        if not isinstance(config.get(key, []), list | tuple | None):
            raise UserError(field, f"{key} must be a list, got {config[key]!r}")
    if not isinstance(config.get("start_state"), Mapping | None):
        raise UserError(field, "start_state must be a mapping", "write it as overcooked_ai's to_dict does")
    figures = [(key, config[key]) for key in (*_RECIPE_KEYS[2:], "order_bonus") if key in config]
    figures += [(key, value) for key in ("recipe_values", "recipe_times") for value in config.get(key) or ()]
    for key, value in figures:
        largest = float("inf") if key == "order_bonus" else MAX_VALUE  # a layout of overcooked_ai's has that
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= largest:
            raise UserError(field, f"{key} must be a number of at most {largest:,}, got {value!r}")


def _check_clashes(config: Mapping[str, Any], field: str) -> None:
    for one, other in _CLASHES:
        if one in config and other in config:
            raise UserError(field, f"{one} and {other} exclude each other", "remove one of them")
    for kind in ("time", "value"):
        if (f"onion_{kind}" in config) != (f"tomato_{kind}" in config):
            raise UserError(field, f"onion_{kind} and tomato_{kind} come together", "give both or neither")
    for key in ("recipe_values", "recipe_times"):
        if key in config and len(config[key]) != len(config.get("start_all_orders") or []):
            raise UserError(field, f"{key} must be as long as start_all_orders", "give one figure per order")


def _read_recipes(orders: Iterable[Any], field: str) -> Iterable[tuple[int, int]]:
    for order in orders:
        try:
            names = list(order["ingredients"])
        except (TypeError, KeyError):
            fix = "write a soup of three as {'ingredients': ['onion', 'onion', 'onion']}"
            raise UserError(field, f"order {order!r} has no ingredients", fix) from None
        soup = (names.count("onion"), names.count("tomato"))
        if sum(soup) != len(names) or soup not in SOUP_CODE:
            raise UserError(field, f"order {names!r} is no recipe", "use one to three of 'onion' and 'tomato'")
        yield soup


def _read_figure(
    config: Mapping[str, Any], soup: tuple[int, int], named: list, fixed: str, table: str, kind: str
) -> Any:
    """One recipe's value or time; in overcooked_ai a fixed figure or an ingredient's figure of 0 counts as absent."""
    if config.get(fixed):
        return config[fixed]
    if config.get(table) and soup in named:
        return config[table][named.index(soup)]
    onion, tomato = config.get(f"onion_{kind}"), config.get(f"tomato_{kind}")
    if onion and tomato:
        return onion * soup[0] + tomato * soup[1]
    return 20


def _cook_time(value: Any, field: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_COOK_TIME:
        raise UserError(field, f"a cook time must be a whole number from 0 to {MAX_COOK_TIME}, got {value!r}")
    return value
