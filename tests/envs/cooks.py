"""Scripted cooks that make every event occur often in any layout, for comparing simulators."""

from __future__ import annotations

from collections import deque

import numpy as np

from popgen.envs.overcooked import OvercookedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.layout import DIRECTIONS
from popgen.envs.overcooked.rules import SOUPS

FAR = 10_000
INGREDIENTS = (k.ONION, k.TOMATO)


class Kitchen:
    """Where things are, and how far every floor cell is from standing beside every other tile."""

    def __init__(self, env: OvercookedEnv) -> None:
        layout = env.layout
        self.env, self.width = env, layout.width
        self.marks = {mark: [self.index(cell) for cell in layout.usable(mark)] for mark in "OTDPSX"}
        self.slot = {cell: int(env.tables.table[k.SLOT, cell]) for cell in self.marks["P"] + self.marks["X"]}
        self.shared = [self.index(cell) for cell in layout.usable("X") if len(layout.users(cell)) == 2]
        self.shared_areas = layout.areas[0] == layout.areas[1]
        self.floor = {self.index(cell) for cell in layout.floor}
        self.moves = [dx + dy * self.width for dx, dy in DIRECTIONS]
        tiles = [tile for tiles in self.marks.values() for tile in tiles]
        self.distance = {tile: self._flood(tile) for tile in tiles}

    def index(self, cell: tuple[int, int]) -> int:
        return cell[1] * self.width + cell[0]

    def _flood(self, tile: int) -> dict[int, int]:
        front = deque((tile + move, 0) for move in self.moves if tile + move in self.floor)
        seen = dict(front)
        while front:
            cell, far = front.popleft()
            for move in self.moves:
                if cell + move in self.floor and cell + move not in seen:
                    seen[cell + move] = far + 1
                    front.append((cell + move, far + 1))
        return seen

    def contents(self, row: list[int], pot: int) -> tuple[int, int]:
        """(number of ingredients, cooking byte) of a pot."""
        code, cooking = row[self.slot[pot]], row[self.slot[pot] + 1]
        return (sum(SOUPS[code - k.FIRST_SOUP]) if code else 0), cooking


class Cook:
    """Plays one seat: goes the shortest way to the nearest tile that is of use, and is random now and then."""

    def __init__(self, kitchen: Kitchen, seat: int, rng: np.random.Generator, randomness: float = 0.15) -> None:
        self.kitchen, self.seat, self.rng, self.randomness = kitchen, seat, rng, randomness

    def act(self, state: np.ndarray) -> int:
        """An action for the state row (S,)."""
        row = state.tolist()  # Python's numbers are faster one by one
        if self.rng.random() < self.randomness:
            return int(self.rng.choice(6, p=(0.14, 0.14, 0.14, 0.14, 0.04, 0.4)))
        tiles = self._wanted(row)
        here = row[self.seat]
        near = [(self.kitchen.distance[tile].get(here, FAR), self.rng.random(), tile) for tile in tiles]
        near = [entry for entry in near if entry[0] < FAR]
        if not near:
            return int(self.rng.integers(6))
        return self._go(row, here, min(near)[2])

    def _go(self, row: list[int], here: int, tile: int) -> int:
        kitchen = self.kitchen
        if tile - here in kitchen.moves:
            side = kitchen.moves.index(tile - here)
            return k.INTERACT if row[k.ORIENT + self.seat] == side else side
        far = kitchen.distance[tile]
        order = self.rng.permutation(4)
        best = min(order, key=lambda side: far.get(here + kitchen.moves[side], FAR))
        blocked = here + kitchen.moves[best] == row[1 - self.seat]
        return int(self.rng.integers(6)) if blocked and self.rng.random() < 0.5 else int(best)

    def _reachable(self, row: list[int], tiles: list[int]) -> list[int]:
        here = row[self.seat]
        return [tile for tile in tiles if here in self.kitchen.distance[tile]]

    def _wanted(self, row: list[int]) -> list[int]:
        """Tiles to interact with next."""
        kitchen = self.kitchen
        held = row[k.HELD + self.seat]
        if held == 0:
            return self._wanted_empty_handed(row)
        pots = {pot: kitchen.contents(row, pot) for pot in kitchen.marks["P"]}
        if held in INGREDIENTS:
            goal = [
                pot
                for pot, (count, cooking) in pots.items()
                if not cooking and count < kitchen.env.rules.max_ingredients
            ]
            if not goal:  # nothing to fill: put it away
                return self._free(row, kitchen.marks["X"])
        elif held == k.DISH:
            goal = [pot for pot, (_, cooking) in pots.items() if cooking]
            goal = [pot for pot in goal if pots[pot][1] == 1] or goal
            if not goal:
                return self._free(row, kitchen.marks["X"])
        else:
            goal = kitchen.marks["S"]
        return self._reachable(row, goal) or self._free(row, kitchen.shared)

    def _wanted_empty_handed(self, row: list[int]) -> list[int]:
        kitchen = self.kitchen
        pots = {pot: kitchen.contents(row, pot) for pot in kitchen.marks["P"]}
        full = kitchen.env.rules.max_ingredients
        if kitchen.env.cooking == "interact":
            early = self.rng.random() < 0.05
            start = [pot for pot, (n, cooking) in pots.items() if not cooking and (n == full or (n and early))]
            if self._reachable(row, start):
                return self._reachable(row, start)
        soups = self._lying(row, range(k.FIRST_SOUP, 256))
        if self._reachable(row, kitchen.marks["S"]) and soups:
            return soups
        open_pots = [pot for pot, (n, cooking) in pots.items() if not cooking and n < full]
        cooking = sum(1 for n, cooks in pots.values() if cooks or n == full)
        dishes = int(row[k.HELD + 1 - self.seat] == k.DISH) + sum(
            row[kitchen.slot[tile]] == k.DISH for tile in kitchen.shared
        )
        if cooking and (dishes < cooking or not open_pots):
            return self._sources(row, [k.DISH], kitchen.marks["D"])
        return self._sources(row, INGREDIENTS, kitchen.marks[self.rng.choice([m for m in "OT" if kitchen.marks[m]])])

    def _sources(self, row: list[int], codes: list[int] | tuple[int, ...], dispensers: list[int]) -> list[int]:
        """Dispensers and counters with such an object; who must pass things on leaves what he has passed alone."""
        kitchen = self.kitchen
        lying = self._lying(row, codes)
        own = self._reachable(row, dispensers)
        if own and not kitchen.shared_areas:
            lying = [tile for tile in lying if tile not in kitchen.shared]
        return own + lying

    def _lying(self, row: list[int], codes: range | list[int] | tuple[int, ...]) -> list[int]:
        lying = [tile for tile in self.kitchen.marks["X"] if row[self.kitchen.slot[tile]] in codes]
        return self._reachable(row, lying)

    def _free(self, row: list[int], counters: list[int]) -> list[int]:
        return [tile for tile in self._reachable(row, counters) if row[self.kitchen.slot[tile]] == 0]
