"""The compiled core: one step of a batch of kitchens, and their observations.

A state is one row of bytes: cells of players 1 and 2, their orientations, what they hold, the time step (low byte
first), two bytes per pot (contents, cooking) and one byte per counter that a player can reach. Cells are y * W + x;
orientations and moves are 0 north, 1 south, 2 east, 3 west; action 4 stays and 5 interacts. Objects: 0 nothing,
1 onion, 2 tomato, 3 dish, then the soups in the order of rules.SOUPS. Cooking: 0 not cooking, 1 ready, 1 + r cooking
with r steps to go. Tables are described in tables.py. All kernels are in this one file because numba's cache looks
only at the file of the compiled function.
"""

from __future__ import annotations

from popgen.envs.overcooked.compiled_kernel import compile_helper, compile_kernel

# bytes of the state row
ORIENT, HELD, TIME, POTS = 2, 4, 6, 8
# rows of the table
NEXT, FACE, KIND, SLOT, ADD_ONION, ADD_TOMATO, COOK, FULL = 0, 4, 8, 9, 10, 11, 12, 13
FLOOR, XFIRST, ITEM_BIT, POT_BIT, SOUP_ONIONS, SOUP_TOMATOES, POT_CELL, COUNTER_CELL, DELIVERY, NUM_ROWS = (
    14, 15, 16, 19, 22, 23, 24, 25, 26, 27,
)  # fmt: skip
# entries of meta
M_POTS, M_COUNTERS, M_HORIZON, M_AUTO, M_RAW, M_FLOOR, M_ITEM, M_POT, M_COOK, M_FEATURES, M_CELLS, NUM_META = range(12)
# kinds of cells
WALL, COUNTER, ONIONS, TOMATOES, DISHES, POT, SERVE = range(7)
# events; where soups are worth different sums, each worth has a delivery event of its own from DELIVERS_SOUP on
TAKES_INGREDIENT, TAKES_DISH, POTS_INGREDIENT, TAKES_SOUP, DELIVERS_SOUP = range(5)
UNPAID_DELIVERY, NO_EVENT = 254, 255
# actions and objects
STAY, INTERACT, NUM_ACTIONS = 4, 5, 6
ONION, TOMATO, DISH, FIRST_SOUP = 1, 2, 3, 4
# lossless channels, in overcooked_ai's order: players, orientations, terrain, contents, urgency
CHANNELS, C_TERRAIN, C_IN_POT, C_IN_SOUP, C_COOK, C_DONE, C_DISH, C_ONION, C_TOMATO, C_URGENCY = (
    26, 10, 16, 18, 20, 21, 22, 23, 24, 25,
)  # fmt: skip
URGENT_BELOW = 40


@compile_helper
def _counter_pickup_event(item, table):
    """overcooked_ai's own log counts pick-ups from counters too."""
    if item == DISH:
        return TAKES_DISH
    return _soup_pickup_event(item, table) if item >= FIRST_SOUP else TAKES_INGREDIENT


@compile_helper
def _soup_pickup_event(soup, table):
    """A soup that the game does not pay for is no event: what it is worth is what training pays."""
    return TAKES_SOUP if table[DELIVERY, soup] >= 0 else NO_EVENT


@compile_helper
def _use_pot(states, held, slot, table, auto):
    """Interact with the pot whose contents stand at `slot`; returns the event or NO_EVENT."""
    item, contents, cooking = states[held], states[slot], states[slot + 1]
    if item == 0:
        if not auto and contents != 0 and cooking == 0:
            states[slot + 1] = 1 + table[COOK, contents]
    elif item == DISH:
        if cooking == 1:
            states[held] = contents
            states[slot] = 0
            states[slot + 1] = 0
            return _soup_pickup_event(contents, table)
    elif item < DISH and cooking == 0:
        mixed = table[ADD_ONION if item == ONION else ADD_TOMATO, contents]
        if mixed > 0:
            states[slot] = mixed
            states[held] = 0
            return POTS_INGREDIENT
    return NO_EVENT


