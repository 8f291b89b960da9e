"""The state row in which an episode begins, and what can come of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.layout import DIRECTIONS, Layout
from popgen.envs.overcooked.rules import NOTHING, SOUP_CODE, Rules
from popgen.errors import UserError

ITEM_CODE = {"onion": k.ONION, "tomato": k.TOMATO, "dish": k.DISH}


def state_size(layout: Layout) -> int:
    """Bytes of a state row."""
    return k.POTS + 2 * len(layout.usable("P")) + len(layout.usable("X"))


def start_row(layout: Layout, rules: Rules) -> np.ndarray:
    """(S,) uint8: players on their marks facing north with empty hands, or the layout file's `start_state`.

    Raises:
        UserError: a start state that names cells or objects which the layout does not have.
    """
    row = np.zeros(state_size(layout), np.uint8)
    given = layout.config.get("start_state")
    if given is None:
        row[:2] = [y * layout.width + x for x, y in layout.starts]
        return row
    try:
        _fill_row(row, layout, rules, given)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise UserError(
            "env.layout", f"start_state does not fit the grid ({error!r})", "correct or remove it"
        ) from None
    return row


def _fill_row(row: np.ndarray, layout: Layout, rules: Rules, given: Mapping[str, Any]) -> None:
    cells = []
    for i, player in enumerate(given["players"][:2]):
        cells.append(tuple(player["position"]))
        if cells[i] not in layout.areas[i]:
            raise ValueError("a player stands outside its area")
        row[i] = cells[i][1] * layout.width + cells[i][0]
        row[k.ORIENT + i] = DIRECTIONS.index(tuple(player["orientation"]))
        row[k.HELD + i] = _read_item(player.get("held_object"))
    if len(set(cells)) != 2:
        raise ValueError("two players are needed, on different cells")
    pots, counters = layout.usable("P"), layout.usable("X")
    for thing in given.get("objects", ()):
        cell = tuple(thing["position"])
        if cell in pots:
            slot = k.POTS + 2 * pots.index(cell)
            row[slot] = _read_soup(thing)
            tick = thing.get("cooking_tick", -1)
            row[slot + 1] = 0 if tick < 0 else 1 + max(0, rules.cook_time[_read_mix(thing)] - tick)
        else:
            row[k.POTS + 2 * len(pots) + counters.index(cell)] = _read_item(thing)


def _read_mix(thing: Mapping[str, Any]) -> tuple[int, int]:
    names = [ingredient["name"] for ingredient in thing["_ingredients"]]
    return names.count("onion"), names.count("tomato")


def _read_soup(thing: Mapping[str, Any]) -> int:
    if thing["name"] != "soup":
        raise ValueError("only soups stand in pots")
    return SOUP_CODE[_read_mix(thing)]


def _read_item(thing: Mapping[str, Any] | None) -> int:
    if thing is None:
        return NOTHING
    return _read_soup(thing) if thing["name"] == "soup" else ITEM_CODE[thing["name"]]


def possible_contents(
    layout: Layout, rules: Rules, row: np.ndarray, auto: bool
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """What pots can hold, and which soups can cook or be cooked, from the start `row` on; (onions, tomatoes) each."""
    mixes = {code: soup for soup, code in SOUP_CODE.items()}
    end = k.POTS + 2 * len(layout.usable("P"))
    idle = {mixes[row[s]] for s in range(k.POTS, end, 2) if row[s] and not row[s + 1]}
    done = {mixes[row[s]] for s in range(k.POTS, end, 2) if row[s] and row[s + 1]}
    items = {mixes[code] for code in (*row[k.HELD : k.TIME], *row[end:]) if code in mixes}
    contents = rules.pot_contents(bool(layout.usable("O")), bool(layout.usable("T")), idle)
    soups = {soup for soup in contents if not auto or rules.is_full(soup)} | done | items
    in_pots = set(contents) | done
    return [soup for soup in SOUP_CODE if soup in in_pots], [soup for soup in SOUP_CODE if soup in soups]
