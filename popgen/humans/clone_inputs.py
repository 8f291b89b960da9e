"""Where things are from where a player stands: what makes a clone's network act alike in alike situations.

People go to the nearest thing that is of use. One-hot cells alone do not say where that is, and some ten thousand
recorded steps are too few to learn it for every pair of cells.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from popgen.envs import make_env
from popgen.envs.contract import EnvSpec
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.env import OvercookedEnv
from popgen.envs.overcooked.layout import DIRECTIONS

TARGETS = (
    *("onion dispenser", "dish dispenser", "serving location"),
    *("empty pot", "filling pot", "cooking pot", "ready pot"),
    *("onion on counter", "dish on counter", "soup on counter", "empty counter"),
)
"""What the nearest of is looked for, beside every kind of dispenser that a layout has not."""

PER_TARGET = 7
"""Numbers for each target: there is one, its distance, the four directions that lead to it, and it is faced."""

FAR = 99


class NearestTargets:
    """For each of TARGETS, how far the nearest one is that the player can reach, and which way.

    Args:
        spec: of an Overcooked environment.

    Raises:
        ValueError: another environment.
    """

    def __init__(self, spec: EnvSpec) -> None:
        env = make_env(spec.name, 1, **spec.params)
        if not isinstance(env, OvercookedEnv):
            raise ValueError(f"human clones know Overcooked only, not {spec.name}")
        self._env, layout = env, env.layout
        self.size = len(TARGETS) * PER_TARGET
        marks = [layout.usable(mark) for mark in "ODSPX"]
        self._tiles = [cell for cells in marks for cell in cells]
        bounds = np.cumsum([0, *(len(cells) for cells in marks)])
        self._spans = {mark: slice(a, b) for mark, a, b in zip("ODSPX", bounds[:-1], bounds[1:], strict=True)}
        self._distance = np.full((256, len(self._tiles)), FAR, np.int16)
        self._leads = np.zeros((256, len(self._tiles), 4), np.float32)
        self._faces = np.zeros((256, 4, len(self._tiles)), np.float32)
        for number, tile in enumerate(self._tiles):
            self._measure(number, tile)

    def _measure(self, number: int, tile: tuple[int, int]) -> None:
        """Steps from every floor cell to one beside the tile, and the directions that shorten the way."""
        width, floor = self._env.layout.width, set(self._env.layout.floor)
        distance: dict[tuple[int, int], int] = {}
        front: deque[tuple[int, int]] = deque()
        for direction, (dx, dy) in enumerate(DIRECTIONS):
            cell = (tile[0] - dx, tile[1] - dy)
            if cell in floor:
                distance[cell] = 0
                front.append(cell)
                self._leads[cell[1] * width + cell[0], number, direction] = 1.0
                self._faces[cell[1] * width + cell[0], direction, number] = 1.0
        while front:
            x, y = front.popleft()
            for dx, dy in DIRECTIONS:
                cell = (x + dx, y + dy)
                if cell in floor and cell not in distance:
                    distance[cell] = distance[x, y] + 1
                    front.append(cell)
        for (x, y), steps in distance.items():
            self._distance[y * width + x, number] = steps
            for direction, (dx, dy) in enumerate(DIRECTIONS):
                if steps and distance.get((x + dx, y + dy), FAR) < steps:
                    self._leads[y * width + x, number, direction] = 1.0

    def look(self, obs: np.ndarray) -> np.ndarray:
        """Players' `features` (N, F) uint8 -> (N, self.size) float32, each from the player's own place."""
        states = self._env.features_to_states(obs)
        cell, facing = states[:, 0], states[:, k.ORIENT] & 3
        rows = np.arange(len(states))
        out = np.zeros((len(states), len(TARGETS), PER_TARGET), np.float32)
        for number, (span, present) in enumerate(self._present(states)):
            if present is not None and not present.shape[1]:
                continue
            distance = self._distance[:, span][cell]
            if present is not None:
                distance = np.where(present, distance, FAR)
            nearest = distance.argmin(1)
            found = distance[rows, nearest] < FAR
            out[:, number, 0] = found
            out[:, number, 1] = np.where(found, 1.0 / (1.0 + distance[rows, nearest]), 0.0)
            out[:, number, 2:6] = self._leads[:, span][cell, nearest] * found[:, None]
            faced = self._faces[:, :, span][cell, facing]
            out[:, number, 6] = (faced if present is None else faced * present).any(1)
        return out.reshape(len(states), -1)

    def _present(self, states: np.ndarray) -> list[tuple[slice, np.ndarray | None]]:
        """For each of TARGETS the tiles it can be, and where it is (None: everywhere)."""
        pots = len(self._env.tables.pots)
        contents = states[:, k.POTS : k.POTS + 2 * pots : 2]
        cooking = states[:, k.POTS + 1 : k.POTS + 2 * pots : 2]
        counters = states[:, k.POTS + 2 * pots :]
        pot, counter = self._spans["P"], self._spans["X"]
        return [
            (self._spans["O"], None),
            (self._spans["D"], None),
            (self._spans["S"], None),
            (pot, contents == 0),
            (pot, (contents != 0) & (cooking == 0)),
            (pot, cooking > 1),
            (pot, cooking == 1),
            (counter, counters == k.ONION),
            (counter, counters == k.DISH),
            (counter, counters >= k.FIRST_SOUP),
            (counter, counters == 0),
        ]