@compile_helper
def _resolve_interact(states, s, p, table, auto, raw):
    """Resolve player p's interact in the state at states[s:]; returns the event it causes, or NO_EVENT."""
    cell = table[FACE + (states[s + ORIENT + p] & 3), states[s + p]]
    kind, slot, held = table[KIND, cell], s + table[SLOT, cell], s + HELD + p
    item = states[held]
    if kind == POT:
        return _use_pot(states, held, slot, table, auto)
    if kind == COUNTER:
        there = states[slot]
        if (item == 0) != (there == 0):
            states[held] = there
            states[slot] = item
            if raw and there != 0:
                return _counter_pickup_event(there, table)
    elif kind == SERVE:
        if item >= FIRST_SOUP:
            states[held] = 0
            return table[DELIVERY, item] if table[DELIVERY, item] >= 0 else UNPAID_DELIVERY
    elif item == 0 and kind == DISHES:
        states[held] = DISH
        return TAKES_DISH
    elif item == 0 and kind != WALL:
        states[held] = ONION if kind == ONIONS else TOMATO
        # overcooked_ai 1.1.0 does not log tomatoes taken at a dispenser
        return NO_EVENT if raw and kind == TOMATOES else TAKES_INGREDIENT
    return NO_EVENT


@compile_helper
def _move_players(states, s, first, second, table):
    """Turn and move both players; if they would meet or cross, both stay where they are."""
    old0, old1 = states[s], states[s + 1]
    new0, new1 = old0, old1
    if first < STAY:
        states[s + ORIENT] = first
        new0 = table[NEXT + first, old0]
    if second < STAY:
        states[s + ORIENT + 1] = second
        new1 = table[NEXT + second, old1]
    if new0 != new1 and not (new0 == old1 and new1 == old0):
        states[s] = new0
        states[s + 1] = new1


@compile_helper
def _advance_pots(states, s, pots, table, auto):
    """Full pots begin by themselves under automatic cooking; cooking pots advance by one."""
    for slot in range(s + POTS, s + POTS + 2 * pots, 2):
        cooking = states[slot + 1]
        if auto and cooking == 0 and table[FULL, states[slot]] == 1:
            cooking = 1 + table[COOK, states[slot]]
            states[slot + 1] = cooking
        if cooking > 1:
            states[slot + 1] = cooking - 1


@compile_kernel
def step(states, size, actions, table, values, meta, reward, score, events, truncated):
    """Step N kitchens in place.

    Args:
        states: (N * S,) uint8, changed.  size: S.
        actions: (N, 2) uint8 below NUM_ACTIONS.
        table, values, meta: see tables.Tables.
        reward, score: (N,) float32.  events: (N, 2, E) uint8, zeros.  truncated: (N,) bool.  All written.
    """
    auto, raw, pots, horizon = meta[M_AUTO] == 1, meta[M_RAW] == 1, meta[M_POTS], meta[M_HORIZON]
    for n in range(actions.shape[0]):
        s = n * size
        total, paid = values[0], 0
        for p in range(2):
            if actions[n, p] == INTERACT:
                item = states[s + HELD + p]
                event = _resolve_interact(states, s, p, table, auto, raw)
                if event < UNPAID_DELIVERY:
                    events[n, p, event] = 1
                if DELIVERS_SOUP <= event < NO_EVENT:
                    total += values[item]
                    paid += 1 if values[item] > 0 else 0
        _move_players(states, s, actions[n, 0], actions[n, 1], table)
        _advance_pots(states, s, pots, table, auto)
        time = min(states[s + TIME] + 256 * states[s + TIME + 1] + 1, 65535)
        states[s + TIME] = time & 255
        states[s + TIME + 1] = time >> 8
        reward[n] = total
        score[n] = paid
        truncated[n] = time >= horizon


