"""Events of a transition read off overcooked_ai's own objects, one player and one rule at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from overcooked_ai_py.mdp.actions import Action, Direction

from popgen.envs.overcooked.transition_events import EVENTS

PLACES = {"X": "counter", "O": "dispenser", "T": "dispenser", "D": "dispenser", "P": "pot"}


def read_events(mdp: Any, state: Any, joint: tuple[Any, Any]) -> np.ndarray:
    """(2, T) events of the step from `state` with the players' actions."""
    after, infos = mdp.get_state_transition(state, joint)
    names: list[set[str]] = [set(), set()]
    working = state.deepcopy()  # the second player finds what the first one left
    for seat, action in enumerate(joint):
        if action == Action.INTERACT:
            names[seat] = _interact_names(mdp, working, seat)
            if "take_dish_from_dispenser" in names[seat] and infos["event_infos"]["useful_dish_pickup"][seat]:
                names[seat].add("useful_dish")
        elif action == Action.STAY:
            names[seat] = {"stay"}
        else:
            assert action in Direction.ALL_DIRECTIONS
            names[seat] = {"move"}
            if after.players[seat].position != state.players[seat].position:
                names[seat].add("walk")
            elif after.players[seat].orientation == state.players[seat].orientation:
                names[seat].add("idle_move")
    return np.array([[name in seat for name in EVENTS] for seat in names], np.uint8)


def _interact_names(mdp: Any, working: Any, seat: int) -> set[str]:
    """Names of one player's interact, which is carried out in `working`."""
    player = working.players[seat]
    target = Action.move_in_direction(player.position, player.orientation)
    tile = mdp.get_terrain_type_at_pos(target)
    before = player.held_object.name if player.has_object() else None
    idle = working.get_object(target).is_idle if tile == "P" and working.has_object(target) else False
    alone = [Action.STAY, Action.STAY]
    alone[seat] = Action.INTERACT
    mdp.resolve_interacts(working, alone, {event: [False, False] for event in _logged_names()})
    player = working.players[seat]
    held = player.held_object.name if player.has_object() else None
    if before != held:
        if before is None:
            return {f"take_{held}_from_{PLACES[tile]}"}
        if before == "dish" and held == "soup":
            return {"take_soup_from_pot"}
        assert held is None
        return {"deliver_soup"} if tile == "S" else {f"put_{before}_{'in' if tile == 'P' else 'on'}_{PLACES[tile]}"}
    if tile == "P" and idle and before is None and not working.get_object(target).is_idle:
        return {"start_pot"}
    if tile == "X":
        return {"idle_interact_counter"}
    return {"idle_interact_refused" if before is not None and tile in "PS" else "idle_interact_empty"}


def _logged_names() -> list[str]:
    from overcooked_ai_py.mdp.overcooked_mdp import EVENT_TYPES

    return EVENT_TYPES
