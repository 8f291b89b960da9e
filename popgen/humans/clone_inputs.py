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
        self._faces = np.zeros((256, 4, len(self._tiles)), bool)
        self._always = np.zeros((len(TARGETS), len(self._tiles)), bool)
        for number, mark in enumerate("ODS"):
            self._always[number, self._spans[mark]] = True
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
                self._faces[cell[1] * width + cell[0], direction, number] = True
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
        present = self._find_present(states)
        distance = np.where(present, self._distance[cell][:, None], FAR)
        nearest = distance.argmin(-1)
        least = np.take_along_axis(distance, nearest[..., None], -1)[..., 0]
        found = least < FAR
        out = np.zeros((len(states), len(TARGETS), PER_TARGET), np.float32)
        out[..., 0] = found
        out[..., 1] = np.where(found, 1.0 / (1.0 + least), 0.0)
        out[..., 2:6] = self._leads[cell[:, None], nearest] * found[..., None]
        out[..., 6] = (present & self._faces[cell, facing][:, None]).any(-1)
        return out.reshape(len(states), -1)

    def _find_present(self, states: np.ndarray) -> np.ndarray:
        """(N, TARGETS, tiles) bool: which tiles each of TARGETS is at."""
        pots = len(self._env.tables.pots)
        contents = states[:, k.POTS : k.POTS + 2 * pots : 2]
        cooking = states[:, k.POTS + 1 : k.POTS + 2 * pots : 2]
        counters = states[:, k.POTS + 2 * pots :]
        present = np.repeat(self._always[None], len(states), 0)
        in_pots = (contents == 0, (contents != 0) & (cooking == 0), cooking > 1, cooking == 1)
        on_counters = (counters == k.ONION, counters == k.DISH, counters >= k.FIRST_SOUP, counters == 0)
        for number, there in enumerate((*in_pots, *on_counters), start=3):
            present[:, number, self._spans["P" if number < 7 else "X"]] = there
        return present
