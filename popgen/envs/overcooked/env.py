"""The batched two-player Overcooked environment."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from popgen.envs.contract import BatchedEnv, EnvSpec, ViewSpec
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked import render
from popgen.envs.overcooked.layout import choose_cooking, load_layout
from popgen.envs.overcooked.rules import check_orders, describe_left_out, resolve
from popgen.envs.overcooked.start import possible_contents, start_row
from popgen.envs.overcooked.tables import build_tables
from popgen.errors import UserError
from popgen.types import StepBatch

ACTION_NAMES = ("north", "south", "east", "west", "stay", "interact")
EVENT_NAMES = ("takes_ingredient", "takes_dish", "pots_ingredient", "takes_soup", "delivers_soup")
EVENT_WEIGHTS = (1.0, 1.0, 1.0, 3.0, 12.0)
"""The paper's events and their weights (appendix D.2); the last is that of the dearest soup of a kitchen."""
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
        _check_choice("env.cooking", cooking, (None, "auto", "interact"))
        _check_choice("env.events", events, ("dispenser", "raw"))
        if isinstance(horizon, bool) or not isinstance(horizon, int) or not 1 <= horizon <= MAX_HORIZON:
            raise UserError("env.horizon", f"must be a whole number from 1 to {MAX_HORIZON}, got {horizon!r}")
        if num_envs < 1:
            raise UserError("num_envs", f"must be at least 1, got {num_envs}")
        self.layout = load_layout(layout, grid, rules)
        cooking = choose_cooking(self.layout, cooking)
        field = "env.rules" if grid is not None else "env.layout"
        self.rules = resolve(self.layout.config, field)
        self.cooking, self.events, self.horizon = cooking, events, horizon
        self.num_envs = num_envs
        self._start = start_row(self.layout, self.rules)
        auto = cooking == "auto"
        contents, soups = possible_contents(self.layout, self.rules, self._start, auto)
        check_orders(self.rules, soups, field)
        self.tables = build_tables(
            self.layout, self.rules, contents, soups, auto=auto, raw=events == "raw", horizon=horizon
        )
        self.spec = self._make_spec(soups)
        self._states = np.empty((num_envs, len(self._start)), np.uint8)
        self.reset(seed)

    def _make_spec(self, soups: list[tuple[int, int]]) -> EnvSpec:
        layout = self.layout
        params: dict[str, Any] = {"cooking": self.cooking, "events": self.events, "horizon": self.horizon}
        if not layout.from_file:
            params["grid"] = "/".join(layout.rows)
            if layout.config:
                params["rules"] = layout.config
        views = {
            "features": ViewSpec((len(self.tables.feature_names),), "uint8", True, 1.0, self._swap()),
            "lossless": self._lossless_view(),
        }
        return EnvSpec(
            name=f"overcooked/{layout.name}",
            horizon=self.horizon,
            num_actions=k.NUM_ACTIONS,
            action_names=ACTION_NAMES,
            state_size=len(self._start),
            state_dtype="uint8",
            views=views,
            event_names=self._event_names(),
            event_weights=self._event_weights(),
            score_name="dishes",
            params=params,
            fingerprint=self._fingerprint(soups),
            notes=describe_left_out(self.rules, soups, self.cooking),
        )

    def _event_names(self) -> tuple[str, ...]:
        """One delivery event, or one for each sum that soups are worth where these differ."""
        *others, delivery = EVENT_NAMES
        worths = self.tables.worths
        return (*others, delivery) if len(worths) == 1 else (*others, *(f"{delivery}_worth_{w:g}" for w in worths))

    def _event_weights(self) -> tuple[float, ...]:
        """Deliveries pay in proportion to what the game pays for the soup; a soup that it does not pay is no event."""
        *others, delivery = EVENT_WEIGHTS
        dearest = self.tables.worths[-1]  # infinite in one of overcooked_ai's own layouts
        return (
            *others,
            *(delivery if worth == dearest else delivery * worth / dearest for worth in self.tables.worths),
        )

    def _lossless_view(self) -> ViewSpec:
        """Ingredients and steps left to cook are counts; all other channels are 0 or 1."""
        maxima = np.ones(k.CHANNELS)
        maxima[k.C_IN_POT : k.C_IN_SOUP + 2] = self.rules.max_ingredients
        maxima[k.C_COOK] = max(1, int(self.tables.meta[k.M_COOK]))
        shape = (self.layout.width, self.layout.height, k.CHANNELS)
        return ViewSpec(shape, "uint8", False, float(maxima.max()), maxima=tuple(maxima.tolist()))

    def _swap(self) -> tuple[int, ...]:
        """Index array that turns one player's features into the other's."""
        meta = self.tables.meta
        order: list[int] = []
        start = 0
        for size in (int(meta[k.M_FLOOR]), 4, int(meta[k.M_ITEM])):
            order += [*range(start + size, start + 2 * size), *range(start, start + size)]
            start += 2 * size
        return (*order, *range(start, len(self.tables.feature_names)))

    def _fingerprint(self, soups: list[tuple[int, int]]) -> str:
        """Only what can be seen in play counts: the recipes that this kitchen can cook, not how the file wrote them."""
        facts = {
            "grid": list(self.layout.rows),
            "cooking": self.cooking,
            "events": self.events,
            "horizon": self.horizon,
            "ingredients": self.rules.max_ingredients,
            "soups": [[*soup, self.rules.reward[soup], self.rules.cook_time[soup]] for soup in soups],
            "start": self._start.tolist(),
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def reset(self, seed: int | None = None, indices: np.ndarray | None = None) -> None:
        """Start new episodes in all (or the given) environments; there is no randomness to seed."""
        self._states[slice(None) if indices is None else indices] = self._start

    def step(self, actions: np.ndarray) -> StepBatch:
        """Play joint `actions` (N, 2); raises ValueError on a wrong shape or an unknown action."""
        reward, score, events, truncated = self._advance(self._states, self._actions(actions, (self.num_envs, 2)))
        return StepBatch(reward, score, events, np.zeros(self.num_envs, bool), truncated)

    def simulate(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, StepBatch]:
        """F(s, a): states (..., S) uint8 and actions (..., 2) to the next states (..., S) and what the step gave.

        Pure: neither the arguments nor this environment's own states change. The arrays of the StepBatch have the
        same leading shape as the states.

        Raises:
            ValueError: wrong shape or dtype, or an unknown action.
        """
        states = self._rows(states)
        lead = states.shape[:-1]
        following = states.reshape(-1, states.shape[-1]).copy()
        reward, score, events, truncated = self._advance(following, self._actions(actions, (*lead, 2)).reshape(-1, 2))
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
        states = self._rows(states)
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
        states = self._rows(states)
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
        states = self._rows(states)
        return states[..., k.TIME].astype(np.int64) + 256 * states[..., k.TIME + 1].astype(np.int64)

    def set_time(self, time: np.ndarray) -> None:
        """Overwrite the time steps (N,); raises ValueError unless they are 0 to 65535."""
        time = np.broadcast_to(np.asarray(time, np.int64), (self.num_envs,))
        if time.min() < 0 or time.max() > MAX_HORIZON:
            raise ValueError(f"time: must be from 0 to {MAX_HORIZON}")
        self._states[:, k.TIME], self._states[:, k.TIME + 1] = time & 255, time >> 8

    def render_text(self, index: int = 0) -> str:
        """One kitchen as text, seven characters a cell."""
        return render.as_text(self, self._states[index])

    def render_rgb(self, index: int = 0) -> np.ndarray:
        """One kitchen as an (H * 32, W * 32, 3) uint8 picture."""
        return render.as_rgb(self, self._states[index])

    @property
    def feature_names(self) -> tuple[str, ...]:
        """What each entry of `features` says, such as `self_at_1,2`."""
        return self.tables.feature_names

    def _advance(
        self, states: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Step `states` in place; the results are new arrays, which callers may keep."""
        count = len(states)
        reward, score = np.empty(count, np.float32), np.empty(count, np.float32)
        events, truncated = np.zeros((count, 2, self.spec.num_events), np.uint8), np.empty(count, bool)
        table, values, meta = self.tables.table, self.tables.values, self.tables.meta
        k.step(states.reshape(-1), states.shape[1], actions, table, values, meta, reward, score, events, truncated)
        return reward, score, events, truncated

    def _rows(self, states: np.ndarray) -> np.ndarray:
        states = np.asarray(states)
        if states.dtype != np.uint8 or states.shape[-1:] != self._start.shape:
            raise ValueError(f"states: expected uint8 (..., {len(self._start)}), got {states.dtype} {states.shape}")
        return np.ascontiguousarray(states)

    def _actions(self, actions: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        actions = np.asarray(actions)
        if actions.shape != shape or actions.dtype.kind not in "iu":
            raise ValueError(f"actions: expected whole numbers of shape {shape}, got {actions.dtype} {actions.shape}")
        if actions.size and (actions.max() >= k.NUM_ACTIONS or actions.min() < 0):
            raise ValueError(f"actions: must be from 0 to {k.NUM_ACTIONS - 1}")
        return np.ascontiguousarray(actions, np.uint8)


def _check_choice(field: str, value: Any, choices: tuple[str | None, ...]) -> None:
    if value not in choices:
        close = difflib.get_close_matches(str(value), [choice for choice in choices if choice], 1)
        fix = f"did you mean {close[0]!r}?" if close else f"choose {' or '.join(filter(None, choices))}"
        raise UserError(field, f"unknown value {value!r}", fix)
