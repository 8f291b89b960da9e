"""What each player did in a step, by object and place, from recorded states and actions alone.

The list is that of HSP (Yu et al. 2023, "Learning Zero-Shot Cooperation with Humans, Assuming Humans Are Biased"), with
tomatoes and with a name for everything a player can do. The counting is no part of the simulator: it needs no
change of the rules, and the environment's fingerprint does not depend on it.

All kernels are in this one file, with constants of their own, because numba's cache looks only at the file of the
compiled function; `_check_constants` compares them with those of kernels.py.
"""

from __future__ import annotations

import numpy as np

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.compiled_kernel import compile_helper, compile_kernel
from popgen.envs.overcooked.env import OvercookedEnv

EVENTS = (
    "put_onion_on_counter",
    "put_tomato_on_counter",
    "put_dish_on_counter",
    "put_soup_on_counter",
    "take_onion_from_counter",
    "take_tomato_from_counter",
    "take_dish_from_counter",
    "take_soup_from_counter",
    "take_onion_from_dispenser",
    "take_tomato_from_dispenser",
    "take_dish_from_dispenser",
    "useful_dish",
    "put_onion_in_pot",
    "put_tomato_in_pot",
    "start_pot",
    "take_soup_from_pot",
    "deliver_soup",
    "stay",
    "move",
    "walk",
    "idle_move",
    "idle_interact_counter",
    "idle_interact_empty",
    "idle_interact_refused",
)
"""Names of the T events, each at most once a step and player.

- put, take: an object changes hands; `take_soup_from_pot` gives up the dish. `useful_dish` comes beside
  `take_dish_from_dispenser` when no dish lies on a counter and fewer dishes are held than pots cook, are ready or are
  partly filled (before the step). `start_pot` exists under interact cooking only.
- `move`: a direction was chosen. `walk`: the cell changed. `idle_move`: neither cell nor orientation changed.
- idle interacts change nothing: at a counter (both hands and counter empty or both full); `empty`, at floor, a wall,
  a dispenser with full hands, a serving location or a pot with empty hands; `refused`, the object in hand is not
  taken by a pot or a serving location.

Every step is exactly one of `stay`, `move` and the outcomes of an interact, which are all others but `useful_dish`,
`walk` and `idle_move`.
"""

HSP_EVENTS = {
    "put_onion_on_X": ("put_onion_on_counter",),
    "put_dish_on_X": ("put_dish_on_counter",),
    "put_soup_on_X": ("put_soup_on_counter",),
    "pickup_onion_from_X": ("take_onion_from_counter",),
    "pickup_onion_from_O": ("take_onion_from_dispenser",),
    "pickup_dish_from_X": ("take_dish_from_counter",),
    "pickup_dish_from_D": ("take_dish_from_dispenser",),
    "pickup_soup_from_X": ("take_soup_from_counter",),
    "USEFUL_DISH_PICKUP": ("useful_dish",),
    "SOUP_PICKUP": ("take_soup_from_pot",),
    "PLACEMENT_IN_POT": ("put_onion_in_pot", "put_tomato_in_pot"),
    "delivery": ("deliver_soup",),
    "STAY": ("stay",),
    "MOVEMENT": ("move",),
    "IDLE_MOVEMENT": ("idle_move",),
    "IDLE_INTERACT_X": ("idle_interact_counter",),
    "IDLE_INTERACT_EMPTY": ("idle_interact_empty",),
}
"""HSP's 17 names and the events here whose sum each is."""

(
    PUT_ONION, PUT_TOMATO, PUT_DISH, PUT_SOUP, TAKE_ONION, TAKE_TOMATO, TAKE_DISH, TAKE_SOUP,
    DISPENSED_ONION, DISPENSED_TOMATO, DISPENSED_DISH, USEFUL_DISH, POTTED_ONION, POTTED_TOMATO, START_POT,
    POT_SOUP, DELIVERY, STAYED, MOVED, WALKED, IDLE_MOVE, IDLE_COUNTER, IDLE_EMPTY, IDLE_REFUSED, NUM_EVENTS,
) = range(25)  # fmt: skip

