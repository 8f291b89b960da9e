"""Between our kitchens and overcooked_ai's own objects: states, exact both ways, and the game itself.

Needs overcooked_ai; no other module of `popgen.envs` imports this one.
"""

from __future__ import annotations

from contextlib import redirect_stderr
from io import StringIO
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.layout import DIRECTIONS
from popgen.envs.overcooked.rules import NOTHING, SOUP_CODE, SOUPS
from popgen.envs.overcooked.start import ITEM_CODE

with redirect_stderr(StringIO()):  # gym, which overcooked_ai imports, prints that it is no longer maintained
    from overcooked_ai_py.mdp.overcooked_mdp import (
        ObjectState,
        OvercookedGridworld,
        OvercookedState,
        PlayerState,
        Recipe,
        SoupState,
    )

if TYPE_CHECKING:
    from popgen.envs.overcooked.env import OvercookedEnv

ITEM_NAME = {code: name for name, code in ITEM_CODE.items()}


class AutomaticGridworld(OvercookedGridworld):
    """Automatic cooking, which overcooked_ai 1.1.0 lacks and later versions call `old_dynamics`.

    A full pot begins to cook by itself; an empty-handed interact with a pot that does not cook does nothing.
    """

    old_dynamics = True

    def copy(self) -> AutomaticGridworld:
        """The same game; overcooked_ai's own copy would be one without automatic cooking."""
        made = super().copy()
        made.__class__ = AutomaticGridworld
        return cast("AutomaticGridworld", made)

    def soup_to_be_cooked_at_location(self, state: Any, pos: tuple[int, int]) -> bool:
        """No interact starts a pot."""
        return False

    def step_environment_effects(self, state: Any) -> None:
        """Time passes, in the pots that have just been filled too."""
        for thing in state.objects.values():
            if thing.name == "soup" and thing.is_idle and len(thing.ingredients) == Recipe.MAX_NUM_INGREDIENTS:
                thing.begin_cooking()
        super().step_environment_effects(state)


def to_overcooked_mdp(env: OvercookedEnv) -> OvercookedGridworld:
    """overcooked_ai's game with an environment's layout, orders, recipes and cooking mode.

    For a population: `to_overcooked_mdp(population.make_env())`. overcooked_ai keeps its recipes in one place for the
    whole process: play the game that was made last.
    """
    layout = env.layout
    if layout.from_file:
        mdp = OvercookedGridworld.from_layout_name(layout.name)
    else:
        config = {"layout_name": layout.name, **layout.config}
        config.pop("old_dynamics", None)  # the class below says it
        if config.get("start_state"):
            config["start_state"] = OvercookedState.from_dict(config["start_state"])
        mdp = OvercookedGridworld.from_grid(list(layout.rows), config)
    if env.cooking == "auto":
        mdp.__class__ = AutomaticGridworld
    return mdp


def _item_code(thing: Any, cooked: bool = True) -> int:
    """Object code of an overcooked_ai object (or None); raises ValueError for an uncooked soup off a pot."""
    if thing is None:
        return NOTHING
    if thing.name != "soup":
        return ITEM_CODE[thing.name]
    if cooked and not thing.is_ready:
        raise ValueError("a soup outside a pot must be ready")
    return SOUP_CODE[thing.ingredients.count("onion"), thing.ingredients.count("tomato")]


