"""Kitchens as text and as pictures, drawn from a state row.

Nothing in a picture is told by its hue alone: players carry their numbers, ingredients differ in brightness and shape,
a pot that cooks shows the steps left and one that is ready a tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.kitchen_spec import Kitchen
from popgen.envs.overcooked.layout import DIRECTIONS
from popgen.envs.overcooked.rules import SOUPS

TILE = 32
ARROWS = "↑↓→←"
COLOURS = {
    "floor": (238, 230, 214), "X": (168, 132, 92), "O": (138, 102, 66), "T": (138, 102, 66), "D": (138, 102, 66),
    "P": (96, 96, 104), "S": (0, 122, 94), "onion": (250, 220, 90), "tomato": (178, 34, 30), "dish": (250, 250, 250),
    "leaf": (20, 60, 30), "pot": (36, 36, 40), "broth": (112, 74, 46), "edge": (104, 76, 48), "skin": (248, 212, 176),
    "dark": (24, 24, 24), "white": (255, 255, 255), "cooking": (230, 159, 0),
}  # fmt: skip
HATS = ((0, 114, 178), (213, 94, 0))
"""Of player 1 (seat 0) and player 2 (seat 1): blue and vermilion of Okabe and Ito's palette."""

GLYPHS = {
    "0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711",
    "5": "74717", "6": "74757", "7": "71122", "8": "75757", "9": "75717",
}  # fmt: skip
"""Rows of three pixels, each row an octal digit whose bits are the pixels from the left."""


def _spell_object(code: int) -> str:
    """o, t, d or the letters of a soup in brackets."""
    if code < k.FIRST_SOUP:
        return " otd"[code].strip()
    onions, tomatoes = SOUPS[code - k.FIRST_SOUP]
    return f"[{'o' * onions}{'t' * tomatoes}]"


def _pot_text(contents: int, cooking: int) -> str:
    if not contents:
        return ""
    state = "" if cooking == 0 else "!" if cooking == 1 else str(cooking - 1)
    return f"{_spell_object(contents)[1:-1]}{state}"


def _list_contents(kitchen: Kitchen, row: np.ndarray) -> dict[tuple[int, int], tuple[int, int]]:
    """(object code, cooking byte) of every pot and counter by cell."""
    pots, counters = kitchen.tables.pots, kitchen.tables.counters
    first = k.POTS + 2 * len(pots)
    lying = {cell: (int(row[k.POTS + 2 * i]), int(row[k.POTS + 2 * i + 1])) for i, cell in enumerate(pots)}
    return lying | {cell: (int(row[first + i]), 1) for i, cell in enumerate(counters)}


def _read_time(row: np.ndarray) -> int:
    return int(row[k.TIME]) + 256 * int(row[k.TIME + 1])


