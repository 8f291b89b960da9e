"""The batched two-player Overcooked environment."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked import render
from popgen.envs.overcooked.kitchen_spec import Kitchen, make_spec
from popgen.envs.overcooked.layout import Layout, choose_cooking, load_layout
from popgen.envs.overcooked.rules import check_orders, resolve
from popgen.envs.overcooked.start import possible_contents, start_row
from popgen.envs.overcooked.tables import build_tables
from popgen.errors import UserError
from popgen.types import StepBatch

MAX_HORIZON = 65_535


class OvercookedEnv(BatchedEnv):
    """N kitchens with the rules of overcooked_ai 1.1.0, stepped by compiled code.

    The rules know no chance: `seed` is taken because every environment takes one, and changes nothing.

    States are rows of uint8 (see kernels.py). Views, each from the player's own side (self first):

    - `features`: (F,) of 0 and 1: one-hot cells (of those that some player can reach) and orientations of both
      players, what they hold, each pot's contents as thermometers of onions and tomatoes, steps left to cook as a
      one-hot (0 is ready), what lies on each reachable counter, and urgency (fewer than 40 steps left). Objects
      that cannot exist in the layout have no entries. Not included: walls and dispensers, which never change; the
      time step itself; which of the two players one is. The order in which a mixed soup's ingredients went in is
      no part of the state at all. A full pot that has not lost a step yet (only overcooked_ai's random start
      states hold one) shows no steps left.
    - `lossless`: (W, H, 26) counts, equal to overcooked_ai's `lossless_state_encoding`, x first.
    """

    def __init__(
        self,
        layout: str,
        num_envs: int = 1,
        *,
        seed: int = 0,
        cooking: str | None = None,
        events: str = "dispenser",
        horizon: int = 400,
        grid: str | None = None,
        rules: Mapping[str, Any] | None = None,
    ) -> None:
        """Build N kitchens, all at the start of an episode.

        Args:
            layout: name of a layout of overcooked_ai, or path of a .layout file; with `grid` only a label.
            num_envs: N.
            seed: ignored, see above.
            cooking: `auto`, a full pot starts by itself; or `interact`, an empty-handed interact starts a pot. None
                takes what a layout file says by `old_dynamics`, else `auto`.
            events: `dispenser` counts pick-ups at dispensers and pots only; `raw` as overcooked_ai logs them,
                at counters too. In both, a soup that the game does not pay is neither picked up nor delivered.
            horizon: steps of an episode.
            grid: the layout as text, rows separated by newlines or '/'.
            rules: order and recipe keys of a layout file, for `grid`; without them every recipe is worth 20 and
                cooks 20 steps, as in overcooked_ai.

        Raises:
            UserError: any of these is wrong, or the layout cannot be played.
        """
        _check_arguments(num_envs, cooking, events, horizon)
        self.num_envs = num_envs
        field = "env.rules" if grid is not None else "env.layout"
        self.kitchen = _work_out(load_layout(layout, grid, rules), field, cooking, events, horizon)
        self.layout, self.rules, self.tables = self.kitchen.layout, self.kitchen.rules, self.kitchen.tables
        self.cooking, self.events, self.horizon = self.kitchen.cooking, events, horizon
        self.spec = make_spec(self.kitchen)
        self._start = self.kitchen.start
        self._states = np.empty((num_envs, len(self._start)), np.uint8)
        self.reset(seed)

    def reset(self, seed: int | None = None, indices: np.ndarray | None = None) -> None:
        """Start new episodes in all (or the given) environments; there is no randomness to seed."""
        self._states[slice(None) if indices is None else indices] = self._start

    def step(self, actions: np.ndarray) -> StepBatch:
        """Play joint `actions` (N, 2); raises ValueError on a wrong shape or an unknown action."""
        reward, score, events, truncated = self._advance_states(
            self._states, self._check_actions(actions, (self.num_envs, 2))
        )
        return StepBatch(reward, score, events, np.zeros(self.num_envs, bool), truncated)

    def simulate(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, StepBatch]:
        """F(s, a): states (..., S) uint8 and actions (..., 2) to the next states (..., S) and what the step gave.

        Pure: neither the arguments nor this environment's own states change. The arrays of the StepBatch have the
        same leading shape as the states.

        Raises:
            ValueError: wrong shape or dtype, or an unknown action.
        """
        states = self._check_states(states)
        lead = states.shape[:-1]
        following = states.reshape(-1, states.shape[-1]).copy()
        reward, score, events, truncated = self._advance_states(
            following, self._check_actions(actions, (*lead, 2)).reshape(-1, 2)
        )
        batch = StepBatch(
            reward.reshape(lead),
            score.reshape(lead),
            events.reshape(*lead, 2, self.spec.num_events),
            np.zeros(lead, bool),
            truncated.reshape(lead),
        )
        return following.reshape(states.shape), batch

    def get_state(self, indices: np.ndarray | None = None) -> np.ndarray:
        """Copy of the states, (N, S) uint8."""
        return self._states.copy() if indices is None else self._states[indices]

    def set_state(self, states: np.ndarray, indices: np.ndarray | None = None) -> None:
        """Continue from the given states; raises ValueError on a wrong shape or dtype."""
        target = slice(None) if indices is None else np.asarray(indices)
        states = self._check_states(states)
        if states.shape != self._states[target].shape:
            raise ValueError(f"states: expected shape {self._states[target].shape}, got {states.shape}")
        self._states[target] = states

    def encode(self, states: np.ndarray, view: str = "features", out: np.ndarray | None = None) -> np.ndarray:
        """Observations (..., 2, *view.shape) uint8 of any states (..., S).

        Args:
            out: a C-contiguous uint8 array of the result's shape, to be filled and returned.

        Raises:
            ValueError: wrong shape or dtype, or no such view.
        """
        if view not in self.spec.views:
            raise ValueError(f"view: {view!r} is none of {', '.join(self.spec.views)}")
        states = self._check_states(states)
        shape = (*states.shape[:-1], 2, *self.spec.views[view].shape)
        if out is None:
            out = np.empty(shape, np.uint8)
        elif out.shape != shape or out.dtype != np.uint8 or not out.flags.c_contiguous:
            raise ValueError(f"out: expected C-contiguous uint8 of shape {shape}, got {out.dtype} of {out.shape}")
        rows, flat, tables = states.reshape(-1), out.reshape(-1), self.tables
        if view == "features":
            k.encode_features(rows, self.spec.state_size, tables.table, tables.meta, flat)
        else:
            k.encode_lossless(rows, self.spec.state_size, tables.table, tables.meta, tables.walls, flat)
        return out

    def observe(self, view: str = "features", out: np.ndarray | None = None) -> np.ndarray:
        """Observations (N, 2, *view.shape) of the current states."""
        return self.encode(self._states, view, out)

    def features_to_states(self, features: np.ndarray) -> np.ndarray:
        """States (..., S) of one player's features (..., F), with that player as the first.

        Exact but for the time step, which the features do not hold: it is 0, or the first urgent one.
        """
        size = self.spec.views["features"].shape[0]
        features = np.ascontiguousarray(features, np.uint8)
        if features.shape[-1:] != (size,):
            raise ValueError(f"features: expected shape (..., {size}), got {features.shape}")
        states = np.zeros((*features.shape[:-1], self.spec.state_size), np.uint8)
        rows = states.reshape(-1, self.spec.state_size)
        k.decode_features(features.reshape(-1, size), self.tables.meta, self.tables.codes, rows)
        return states

    def features_to_lossless(self, features: np.ndarray) -> np.ndarray:
        """The `lossless` view (..., W, H, 26) of the player whose `features` (..., F) these are."""
        return self.encode(self.features_to_states(features), "lossless")[..., 0, :, :, :]

    def time(self, states: np.ndarray) -> np.ndarray:
        """Time step within the episode of any states (..., S) -> (...) int64."""
        states = self._check_states(states)
        return states[..., k.TIME].astype(np.int64) + 256 * states[..., k.TIME + 1].astype(np.int64)

    def set_time(self, time: np.ndarray) -> None:
        """Overwrite the time steps (N,); raises ValueError unless they are 0 to 65535."""
        time = np.broadcast_to(np.asarray(time, np.int64), (self.num_envs,))
        if time.min() < 0 or time.max() > MAX_HORIZON:
            raise ValueError(f"time: must be from 0 to {MAX_HORIZON}")
        self._states[:, k.TIME], self._states[:, k.TIME + 1] = time & 255, time >> 8

    def render_text(self, index: int = 0) -> str:
        """One kitchen as text, seven characters a cell."""
        return render.as_text(self.kitchen, self._states[index])

    def render_rgb(self, index: int = 0) -> np.ndarray:
        """One kitchen as an (H * 32, W * 32, 3) uint8 picture."""
        return render.as_rgb(self.kitchen, self._states[index])

    @property
    def feature_names(self) -> tuple[str, ...]:
        """What each entry of `features` says, such as `self_at_1,2`."""
        return self.tables.feature_names

    def _advance_states(
        self, states: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Step `states` in place; the results are new arrays, which callers may keep."""
        count = len(states)
        reward, score = np.empty(count, np.float32), np.empty(count, np.float32)
        events, truncated = np.zeros((count, 2, self.spec.num_events), np.uint8), np.empty(count, bool)
        table, values, meta = self.tables.table, self.tables.values, self.tables.meta
        k.step(states.reshape(-1), states.shape[1], actions, table, values, meta, reward, score, events, truncated)
        return reward, score, events, truncated

    def _check_states(self, states: np.ndarray) -> np.ndarray:
        states = np.asarray(states)
        if states.dtype != np.uint8 or states.shape[-1:] != self._start.shape:
            raise ValueError(f"states: expected uint8 (..., {len(self._start)}), got {states.dtype} {states.shape}")
        return np.ascontiguousarray(states)

    def _check_actions(self, actions: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        actions = np.asarray(actions)
        if actions.shape != shape or actions.dtype.kind not in "iu":
            raise ValueError(f"actions: expected whole numbers of shape {shape}, got {actions.dtype} {actions.shape}")
        if actions.size and (actions.max() >= k.NUM_ACTIONS or actions.min() < 0):
            raise ValueError(f"actions: must be from 0 to {k.NUM_ACTIONS - 1}")
        return np.ascontiguousarray(actions, np.uint8)


def _check_arguments(num_envs: int, cooking: str | None, events: str, horizon: Any) -> None:
    _check_choice("env.cooking", cooking, (None, "auto", "interact"))
    _check_choice("env.events", events, ("dispenser", "raw"))
    if isinstance(horizon, bool) or not isinstance(horizon, int) or not 1 <= horizon <= MAX_HORIZON:
        raise UserError("env.horizon", f"must be a whole number from 1 to {MAX_HORIZON}, got {horizon!r}")
    if num_envs < 1:
        raise UserError("num_envs", f"must be at least 1, got {num_envs}")


def _work_out(layout: Layout, field: str, cooking: str | None, events: str, horizon: int) -> Kitchen:
    """Rules, start and tables of a layout; `field` is blamed in errors.

    Raises:
        UserError: its file contradicts `cooking`, or none of its orders can be cooked.
    """
    cooking = choose_cooking(layout, cooking)
    rules = resolve(layout.config, field)
    start = start_row(layout, rules)
    auto = cooking == "auto"
    contents, soups = possible_contents(layout, rules, start, auto)
    check_orders(rules, soups, field)
    tables = build_tables(layout, rules, contents, soups, auto=auto, raw=events == "raw", horizon=horizon)
    return Kitchen(layout, rules, tables, start, soups, cooking, events, horizon)


def _check_choice(field: str, value: Any, choices: tuple[str | None, ...]) -> None:
    if value not in choices:
        close = difflib.get_close_matches(str(value), [choice for choice in choices if choice], 1)
        fix = f"did you mean {close[0]!r}?" if close else f"choose {' or '.join(filter(None, choices))}"
        raise UserError(field, f"unknown value {value!r}", fix)
