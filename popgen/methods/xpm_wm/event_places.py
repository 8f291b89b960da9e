"""Where events happened: rows of a replay apart by the own state of the player who caused an event."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.methods.xpm_wm.real_play import part_weights


class EventPlaces:
    """Draws a place where an event happened, all places alike.

    Args:
        env: encodes states.
        view: with `own` entries.
    """

    def __init__(self, env: BatchedEnv, view: str) -> None:
        self.env, self.view = env, view
        self._known: dict[Hashable, tuple[np.ndarray, list[np.ndarray]]] = {}

    def draw(
        self, name: Hashable, rows: np.ndarray, states: np.ndarray, caused: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """The rows of one place.

        Args:
            name: of the rows; they are split anew where they are another array than before.
            rows: (N,) at which the event was caused, at least one.
            states, caused: (size, S) and (size, P) of the whole replay: how often each player caused the event.
            rng: draws.
        """
        if name not in self._known or self._known[name][0] is not rows:
            keys = key_places(self.env, self.view, states[rows], caused[rows])
            self._known[name] = rows, split_by_key(rows, keys)
        groups = self._known[name][1]
        return groups[int(rng.integers(len(groups)))]


def key_places(env: BatchedEnv, view: str, states: np.ndarray, caused: np.ndarray) -> np.ndarray:
    """A key of the own state (where, how turned, with what in hand) of the player who caused an event.

    Args:
        env: encodes states.
        view: with `own` entries.
        states: (N, S), in which the event was caused.
        caused: (N, P), how often by each player; where several did, the first counts.

    Returns:
        (N,) int64.
    """
    spec = env.spec.views[view]
    obs = env.encode(states, view).reshape(*caused.shape, *spec.shape)
    keys = np.zeros(caused.shape, np.int64)
    for part, weights in zip(spec.own, part_weights(spec), strict=True):
        keys += (obs[..., list(part)] > 0).astype(np.int64) @ weights
    who = (caused > 0).argmax(1)
    return np.take_along_axis(keys, who[:, None], 1)[:, 0]


def split_by_key(rows: np.ndarray, keys: np.ndarray) -> list[np.ndarray]:
    """The rows of each key, in order; keys ascend."""
    order = np.argsort(keys, kind="stable")
    cuts = np.flatnonzero(np.diff(keys[order])) + 1
    return np.split(rows[order], cuts) if len(rows) else []