@compile_helper
def _set_item(out, at, other, item, table, bit_row):
    """Set the bits of an object at out[at:] and out[other:]; objects that cannot exist here have none."""
    for row in range(bit_row, bit_row + 3):
        bit = table[row, item]
        if bit >= 0:
            out[at + bit] = 1
            out[other + bit] = 1


@compile_helper
def _player_features(states, s, table, meta, out, at, other):
    """Players' part of both views, player 1's at out[at:] and player 2's at out[other:]; own entries first."""
    floor, items = meta[M_FLOOR], meta[M_ITEM]
    for player in range(2):
        mine, theirs = (at, other) if player == 0 else (other, at)
        cell = table[FLOOR, states[s + player]]
        if cell >= 0:
            out[mine + cell] = 1
            out[theirs + floor + cell] = 1
        side = 2 * floor + (states[s + ORIENT + player] & 3)
        out[mine + side] = 1
        out[theirs + side + 4] = 1
        held = 2 * floor + 8
        if states[s + HELD + player] != 0:
            _set_item(out, mine + held, theirs + held + items, states[s + HELD + player], table, ITEM_BIT)


@compile_helper
def _world_features(states, s, table, meta, out, at, other):
    """The part that is the same in both views, at out[at:] and out[other:]."""
    pots, cook, pot_bits, items = meta[M_POTS], meta[M_COOK], meta[M_POT], meta[M_ITEM]
    slot, start = s + POTS, 0
    for _ in range(pots):
        contents, cooking = states[slot], states[slot + 1]
        if contents != 0:
            _set_item(out, at + start, other + start, contents, table, POT_BIT)
            if 0 < cooking <= cook:
                out[at + start + pot_bits + cooking - 1] = 1
                out[other + start + pot_bits + cooking - 1] = 1
        start += pot_bits + cook
        slot += 2
    for _ in range(meta[M_COUNTERS]):
        if states[slot] != 0:
            _set_item(out, at + start, other + start, states[slot], table, ITEM_BIT)
        start += items
        slot += 1
    if meta[M_HORIZON] - (states[s + TIME] + 256 * states[s + TIME + 1]) < URGENT_BELOW:
        out[at + start] = 1
        out[other + start] = 1


@compile_kernel
def encode_features(states, size, table, meta, out):
    """`features` of both players, all of `out` written.

    Args:
        states: (N * S,) uint8.  size: S.  table, meta: see tables.Tables.
        out: (N * 2 * F,) uint8.
    """
    length = meta[M_FEATURES]
    shared = 2 * meta[M_FLOOR] + 8 + 2 * meta[M_ITEM]
    for i in range(out.shape[0]):
        out[i] = 0
    at = 0
    for s in range(0, states.shape[0], size):
        _player_features(states, s, table, meta, out, at, at + length)
        _world_features(states, s, table, meta, out, at + shared, at + length + shared)
        at += 2 * length


@compile_helper
def _set_both(out, at, other, value):
    out[at] = value
    out[other] = value


@compile_helper
def _lossless_soup(out, at, other, contents, cooking, table, idle):
    """A soup in a pot (idle or not), in a hand or on a counter, in both views."""
    first = C_IN_POT if idle else C_IN_SOUP
    _set_both(out, at + first, other + first, table[SOUP_ONIONS, contents])
    _set_both(out, at + first + 1, other + first + 1, table[SOUP_TOMATOES, contents])
    if not idle:
        _set_both(out, at + C_COOK, other + C_COOK, cooking - 1)
        if cooking == 1:
            _set_both(out, at + C_DONE, other + C_DONE, 1)


@compile_helper
def _lossless_item(out, at, other, item, table):
    if item >= FIRST_SOUP:
        _lossless_soup(out, at, other, item, 1, table, False)
    elif item != 0:
        channel = C_DISH if item == DISH else C_ONION if item == ONION else C_TOMATO
        _set_both(out, at + channel, other + channel, 1)


