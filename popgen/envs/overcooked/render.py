"""Kitchens as text and as pictures, drawn from a state row."""

from __future__ import annotations

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.kitchen_spec import Kitchen
from popgen.envs.overcooked.layout import DIRECTIONS
from popgen.envs.overcooked.rules import SOUPS

TILE = 32
ARROWS = "↑↓→←"
COLOURS = {
    "floor": (236, 226, 208), "X": (164, 124, 84), "O": (150, 110, 70), "T": (150, 110, 70), "D": (150, 110, 70),
    "P": (96, 96, 104), "S": (120, 168, 120), "onion": (240, 208, 80), "tomato": (208, 56, 48), "dish": (248, 248, 248),
    "pot": (40, 40, 44), "broth": (120, 84, 56), "edge": (120, 90, 60), "skin": (248, 212, 176), "dark": (32, 32, 32),
    "ready": (72, 200, 88), "cooking": (248, 152, 40),
}  # fmt: skip
HATS = ((64, 104, 216), (56, 152, 72))


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
    picture = np.zeros((layout.height * TILE, layout.width * TILE, 3), np.uint8)
    for y in range(layout.height):
        for x in range(layout.width):
            _draw_tile(_cut_tile(picture, (x, y)), layout.tile((x, y)))
    for cell, (code, cooking) in _list_contents(kitchen, row).items():
        tile = _cut_tile(picture, cell)
        if layout.tile(cell) == "P":
            _draw_pot(tile, code, cooking)
        elif code:
            _draw_item(tile, code, 16, 16)
    for i in (0, 1):
        cell = (int(row[i]) % layout.width, int(row[i]) // layout.width)
        _draw_player(_cut_tile(picture, cell), i, int(row[k.ORIENT + i]) & 3, int(row[k.HELD + i]))
    return picture


def _cut_tile(picture: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    return picture[cell[1] * TILE : (cell[1] + 1) * TILE, cell[0] * TILE : (cell[0] + 1) * TILE]


def _draw_disc(tile: np.ndarray, x: float, y: float, radius: float, colour: tuple[int, int, int]) -> None:
    rows, columns = np.ogrid[:TILE, :TILE]
    tile[(columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2 <= radius**2] = colour


def _draw_tile(tile: np.ndarray, mark: str) -> None:
    tile[:] = COLOURS["floor" if mark == " " else mark]
    if mark == " ":
        tile[0], tile[:, 0] = (220, 208, 188), (220, 208, 188)
        return
    tile[[0, -1]], tile[:, [0, -1]] = COLOURS["edge"], COLOURS["edge"]
    if mark in "OTD":
        colour = COLOURS[{"O": "onion", "T": "tomato", "D": "dish"}[mark]]
        for x, y in ((11, 20), (21, 20), (16, 11)):
            _draw_disc(tile, x, y, 6, COLOURS["dark"])
            _draw_disc(tile, x, y, 5, colour)
    elif mark == "S":
        tile[12:20, 4:28] = (200, 224, 200)
        tile[6:26, 14:18] = (200, 224, 200)


def _draw_soup(tile: np.ndarray, code: int, x: float, y: float, radius: float) -> None:
    """Broth with one dot per ingredient."""
    _draw_disc(tile, x, y, radius, COLOURS["broth"])
    onions, tomatoes = SOUPS[code - k.FIRST_SOUP]
    for i, name in enumerate(["onion"] * onions + ["tomato"] * tomatoes):
        angle = 2.1 * i - 1.57
        _draw_disc(
            tile, x + radius * 0.5 * np.cos(angle), y + radius * 0.5 * np.sin(angle), radius * 0.35, COLOURS[name]
        )


def _draw_pot(tile: np.ndarray, code: int, cooking: int) -> None:
    _draw_disc(tile, 16, 15, 12, COLOURS["pot"])
    if not code:
        return
    _draw_soup(tile, code, 16, 15, 9)
    if cooking == 1:
        tile[28:31, 3:29] = COLOURS["ready"]
    elif cooking > 1:
        tile[28:31, 3:29] = COLOURS["dark"]
        tile[28:31, 3 : 3 + max(1, 26 - cooking + 1)] = COLOURS["cooking"]


def _draw_item(tile: np.ndarray, code: int, x: float, y: float) -> None:
    if code in (k.ONION, k.TOMATO):
        _draw_disc(tile, x, y, 6, COLOURS["dark"])
        _draw_disc(tile, x, y, 5, COLOURS["onion" if code == k.ONION else "tomato"])
        return
    _draw_disc(tile, x, y, 8, COLOURS["dark"])
    _draw_disc(tile, x, y, 7, COLOURS["dish"])
    if code == k.DISH:
        _draw_disc(tile, x, y, 4, (216, 216, 216))
    else:
        _draw_soup(tile, code, x, y, 5.5)


def _draw_player(tile: np.ndarray, index: int, side: int, held: int) -> None:
    """A head under a coloured hat; the nose, and what is held, point where the player faces."""
    dx, dy = DIRECTIONS[side]
    _draw_disc(tile, 16, 16, 11, COLOURS["dark"])
    _draw_disc(tile, 16, 16, 10, COLOURS["skin"])
    _draw_disc(tile, 16 - 3 * dx, 16 - 3 * dy, 8, HATS[index])
    _draw_disc(tile, 16 + 10 * dx, 16 + 10 * dy, 3, COLOURS["dark"])
    if held:
        _draw_item(tile, held, 16 + 7 * dx, 16 + 7 * dy)