def from_overcooked_ai(env: OvercookedEnv, state: OvercookedState, time: int | None = None) -> np.ndarray:
    """State row (S,) uint8 of an `OvercookedState`.

    Args:
        env: an environment of the state's layout.
        time: time step within the episode; the state's own if None.

    Raises:
        ValueError: the state holds objects where this layout cannot have them.
    """
    width, tables = env.layout.width, env.tables
    row = np.zeros(env.spec.state_size, np.uint8)
    for i, player in enumerate(state.players):
        row[i] = player.position[1] * width + player.position[0]
        row[k.ORIENT + i] = DIRECTIONS.index(player.orientation)
        row[k.HELD + i] = _item_code(player.held_object)
    step = state.timestep if time is None else time
    row[k.TIME], row[k.TIME + 1] = step & 255, step >> 8
    for (x, y), thing in state.objects.items():
        cell = y * width + x
        slot = tables.table[k.SLOT, cell]
        if slot == 0:
            raise ValueError(f"nothing can lie at column {x}, row {y} of this layout")
        if tables.table[k.KIND, cell] != k.POT:
            row[slot] = _item_code(thing)
            continue
        row[slot] = _item_code(thing, cooked=False)
        row[slot + 1] = 0 if thing.is_idle else 1 + max(0, thing.cook_time - thing._cooking_tick)
    return row


def to_overcooked_ai(env: OvercookedEnv, row: np.ndarray) -> OvercookedState:
    """The `OvercookedState` of a state row (S,).

    The ingredients of mixed soups come onions first, since rows do not hold the order in which they went in.
    """

    def thing(code: int, cell: tuple[int, int], cooking: int = 1) -> Any:
        if code < k.FIRST_SOUP:
            return ObjectState(ITEM_NAME[code], cell)
        mix = SOUPS[code - k.FIRST_SOUP]
        tick = -1 if cooking == 0 else env.rules.cook_time[mix] - (cooking - 1)
        names = ["onion"] * mix[0] + ["tomato"] * mix[1]
        return SoupState(cell, [ObjectState(name, cell) for name in names], cooking_tick=tick)

    numbers = [int(number) for number in row]
    players = []
    for i in range(2):
        cell = (numbers[i] % env.layout.width, numbers[i] // env.layout.width)
        held = numbers[k.HELD + i]
        players.append(PlayerState(cell, DIRECTIONS[numbers[k.ORIENT + i]], thing(held, cell) if held else None))
    objects = {}
    for i, cell in enumerate(env.tables.pots):
        if numbers[k.POTS + 2 * i]:
            objects[cell] = thing(numbers[k.POTS + 2 * i], cell, numbers[k.POTS + 2 * i + 1])
    for i, cell in enumerate(env.tables.counters, start=k.POTS + 2 * len(env.tables.pots)):
        if numbers[i]:
            objects[cell] = thing(numbers[i], cell)
    config = env.layout.config.get("start_state") or {
        "all_orders": env.layout.config.get("start_all_orders"),
        "bonus_orders": env.layout.config.get("start_bonus_orders"),
    }
    orders = list(config.get("all_orders") or []) or [
        {"ingredients": _name_ingredients(soup)} for soup in env.rules.reward
    ]
    bonus = list(config.get("bonus_orders") or [])
    return OvercookedState(players, objects, bonus, orders, timestep=numbers[k.TIME] + 256 * numbers[k.TIME + 1])


def _name_ingredients(soup: tuple[int, int]) -> list[str]:
    return ["onion"] * soup[0] + ["tomato"] * soup[1]


def infer_joint_action(
    env: OvercookedEnv, state: np.ndarray, next_state: np.ndarray, own_seat: int, own_action: int
) -> int:
    """What the partner did, for agents that see only states.

    Several actions can have the same effect (a step against a wall one already faces): the answer is then `stay` if
    it is among them, else the first. Time steps are not compared.

    Raises:
        ValueError: no action of the partner explains the transition.
    """
    candidates = [k.STAY, *(action for action in range(k.NUM_ACTIONS) if action != k.STAY)]
    actions = np.empty((k.NUM_ACTIONS, 2), np.uint8)
    actions[:, own_seat], actions[:, 1 - own_seat] = own_action, candidates
    got = env.simulate(np.repeat(np.asarray(state)[None], k.NUM_ACTIONS, 0), actions)[0]
    got[:, k.TIME : k.POTS] = np.asarray(next_state)[k.TIME : k.POTS]
    fits = np.flatnonzero((got == next_state).all(-1))
    if not len(fits):
        raise ValueError("no action of the partner explains this transition")
    return candidates[fits[0]]
