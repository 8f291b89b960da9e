"""A kitchen's rules as plain numbers, for simulators in other languages (`popgen/study/assets/kitchen_rules.js`).

What the kernels read, and the names by which they read it: another simulator that follows kernels.py needs no number
of its own.
"""

from __future__ import annotations

import math
from typing import Any

from popgen.envs.overcooked import kernels as k
from popgen.envs.overcooked.env import OvercookedEnv

NAMES = (
    *("ORIENT", "HELD", "TIME", "POTS"),
    *("NEXT", "FACE", "KIND", "SLOT", "ADD_ONION", "ADD_TOMATO", "COOK", "FULL", "FLOOR", "ITEM_BIT", "POT_BIT"),
    *("DELIVERY", "M_POTS", "M_COUNTERS", "M_HORIZON", "M_AUTO", "M_RAW", "M_FLOOR", "M_ITEM", "M_POT", "M_COOK"),
    *("M_FEATURES", "WALL", "COUNTER", "ONIONS", "TOMATOES", "DISHES", "POT", "SERVE"),
    *("TAKES_INGREDIENT", "TAKES_DISH", "POTS_INGREDIENT", "TAKES_SOUP", "DELIVERS_SOUP", "UNPAID_DELIVERY"),
    *("NO_EVENT", "STAY", "INTERACT", "ONION", "TOMATO", "DISH", "FIRST_SOUP", "URGENT_BELOW"),
)
"""Constants of kernels.py that another simulator needs."""


def export_kitchen(env: OvercookedEnv) -> dict[str, Any]:
    """A JSON-able kitchen.

    Keys: layout, width, height; names (constant -> number); table (27 * 256 numbers, row by row), values (256 rewards,
    an infinite one as `Infinity`), meta, start (the first state); events (how many a player has); actions (names).
    """
    tables, layout = env.tables, env.layout
    values = [float(value) if math.isfinite(value) else "Infinity" for value in tables.values]
    return {
        "layout": env.spec.name,
        "width": layout.width,
        "height": layout.height,
        "names": {name: int(getattr(k, name)) for name in NAMES},
        "table": tables.table.ravel().tolist(),
        "values": values,
        "meta": tables.meta.tolist(),
        "start": env.kitchen.start.tolist(),
        "events": env.spec.num_events,
        "actions": list(env.spec.action_names),
    }