def as_text(kitchen: Kitchen, row: np.ndarray) -> str:
    """The grid with seven characters a cell.

    Players are an arrow, their number and what they hold (o onion, t tomato, d dish, [ooo] a soup in a dish); pots
    show what is in them and the steps left to cook, or ! when the soup is ready.
    """
    layout, lying = kitchen.layout, _list_contents(kitchen, row)
    players = {(int(row[i]) % layout.width, int(row[i]) // layout.width): i for i in (0, 1)}
    lines = []
    for y in range(layout.height):
        texts = []
        for x in range(layout.width):
            text = layout.tile((x, y))
            if (x, y) in players:
                i = players[x, y]
                text = f"{ARROWS[row[k.ORIENT + i] & 3]}{i + 1}{_spell_object(int(row[k.HELD + i]))}"
            elif (x, y) in lying:
                code, cooking = lying[x, y]
                text += _pot_text(code, cooking) if text == "P" else _spell_object(code)
            texts.append(f"{text:<7}")
        lines.append("".join(texts).rstrip())
    return "\n".join([f"step {_read_time(row)} of {kitchen.horizon}", *lines])


def as_rgb(kitchen: Kitchen, row: np.ndarray) -> np.ndarray:
    """(H * 32, W * 32, 3) uint8 picture."""
    layout = kitchen.layout
    picture = np.empty((layout.height * TILE, layout.width * TILE, 3), np.uint8)
    for y in range(layout.height):
        for x in range(layout.width):
            _cut_tile(picture, (x, y))[:] = _paint_ground(layout.tile((x, y)))
    for cell, (code, cooking) in _list_contents(kitchen, row).items():
        if layout.tile(cell) == "P":
            _cut_tile(picture, cell)[:] = _paint_pot(code, cooking)
        elif code:
            _cut_tile(picture, cell)[:] = _paint_counter(code)
    for i in (0, 1):
        cell = (int(row[i]) % layout.width, int(row[i]) // layout.width)
        _cut_tile(picture, cell)[:] = _paint_player(i, int(row[k.ORIENT + i]) & 3, int(row[k.HELD + i]))
    return picture


@dataclass(frozen=True)
class KitchenTiles:
    """All that can be seen in the cells of a kitchen, as numbers of pictures.

    Attributes:
        pictures: (N, 32, 32, 3) uint8, each once.
        ground: (H * W,) of cells with nobody and nothing in them, row by row.
        pots: (contents, cooking byte) -> number.
        counters: object code -> number.
        players: (player, orientation, held object) -> number.
    """

    pictures: np.ndarray
    ground: list[int]
    pots: dict[tuple[int, int], int]
    counters: dict[int, int]
    players: dict[tuple[int, int, int], int]


def list_tiles(kitchen: Kitchen) -> KitchenTiles:
    """Paint everything that the kitchen can show."""
    numbers: dict[bytes, int] = {}

    def number_tile(tile: np.ndarray) -> int:
        return numbers.setdefault(tile.tobytes(), len(numbers))

    layout, table = kitchen.layout, kitchen.tables.table
    cells = [(x, y) for y in range(layout.height) for x in range(layout.width)]
    items = [code for code in range(1, 256) if table[k.ITEM_BIT, code] >= 0]
    contents = [code for code in range(1, 256) if table[k.POT_BIT, code] >= 0]
    steps = range(int(kitchen.tables.meta[k.M_COOK]) + 2)
    pots = {(code, cooking): number_tile(_paint_pot(code, cooking)) for code in contents for cooking in steps}
    hands = [(player, side, held) for player in (0, 1) for side in range(4) for held in (0, *items)]
    return KitchenTiles(
        ground=[number_tile(_paint_ground(layout.tile(cell))) for cell in cells],
        pots={(0, 0): number_tile(_paint_pot(0, 0)), **pots},
        counters={code: number_tile(_paint_counter(code)) for code in items},
        players={hand: number_tile(_paint_player(*hand)) for hand in hands},
        pictures=np.stack([np.frombuffer(tile, np.uint8).reshape(TILE, TILE, 3) for tile in numbers]),
    )


def _cut_tile(picture: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    return picture[cell[1] * TILE : (cell[1] + 1) * TILE, cell[0] * TILE : (cell[0] + 1) * TILE]


def _draw_disc(tile: np.ndarray, x: float, y: float, radius: float, colour: tuple[int, int, int]) -> None:
    rows, columns = np.ogrid[:TILE, :TILE]
    tile[(columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 <= radius**2] = colour


def _draw_number(tile: np.ndarray, number: int, x: int, y: int, colour: tuple[int, int, int], size: int = 1) -> None:
    """Digits from the upper left corner (x, y), each pixel of a glyph `size` pixels wide and high."""
    for place, digit in enumerate(str(number)):
        for line, bits in enumerate(GLYPHS[digit]):
            for column in range(3):
                if int(bits) >> (2 - column) & 1:
                    top, left = y + line * size, x + (4 * place + column) * size
                    tile[top : top + size, left : left + size] = colour


@lru_cache(maxsize=16)
def _paint_ground(mark: str) -> np.ndarray:
    """A tile (32, 32, 3) with nobody and nothing on it."""
    tile = np.empty((TILE, TILE, 3), np.uint8)
    tile[:] = COLOURS["floor" if mark == " " else mark]
    if mark == " ":
        tile[0], tile[:, 0] = (220, 210, 192), (220, 210, 192)
        return tile
    tile[[0, -1]], tile[:, [0, -1]] = COLOURS["edge"], COLOURS["edge"]
    if mark in "OTD":
        code = {"O": k.ONION, "T": k.TOMATO, "D": k.DISH}[mark]
        for x, y in ((10, 21), (22, 21), (16, 11)):
            _draw_item(tile, code, x, y, small=True)
    elif mark == "S":  # an arrow upwards: out of the kitchen
        for line in range(8):
            tile[6 + line, 15 - line : 17 + line] = COLOURS["white"]
        tile[14:26, 13:19] = COLOURS["white"]
    return tile


def _draw_soup(tile: np.ndarray, code: int, x: float, y: float, radius: float) -> None:
    """Broth with one dot per ingredient."""
    _draw_disc(tile, x, y, radius, COLOURS["broth"])
    onions, tomatoes = SOUPS[code - k.FIRST_SOUP]
    for i, name in enumerate(["onion"] * onions + ["tomato"] * tomatoes):
        angle = 2.1 * i - 1.57
        where = x + radius * 0.5 * np.cos(angle), y + radius * 0.5 * np.sin(angle)
        _draw_disc(tile, *where, radius * 0.35, COLOURS[name])


@lru_cache(maxsize=64)
def _paint_counter(code: int) -> np.ndarray:
    """A counter (32, 32, 3) and what lies on it."""
    tile = _paint_ground("X").copy()
    _draw_item(tile, code, 16, 16)
    return tile


@lru_cache(maxsize=4096)
def _paint_pot(code: int, cooking: int) -> np.ndarray:
    """A pot (32, 32, 3): what is in it, the steps left and a bar that grows, or a tick when the soup is ready."""
    tile = _paint_ground("P").copy()
    _draw_disc(tile, 16, 14, 12, COLOURS["pot"])
    if not code:
        return tile
    _draw_soup(tile, code, 16, 14, 9)
    if cooking == 1:
        tile[27:31, 2:30] = COLOURS["white"]
        for step in range(11):  # a tick: down to the right, then up
            y = 12 + step if step < 4 else 18 - step
            tile[y : y + 4, 11 + step] = COLOURS["white"]
            tile[y + 4, 11 + step] = COLOURS["dark"]
    elif cooking > 1:
        tile[27:31, 2:30] = COLOURS["dark"]
        tile[27:31, 2 : 2 + max(1, 28 - cooking + 1)] = COLOURS["cooking"]
        tile[1:13, 1 : 2 + 8 * len(str(cooking - 1))] = COLOURS["dark"]
        _draw_number(tile, cooking - 1, 2, 2, COLOURS["white"], 2)
    return tile


def _draw_item(tile: np.ndarray, code: int, x: float, y: float, *, small: bool = False) -> None:
    if code in (k.ONION, k.TOMATO):
        _draw_disc(tile, x, y, 5 if small else 6, COLOURS["dark"])
        _draw_disc(tile, x, y, 4 if small else 5, COLOURS["onion" if code == k.ONION else "tomato"])
        left, top = round(x), round(y)
        if code == k.ONION:  # rings
            for column in (left - 2, left + 1):
                tile[max(top - 2, 0) : top + 3, column] = (196, 150, 40)
        else:  # leaves
            tile[max(top - 4, 0) : max(top - 2, 0), left - 2 : left + 2] = COLOURS["white"]
            tile[max(top - 5, 0) : max(top - 3, 0), left - 1 : left + 1] = COLOURS["leaf"]
        return
    _draw_disc(tile, x, y, 6 if small else 8, COLOURS["dark"])
    _draw_disc(tile, x, y, 5 if small else 7, COLOURS["dish"])
    if code == k.DISH:
        _draw_disc(tile, x, y, 3 if small else 4, (206, 206, 206))
    else:
        _draw_soup(tile, code, x, y, 5.5)


@lru_cache(maxsize=1024)
def _paint_player(index: int, side: int, held: int) -> np.ndarray:
    """A head (32, 32, 3) under a numbered hat; the nose, and what is held, point where the player faces."""
    tile = _paint_ground(" ").copy()
    dx, dy = DIRECTIONS[side]
    _draw_disc(tile, 16, 16, 12, COLOURS["dark"])
    _draw_disc(tile, 16, 16, 11, COLOURS["skin"])
    x, y = 16 - 4 * dx, 16 - 4 * dy
    _draw_disc(tile, x, y, 9, COLOURS["white"])
    _draw_disc(tile, x, y, 8, HATS[index])
    _draw_number(tile, index + 1, x - 3, y - 5, COLOURS["white"], 2)
    _draw_disc(tile, 16 + 11 * dx, 16 + 11 * dy, 3, COLOURS["dark"])
    if held:
        _draw_item(tile, held, 16 + 8 * dx, 16 + 8 * dy)
    return tile
