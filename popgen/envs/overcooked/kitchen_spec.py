"""What popgen knows of a kitchen: views, events and their weights, parameters, fingerprint."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from popgen.envs.contract import EnvSpec, ViewSpec
from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.layout import Layout
from popgen.envs.overcooked.rules import Rules, describe_left_out
from popgen.envs.overcooked.tables import Tables

ACTION_NAMES = ("north", "south", "east", "west", "stay", "interact")
EVENT_NAMES = ("takes_ingredient", "takes_dish", "pots_ingredient", "takes_soup", "delivers_soup")
EVENT_WEIGHTS = (1.0, 1.0, 1.0, 3.0, 12.0)
"""The paper's events and their weights (appendix D.2); the last is that of the dearest soup of a kitchen."""


@dataclass(frozen=True)
class Kitchen:
    """One kitchen, worked out.

    Attributes:
        layout, rules: of its file.
        tables: that the kernels read.
        start: (S,) uint8, the state in which an episode begins.
        soups: (onions, tomatoes) of all that can be cooked here.
        cooking, events, horizon: see `OvercookedEnv`.
    """

    layout: Layout
    rules: Rules
    tables: Tables
    start: np.ndarray
    soups: list[tuple[int, int]]
    cooking: str
    events: str
    horizon: int


def make_spec(kitchen: Kitchen) -> EnvSpec:
    """The record that the rest of popgen works with."""
    tables = kitchen.tables
    shape, swap, own = (len(tables.feature_names),), _swap_players(tables), _list_own_parts(tables)
    features = ViewSpec(shape, "uint8", True, 1.0, swap, own=own)
    return EnvSpec(
        name=f"overcooked/{kitchen.layout.name}",
        horizon=kitchen.horizon,
        num_actions=k.NUM_ACTIONS,
        action_names=ACTION_NAMES,
        state_size=len(kitchen.start),
        state_dtype="uint8",
        views={"features": features, "lossless": _make_lossless_view(kitchen)},
        event_names=_name_events(kitchen.tables.worths),
        event_weights=_weigh_events(kitchen.tables.worths),
        score_name="dishes",
        params=_list_params(kitchen),
        fingerprint=_digest_rules(kitchen),
        notes=describe_left_out(kitchen.rules, kitchen.soups, kitchen.cooking),
    )


def _list_params(kitchen: Kitchen) -> dict[str, Any]:
    """What makes the same kitchen again; a layout of overcooked_ai is found by its name."""
    params: dict[str, Any] = {"cooking": kitchen.cooking, "events": kitchen.events, "horizon": kitchen.horizon}
    if not kitchen.layout.from_file:
        params["grid"] = "/".join(kitchen.layout.rows)
        if kitchen.layout.config:
            params["rules"] = kitchen.layout.config
    return params


def _name_events(worths: tuple[float, ...]) -> tuple[str, ...]:
    """One delivery event, or one for each sum that soups are worth where these differ."""
    *others, delivery = EVENT_NAMES
    return (*others, delivery) if len(worths) == 1 else (*others, *(f"{delivery}_worth_{w:g}" for w in worths))


def _weigh_events(worths: tuple[float, ...]) -> tuple[float, ...]:
    """Deliveries pay in proportion to what the game pays for the soup; a soup that it does not pay is no event."""
    *others, delivery = EVENT_WEIGHTS
    dearest = worths[-1]  # infinite in one of overcooked_ai's own layouts
    return (*others, *(delivery if worth == dearest else delivery * worth / dearest for worth in worths))


def _make_lossless_view(kitchen: Kitchen) -> ViewSpec:
    """Ingredients and steps left to cook are counts; all other channels are 0 or 1."""
    maxima = np.ones(k.CHANNELS)
    maxima[k.C_IN_POT : k.C_IN_SOUP + 2] = kitchen.rules.max_ingredients
    maxima[k.C_COOK] = max(1, int(kitchen.tables.meta[k.M_COOK]))
    shape = (kitchen.layout.width, kitchen.layout.height, k.CHANNELS)
    return ViewSpec(shape, "uint8", False, float(maxima.max()), maxima=tuple(maxima.tolist()))


def _list_own_parts(tables: Tables) -> tuple[tuple[int, ...], ...]:
    """Of the player who looks: its cell, its orientation and what it holds. The other's follow each."""
    parts, start = [], 0
    for size in (int(tables.meta[k.M_FLOOR]), 4, int(tables.meta[k.M_ITEM])):
        parts.append(tuple(range(start, start + size)))
        start += 2 * size
    return tuple(parts)


def _swap_players(tables: Tables) -> tuple[int, ...]:
    """Index array that turns one player's features into the other's."""
    order: list[int] = []
    for part in _list_own_parts(tables):
        order += [entry + len(part) for entry in part] + list(part)
    return (*order, *range(len(order), len(tables.feature_names)))


def _digest_rules(kitchen: Kitchen) -> str:
    """Only what can be seen in play counts: the recipes that this kitchen can cook, not how the file wrote them."""
    rules = kitchen.rules
    facts = {
        "grid": list(kitchen.layout.rows),
        "cooking": kitchen.cooking,
        "events": kitchen.events,
        "horizon": kitchen.horizon,
        "ingredients": rules.max_ingredients,
        "soups": [[*soup, rules.reward[soup], rules.cook_time[soup]] for soup in kitchen.soups],
        "start": kitchen.start.tolist(),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
