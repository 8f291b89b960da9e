"""A kitchen as the browser needs it: rules as tables, and pictures of everything that can be in a cell."""

from __future__ import annotations

from typing import Any

import numpy as np

from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked.exported_kitchen import export_kitchen
from popgen.envs.overcooked.render import KitchenTiles, list_tiles
from popgen.pages.tile_atlas import to_data_url

ACROSS = 16
"""Tiles in a row of the picture that holds them all."""


def describe_kitchen(env: OvercookedEnv) -> dict[str, Any]:
    """`export_kitchen`, with `tiles`.

    Keys of tiles: url (a PNG of all, `across` in a row); ground (numbers by cell); pots, counters and players (what is
    there, by commas -> number); pot_cells and counter_cells (in the order of the state).
    """
    tiles, width = list_tiles(env.kitchen), env.layout.width

    def index_cells(cells: list[tuple[int, int]]) -> list[int]:
        return [y * width + x for x, y in cells]

    drawn = {
        "url": to_data_url(_arrange_tiles(tiles)),
        "across": ACROSS,
        "ground": tiles.ground,
        "pots": {f"{contents},{cooking}": number for (contents, cooking), number in tiles.pots.items()},
        "counters": {f"{code}": number for code, number in tiles.counters.items()},
        "players": {",".join(map(str, hand)): number for hand, number in tiles.players.items()},
        "pot_cells": index_cells(env.tables.pots),
        "counter_cells": index_cells(env.tables.counters),
    }
    return {**export_kitchen(env), "tiles": drawn}


def _arrange_tiles(tiles: KitchenTiles) -> np.ndarray:
    """One picture (rows * 32, ACROSS * 32, 3)."""
    count, side = tiles.pictures.shape[:2]
    rows = -(-count // ACROSS)
    whole = np.zeros((rows * ACROSS, side, side, 3), np.uint8)
    whole[:count] = tiles.pictures
    return whole.reshape(rows, ACROSS, side, side, 3).swapaxes(1, 2).reshape(rows * side, ACROSS * side, 3)
