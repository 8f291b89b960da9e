"""The paper's figures to stand beside ours ("Efficient Generation of Diverse Cooperative Agents with World Models").

Methods go by the names of `RunConfig.method`, layouts by the registry's. Known slips of the paper are told where the
number stands; nothing here is ever a target of tuning.
"""

from __future__ import annotations

from dataclasses import dataclass

from popgen.types import Kind

METHOD_NAMES = {"xpm_wm": "XPM-WM", "xpm_sim": "XPM-Sim", "lipo": "LIPO", "comedi": "CoMeDi", "mappo": "MAPPO"}
"""Method -> the name it has in the paper and on charts."""


@dataclass(frozen=True)
class Scores:
    """Mean self-play and cross-play score of a population."""

    sp: float
    xp: float


@dataclass(frozen=True)
class Sabotage:
    """A row of the paper's first table.

    Attributes:
        agents: fraction of cross-play episodes with earlier agents that ended early, for agents 1 to 8. Agent 1 has no
            earlier ones; it stands as 0 and counts in the average.
        average: as printed; it is the mean over all eight.
        scores: mean self-play and cross-play return.
    """

    agents: tuple[float, ...]
    average: float
    scores: Scores


SABOTAGE: dict[str, Sabotage] = {
    "lipo": Sabotage((0.0, 1.0, 1.0, 0.33, 0.5, 0.25, 0.98, 0.65), 0.59, Scores(2.12, -130.65)),
    "comedi": Sabotage((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.175, 0.57), 0.09, Scores(30.67, -114.01)),
    "xpm_sim": Sabotage((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.09, 0.0), 0.011, Scores(21.50, -114.50)),
}
"""Table "Results of the MPPMR environment" (section "Empirical Analysis of Self-Sabotage Behavior"), 8 agents."""

CRAMPED, ASYMMETRIC, RING, FORCED, CIRCUIT = (
    "overcooked/cramped_room",
    "overcooked/asymmetric_advantages",
    "overcooked/coordination_ring",
    "overcooked/forced_coordination",
    "overcooked/counter_circuit_o_1order",
)

LAYOUT_NAMES = {
    CRAMPED: "Cramped Room",
    ASYMMETRIC: "Asymmetric Advantages",
    RING: "Coordination Ring",
    FORCED: "Forced Coordination",
    CIRCUIT: "Counter Circuit",
    "rendezvous/mppmr": "MPPMR",
}
"""Registry name -> the name it has in the paper and on charts."""

SCORES: dict[str, dict[str, Scores]] = {
    CRAMPED: {"lipo": Scores(8.99, 2.40), "comedi": Scores(8.29, 1.58), "xpm_wm": Scores(10.23, 0.43)},
    ASYMMETRIC: {"lipo": Scores(9.07, 1.76), "comedi": Scores(11.23, 6.80), "xpm_wm": Scores(18.28, 0.83)},
    RING: {"lipo": Scores(7.77, 0.11), "comedi": Scores(9.45, 2.74), "xpm_wm": Scores(10.81, 0.03)},
    FORCED: {"lipo": Scores(10.50, 1.99), "comedi": Scores(8.84, 1.61), "xpm_wm": Scores(14.23, 0.07)},
    CIRCUIT: {"lipo": Scores(8.47, 0.36), "comedi": Scores(8.94, 1.26), "xpm_wm": Scores(8.25, 0.72)},
    "rendezvous/mppmr": {method: row.scores for method, row in SABOTAGE.items()},
}
"""Layout -> method -> scores of populations of 8: dishes per 400 steps (appendix, "Average SP and XP Results"), the
return in rendezvous."""

XPM_WM_STEPS: dict[str, tuple[int, int]] = {
    CRAMPED: (20_000_000, 2_000_000),
    ASYMMETRIC: (60_000_000, 2_000_000),
    RING: (60_000_000, 3_000_000),
    FORCED: (50_000_000, 4_000_000),
    CIRCUIT: (80_000_000, 4_000_000),
}
"""Layout -> environment steps of member 1 and of each later member (table "Hyperparameters for XPM-WM")."""

BASELINE_STEPS = 6_000_000
"""LIPO's and CoMeDi's "SP, XP and MP training steps (per partner)". The table lists six numbers for five layouts, 6e6
five times and then 8e6; the first five are taken as the five layouts'."""

PER_PREDECESSOR, PER_AGENT = "per predecessor", "per agent"
READINGS = {
    PER_PREDECESSOR: "as the caption says: each agent gets the budget once for self-play, and for cross-play and mixed "
    "play once with every earlier agent",
    PER_AGENT: "each agent gets the budget once for every type of trajectory, however many earlier agents there are",
}
"""The two ways to read "(per partner)"."""

_TYPES = {"lipo": (Kind.SP, Kind.XP), "comedi": (Kind.SP, Kind.XP, Kind.MP)}


def baseline_budget(method: str, members: int, reading: str, budget: int = BASELINE_STEPS) -> dict[str, int]:
    """Environment steps by kind of M agents of LIPO or CoMeDi, under a reading of the paper's budget.

    The first agent has self-play alone. With M agents that makes M budgets of self-play, and of each other type
    M (M - 1) / 2 (`per predecessor`) or M - 1 (`per agent`).

    Raises:
        KeyError: another method or reading.
    """
    others = {PER_PREDECESSOR: members * (members - 1) // 2, PER_AGENT: members - 1}[reading]
    return {str(kind): budget * (members if kind is Kind.SP else others) for kind in _TYPES[method]}


def xpm_wm_budget(layout: str, members: int) -> int | None:
    """Environment steps of M members of XPM-WM in the paper; None for a layout that is not in it."""
    if layout not in XPM_WM_STEPS:
        return None
    first, later = XPM_WM_STEPS[layout]
    return first + (members - 1) * later


def scores(layout: str, method: str) -> Scores | None:
    """The paper's figures for a method on a layout, None where it has none."""
    return SCORES.get(layout, {}).get(method)
