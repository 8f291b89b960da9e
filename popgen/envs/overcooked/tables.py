"""A layout and its rules as the flat arrays that the compiled kernels read.

Every table has 256 columns and is indexed by a byte of the state, so that no state, however wrong, makes a
kernel read or write outside its arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.layout import DIRECTIONS, Layout
from popgen.envs.overcooked.rules import MAX_INGREDIENTS, NOTHING, NUM_CODES, SOUP_CODE, SOUPS, Rules

KINDS = {"X": k.COUNTER, "O": k.ONIONS, "T": k.TOMATOES, "D": k.DISHES, "P": k.POT, "S": k.SERVE}


@dataclass(frozen=True)
class Tables:
    """What the kernels need besides states, and the names of what they write.

    Attributes:
        table: (k.NUM_ROWS, 256) int16, see the row names in kernels.py.
        values: (256,) float32, joint reward for delivering each object code.
        worths: the distinct sums above 0 that soups of this kitchen pay, ascending; each has a delivery event.
        meta: (k.NUM_META,) int64, sizes and switches.
        codes: (4, 512) int16, inverse of the feature bits: object codes by held/counter bits (row 0) and by pot
            bits (row 1), cell index by walkable feature (row 2), x-first index by cell (row 3).
        walls: (cells that are not floor,) int64, where the lossless encoding of the grid itself is 1.
        counters, pots: cells (x, y) in the order of the state row.
        feature_names: one name per entry of the `features` view, for people.
    """

    table: np.ndarray
    values: np.ndarray
    worths: tuple[float, ...]
    meta: np.ndarray
    codes: np.ndarray
    walls: np.ndarray
    counters: list[tuple[int, int]]
    pots: list[tuple[int, int]]
    feature_names: tuple[str, ...]


def build_tables(
    layout: Layout,
    rules: Rules,
    contents: list[tuple[int, int]],
    soups: list[tuple[int, int]],
    *,
    auto: bool,
    raw: bool,
    horizon: int,
) -> Tables:
    """Lay out one environment's tables.

    Args:
        contents: (onions, tomatoes) of all that a pot can hold.
        soups: those of them that can be cooking or cooked.
    """
    table = np.full((k.NUM_ROWS, 256), -1, np.int16)
    table[k.NEXT : k.NEXT + 4] = np.arange(256)
    table[k.FACE : k.FACE + 4] = np.arange(256)
    table[[k.KIND, k.SLOT, k.COOK, k.FULL, k.ADD_ONION, k.ADD_TOMATO, k.SOUP_ONIONS, k.SOUP_TOMATOES, k.XFIRST]] = 0
    pots, counters = layout.usable("P"), layout.usable("X")
    _fill_cells(table, layout, pots, counters)
    _fill_recipes(table, rules)
    values, worths = _fill_worths(table, rules, soups)

    ingredients = [code for mark, code in (("O", k.ONION), ("T", k.TOMATO)) if layout.usable(mark)]
    codes = np.zeros((4, 512), np.int16)
    items = [*ingredients, k.DISH, *(SOUP_CODE[soup] for soup in soups)]
    item_names = _fill_bits(table, codes[0], k.ITEM_BIT, items, items_too=True)
    pot_names = _fill_bits(table, codes[1], k.POT_BIT, [SOUP_CODE[soup] for soup in contents], items_too=False)
    cook = max(1, max(rules.cook_time[soup] for soup in soups))
    floor = layout.floor
    codes[2, : len(floor)] = [_index_cell(layout, cell) for cell in floor]
    codes[3, :256] = table[k.XFIRST]
    meta = np.zeros(k.NUM_META, np.int64)
    meta[k.M_POTS], meta[k.M_COUNTERS], meta[k.M_HORIZON] = len(pots), len(counters), horizon
    meta[k.M_AUTO], meta[k.M_RAW] = auto, raw
    meta[k.M_FLOOR], meta[k.M_ITEM], meta[k.M_POT], meta[k.M_COOK] = len(floor), len(item_names), len(pot_names), cook
    names = _name_features(floor, item_names, pots, pot_names, cook, counters)
    meta[k.M_FEATURES], meta[k.M_CELLS] = len(names), layout.width * layout.height
    return Tables(table, values, worths, meta, codes, _lossless_walls(layout), counters, pots, names)


def _index_cell(layout: Layout, cell: tuple[int, int]) -> int:
    return cell[1] * layout.width + cell[0]


def _fill_cells(table: np.ndarray, layout: Layout, pots: list, counters: list) -> None:
    for cell in [(x, y) for y in range(layout.height) for x in range(layout.width)]:
        index = _index_cell(layout, cell)
        table[k.XFIRST, index] = cell[0] * layout.height + cell[1]
        if layout.tile(cell) != " ":
            table[k.KIND, index] = KINDS[layout.tile(cell)] if layout.users(cell) else k.WALL
            continue
        for d, (dx, dy) in enumerate(DIRECTIONS):
            ahead = (cell[0] + dx, cell[1] + dy)
            table[k.FACE + d, index] = _index_cell(layout, ahead)
            if layout.tile(ahead) == " ":
                table[k.NEXT + d, index] = _index_cell(layout, ahead)
    for i, cell in enumerate(layout.floor):
        table[k.FLOOR, _index_cell(layout, cell)] = i
    for i, cell in enumerate(pots):
        table[k.SLOT, _index_cell(layout, cell)] = k.POTS + 2 * i
        table[k.POT_CELL, i] = table[k.XFIRST, _index_cell(layout, cell)]
    for i, cell in enumerate(counters):
        table[k.SLOT, _index_cell(layout, cell)] = k.POTS + 2 * len(pots) + i
        table[k.COUNTER_CELL, i] = table[k.XFIRST, _index_cell(layout, cell)]


def _fill_recipes(table: np.ndarray, rules: Rules) -> None:
    table[k.ADD_ONION, NOTHING], table[k.ADD_TOMATO, NOTHING] = SOUP_CODE[1, 0], SOUP_CODE[0, 1]
    for (onions, tomatoes), code in SOUP_CODE.items():
        table[k.SOUP_ONIONS, code], table[k.SOUP_TOMATOES, code] = onions, tomatoes
        if onions + tomatoes > rules.max_ingredients:
            continue
        table[k.COOK, code] = rules.cook_time[onions, tomatoes]
        if onions + tomatoes == rules.max_ingredients:
            table[k.FULL, code] = 1
        else:
            table[k.ADD_ONION, code] = SOUP_CODE[onions + 1, tomatoes]
            table[k.ADD_TOMATO, code] = SOUP_CODE[onions, tomatoes + 1]


def _fill_worths(table: np.ndarray, rules: Rules, soups: list[tuple[int, int]]) -> tuple[np.ndarray, tuple[float, ...]]:
    """What each object code pays, and the delivery event of each soup that pays; -1 in the table stands for none."""
    values = np.zeros(256, np.float32)
    for soup, reward in rules.reward.items():
        values[SOUP_CODE[soup]] = reward
    worths = tuple(sorted({float(rules.reward[soup]) for soup in soups if rules.reward.get(soup, 0.0) > 0.0}))
    for soup in soups:
        if rules.reward.get(soup, 0.0) > 0.0:
            table[k.DELIVERY, SOUP_CODE[soup]] = k.DELIVERS_SOUP + worths.index(float(rules.reward[soup]))
    return values, worths


def _list_tests(items_too: bool) -> list[tuple[str, list[bool]]]:
    """Name and value per object code of every bit that may describe an object."""
    items = (("onion", k.ONION), ("tomato", k.TOMATO), ("dish", k.DISH)) if items_too else ()
    tests = [(name, [code == item for code in range(NUM_CODES)]) for name, item in items]
    for column, ingredient in enumerate(("onions", "tomatoes")):
        for level in range(1, MAX_INGREDIENTS + 1):
            values = [False] * k.FIRST_SOUP + [soup[column] >= level for soup in SOUPS]
            tests.append((f"soup_{ingredient}>={level}", values))
    return tests


def _fill_bits(table: np.ndarray, inverse: np.ndarray, row: int, present: list[int], *, items_too: bool) -> list[str]:
    """Choose the bits that tell the objects apart and tabulate them; returns the bits' names.

    Soups are thermometers of onions and of tomatoes; a bit that is always 0, or always equal to an earlier one,
    is left out (with only one possible soup, one bit says it is there).
    """
    kept: dict[tuple[bool, ...], str] = {}
    for name, values in _list_tests(items_too):
        pattern = tuple(values[code] for code in present)
        if any(pattern) and pattern not in kept:
            kept[pattern] = name
    for i, code in enumerate(present):
        bits = [bit for bit, pattern in enumerate(kept) if pattern[i]]
        table[row : row + 3, code] = (bits + bits[-1:] * 3)[:3]  # repeats are harmless: the kernel only sets bits
        inverse[sum(1 << bit for bit in bits)] = code
    return list(kept.values())


def _name_features(
    floor: list, items: list[str], pots: list, pot_bits: list[str], cook: int, counters: list
) -> tuple[str, ...]:
    who, sides = ("self", "other"), ("north", "south", "east", "west")
    names = [f"{w}_at_{x},{y}" for w in who for x, y in floor]
    names += [f"{w}_faces_{side}" for w in who for side in sides]
    names += [f"{w}_holds_{item}" for w in who for item in items]
    for x, y in pots:
        names += [f"pot_{x},{y}_{bit}" for bit in pot_bits] + [f"pot_{x},{y}_cooks_{left}" for left in range(cook)]
    names += [f"counter_{x},{y}_{item}" for x, y in counters for item in items]
    return (*names, "urgency")


def _lossless_walls(layout: Layout) -> np.ndarray:
    base = np.zeros((layout.width, layout.height, k.CHANNELS), np.uint8)
    for channel, mark in enumerate("PXOTDS", start=k.C_TERRAIN):
        for x, y in layout.cells(mark):
            base[x, y, channel] = 1
    return np.flatnonzero(base)