@compile_helper
def _lossless_players(states, s, table, out, at, other):
    for player in range(2):
        here = table[XFIRST, states[s + player]] * CHANNELS
        mine, theirs = (at + here, other + here) if player == 0 else (other + here, at + here)
        out[mine] = 1
        out[theirs + 1] = 1
        side = 2 + (states[s + ORIENT + player] & 3)
        out[mine + side] = 1
        out[theirs + side + 4] = 1
        _lossless_item(out, mine, theirs, states[s + HELD + player], table)


@compile_helper
def _lossless_world(states, s, table, meta, walls, out, at, other):
    for i in range(walls.shape[0]):
        _set_both(out, at + walls[i], other + walls[i], 1)
    if meta[M_HORIZON] - (states[s + TIME] + 256 * states[s + TIME + 1]) < URGENT_BELOW:
        for cell in range(0, meta[M_CELLS] * CHANNELS, CHANNELS):
            _set_both(out, at + cell + C_URGENCY, other + cell + C_URGENCY, 1)
    slot = s + POTS
    for i in range(meta[M_POTS]):
        contents, cooking = states[slot], states[slot + 1]
        if contents != 0:
            here = table[POT_CELL, i] * CHANNELS
            _lossless_soup(out, at + here, other + here, contents, cooking, table, cooking == 0)
        slot += 2
    for i in range(meta[M_COUNTERS]):
        if states[slot + i] != 0:
            here = table[COUNTER_CELL, i] * CHANNELS
            _lossless_item(out, at + here, other + here, states[slot + i], table)


@compile_kernel
def encode_lossless(states, size, table, meta, walls, out):
    """overcooked_ai's lossless encoding for both players, all of `out` written.

    Args:
        states: (N * S,) uint8.  size: S.  table, meta, walls: see tables.Tables.
        out: (N * 2 * W * H * CHANNELS,) uint8.
    """
    length = meta[M_CELLS] * CHANNELS
    for i in range(out.shape[0]):
        out[i] = 0
    at = 0
    for s in range(0, states.shape[0], size):
        _lossless_players(states, s, table, out, at, at + length)
        _lossless_world(states, s, table, meta, walls, out, at, at + length)
        at += 2 * length


@compile_helper
def _first_set(features, start, count):
    for i in range(count):
        if features[start + i] != 0:
            return i
    return -1


@compile_helper
def _read_bits(features, start, count):
    value = 0
    for i in range(count):
        if features[start + i] != 0:
            value += 1 << i
    return value


@compile_helper
def _decode_world(features, start, meta, codes, row):
    pots, pot_bits, cook, items = meta[M_POTS], meta[M_POT], meta[M_COOK], meta[M_ITEM]
    for i in range(pots):
        row[POTS + 2 * i] = codes[1, _read_bits(features, start, pot_bits)]
        row[POTS + 2 * i + 1] = _first_set(features, start + pot_bits, cook) + 1
        start += pot_bits + cook
    slot = POTS + 2 * pots
    for i in range(meta[M_COUNTERS]):
        row[slot + i] = codes[0, _read_bits(features, start, items)]
        start += items
    time = max(0, meta[M_HORIZON] - URGENT_BELOW + 1) if features[start] != 0 else 0
    row[TIME] = time & 255
    row[TIME + 1] = time >> 8


@compile_kernel
def decode_features(features, meta, codes, out):
    """One player's `features` (N, F) -> states (N, S) uint8 in which that player is the first.

    The time step is not in the features: it is set to 0, or to the first urgent one.
    """
    floor, items = meta[M_FLOOR], meta[M_ITEM]
    for n in range(features.shape[0]):
        view, row = features[n], out[n]
        for i in range(2):
            row[i] = codes[2, max(0, _first_set(view, i * floor, floor))]
            row[ORIENT + i] = max(0, _first_set(view, 2 * floor + 4 * i, 4))
            row[HELD + i] = codes[0, _read_bits(view, 2 * floor + 8 + i * items, items)]
        _decode_world(view, 2 * floor + 8 + 2 * items, meta, codes, row)