# the state's row, rows of the table, kinds of cells, actions and objects: equal to those of kernels.py
ORIENT, HELD, POTS = 2, 4, 8
NEXT, FACE, KIND, SLOT, ADD_ONION, ADD_TOMATO, COOK, FULL = 0, 4, 8, 9, 10, 11, 12, 13
COUNTER, ONIONS, TOMATOES, DISHES, POT, SERVE = 1, 2, 3, 4, 5, 6
STAY, INTERACT = 4, 5
ONION, TOMATO, DISH, FIRST_SOUP = 1, 2, 3, 4


def _check_constants() -> None:
    """Raises: RuntimeError, a constant above is not that of kernels.py any more."""
    names = (
        *("ORIENT", "HELD", "POTS", "NEXT", "FACE", "KIND", "SLOT", "ADD_ONION", "ADD_TOMATO", "COOK", "FULL"),
        *("COUNTER", "ONIONS", "TOMATOES", "DISHES", "POT", "SERVE"),
        *("STAY", "INTERACT", "ONION", "TOMATO", "DISH", "FIRST_SOUP"),
    )
    if wrong := [name for name in names if globals()[name] != getattr(k, name)]:
        raise RuntimeError(f"transition_events.py and kernels.py differ in {', '.join(wrong)}")


_check_constants()


@compile_helper
def _object_event(first, item):
    """The event of an object's kind, in the order onion, tomato, dish, soup from `first` on."""
    return first + (3 if item >= FIRST_SOUP else item - 1)


@compile_helper
def _count_waiting_pots(states, s, pots, table):
    """Pots that cook, are ready or are partly filled: those that will want a dish."""
    count = 0
    for slot in range(s + POTS, s + POTS + 2 * pots, 2):
        if states[slot] != 0 and (states[slot + 1] != 0 or table[FULL, states[slot]] != 1):
            count += 1
    return count


@compile_helper
def _use_pot(held, contents, cooking, table, auto):
    """(event, what is in hand after) of an interact with a pot."""
    if held == 0:
        return (START_POT, 0) if not auto and contents != 0 and cooking == 0 else (IDLE_EMPTY, 0)
    if held == DISH and contents != 0 and cooking == 1:
        return POT_SOUP, contents
    if held < DISH and cooking == 0 and table[ADD_ONION if held == ONION else ADD_TOMATO, contents] > 0:
        return (POTTED_ONION if held == ONION else POTTED_TOMATO), 0
    return IDLE_REFUSED, held


@compile_helper
def _take(kind):
    """(event, what is in hand after) of empty hands at a dispenser; elsewhere nothing happens."""
    if kind == ONIONS:
        return DISPENSED_ONION, ONION
    if kind == TOMATOES:
        return DISPENSED_TOMATO, TOMATO
    if kind == DISHES:
        return DISPENSED_DISH, DISH
    return IDLE_EMPTY, 0


@compile_helper
def _interact(row, p, table, auto):
    """Resolve player p's interact in `row`, of which hands, pots' contents and counters change; returns the event."""
    cell = table[FACE + (row[ORIENT + p] & 3), row[p]]
    kind, slot, held = table[KIND, cell], table[SLOT, cell], row[HELD + p]
    if kind == POT:
        event, after = _use_pot(held, row[slot], row[slot + 1], table, auto)
        row[HELD + p] = after
        if event == POT_SOUP:
            row[slot], row[slot + 1] = 0, 0
        elif event == START_POT:
            row[slot + 1] = 1 + table[COOK, row[slot]]
        elif event in (POTTED_ONION, POTTED_TOMATO):
            row[slot] = table[ADD_ONION if held == ONION else ADD_TOMATO, row[slot]]
        return event
    if kind == COUNTER:
        there = row[slot]
        if (held == 0) == (there == 0):
            return IDLE_COUNTER
        row[HELD + p], row[slot] = there, held
        return _object_event(TAKE_ONION, there) if held == 0 else _object_event(PUT_ONION, held)
    if held == 0:
        event, row[HELD + p] = _take(kind)
        return event
    if kind == SERVE:
        if held < FIRST_SOUP:
            return IDLE_REFUSED
        row[HELD + p] = 0
        return DELIVERY
    return IDLE_EMPTY


@compile_helper
def _dish_is_useful(row, waiting, first_counter):
    """Before a dish is taken at a dispenser; `waiting` pots are those before the step."""
    held = (1 if row[HELD] == DISH else 0) + (1 if row[HELD + 1] == DISH else 0)
    for slot in range(first_counter, row.shape[0]):
        if row[slot] == DISH:
            return False
    return held < waiting


@compile_helper
def _moves(row, actions, table, out):
    """Directions chosen: events of both players; if they would meet or cross, neither walks."""
    new0 = table[NEXT + actions[0], row[0]] if actions[0] < STAY else row[0]
    new1 = table[NEXT + actions[1], row[1]] if actions[1] < STAY else row[1]
    blocked = new0 == new1 or (new0 == row[1] and new1 == row[0])
    for p in range(2):
        if actions[p] < STAY:
            walks = not blocked and (new0 if p == 0 else new1) != row[p]
            out[p, MOVED] = 1
            if walks:
                out[p, WALKED] = 1
            elif (row[ORIENT + p] & 3) == actions[p]:
                out[p, IDLE_MOVE] = 1


@compile_kernel
def find_events(states, actions, table, pots, auto, row, out):
    """Events of N transitions.

    Args:
        states: (N, S) uint8.  actions: (N, 2) uint8.  table: see tables.Tables.  pots: how many there are.
        auto: full pots cook by themselves.  row: (S,) uint8 to work in.
        out: (N, 2, NUM_EVENTS) uint8, zeros, written.
    """
    first_counter = POTS + 2 * pots
    for n in range(states.shape[0]):
        if actions[n, 0] == INTERACT or actions[n, 1] == INTERACT:
            for i in range(states.shape[1]):
                row[i] = states[n, i]
            waiting = _count_waiting_pots(row, 0, pots, table)
            for p in range(2):
                if actions[n, p] == INTERACT:
                    useful = _dish_is_useful(row, waiting, first_counter)
                    event = _interact(row, p, table, auto)
                    out[n, p, event] = 1
                    if event == DISPENSED_DISH and useful:
                        out[n, p, USEFUL_DISH] = 1
        for p in range(2):
            if actions[n, p] == STAY:
                out[n, p, STAYED] = 1
        if actions[n, 0] < STAY or actions[n, 1] < STAY:
            _moves(states[n], actions[n], table, out[n])


def find_transition_events(env: OvercookedEnv, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Which player caused which event in any recorded transitions; what follows a state is decided by the rules.

    Args:
        env: an environment of the layout and cooking mode of the recording; its own states do not matter.
        states: (..., S) uint8 before the step.
        actions: (..., 2) whole numbers.

    Returns:
        (..., 2, T) uint8 of 0 and 1, in the order of EVENTS.

    Raises:
        ValueError: wrong shape or dtype, or an unknown action.
    """
    states, actions = np.asarray(states), np.asarray(actions)
    size = env.spec.state_size
    if states.dtype != np.uint8 or states.shape[-1:] != (size,):
        raise ValueError(f"states: expected uint8 (..., {size}), got {states.dtype} {states.shape}")
    lead = states.shape[:-1]
    if actions.shape != (*lead, 2) or actions.dtype.kind not in "iu":
        raise ValueError(f"actions: expected whole numbers of shape {(*lead, 2)}, got {actions.dtype} {actions.shape}")
    if actions.size and (actions.min() < 0 or actions.max() > INTERACT):
        raise ValueError(f"actions: must be from 0 to {INTERACT}")
    rows = np.ascontiguousarray(states).reshape(-1, size)
    joint = np.ascontiguousarray(actions, np.uint8).reshape(-1, 2)
    out = np.zeros((len(rows), 2, NUM_EVENTS), np.uint8)
    pots = len(env.tables.pots)
    find_events(rows, joint, env.tables.table, pots, env.cooking == "auto", np.empty(size, np.uint8), out)
    return out.reshape(*lead, 2, NUM_EVENTS)


def hsp_events(events: np.ndarray) -> np.ndarray:
    """(..., T) counts of EVENTS -> (..., 17) of HSP's names, in the order of HSP_EVENTS."""
    index = {name: position for position, name in enumerate(EVENTS)}
    columns = [events[..., [index[name] for name in names]].sum(-1) for names in HSP_EVENTS.values()]
    return np.stack(columns, -1)
