"""The paper's figures to stand beside ours ("Efficient Generation of Diverse Cooperative Agents with World Models").

Methods go by their titles, layouts by the registry's names. Known slips of the paper are told where the number stands;
nothing here is ever a target of tuning.
"""

from __future__ import annotations

from dataclasses import dataclass

from popgen.types import Kind

OWN_METHOD, SIMULATOR_METHOD = "XPM-WM", "XPM-Sim"
"""Titles of the paper's own methods: with a learned world model, and with the exact simulator."""

CRAMPED, ASYMMETRIC, RING, FORCED, CIRCUIT, RENDEZVOUS = (
    "overcooked/cramped_room",
    "overcooked/asymmetric_advantages",
    "overcooked/coordination_ring",
    "overcooked/forced_coordination",
    "overcooked/counter_circuit_o_1order",
    "rendezvous/mppmr",
)

AGENTS = 8
"""Of the paper's populations."""

LAYOUT_NAMES = {
    CRAMPED: "Cramped Room",
    ASYMMETRIC: "Asymmetric Advantages",
    RING: "Coordination Ring",
    FORCED: "Forced Coordination",
    CIRCUIT: "Counter Circuit",
    RENDEZVOUS: "MPPMR",
}
"""Registry name -> the name it has in the paper and on charts."""


@dataclass(frozen=True)
class PaperRow:
    """What the paper reports of a population of 8.

    Attributes:
        environment, method: registry name; title.
        sp, xp: mean self-play and cross-play: dishes per 400 steps, the return in rendezvous.
        ended_early: fraction of cross-play episodes with earlier agents that ended early, for agents 1 to 8. Agent 1
            has no earlier ones; it stands as 0 and counts in the average. Empty outside of rendezvous.
        average: of `ended_early` as printed; it is the mean over all eight.
    """

    environment: str
    method: str
    sp: float
    xp: float
    ended_early: tuple[float, ...] = ()
    average: float | None = None


REPORTED = (
    PaperRow(CRAMPED, "LIPO", 8.99, 2.40),
    PaperRow(CRAMPED, "CoMeDi", 8.29, 1.58),
    PaperRow(CRAMPED, "XPM-WM", 10.23, 0.43),
    PaperRow(ASYMMETRIC, "LIPO", 9.07, 1.76),
    PaperRow(ASYMMETRIC, "CoMeDi", 11.23, 6.80),
    PaperRow(ASYMMETRIC, "XPM-WM", 18.28, 0.83),
    PaperRow(RING, "LIPO", 7.77, 0.11),
    PaperRow(RING, "CoMeDi", 9.45, 2.74),
    PaperRow(RING, "XPM-WM", 10.81, 0.03),
    PaperRow(FORCED, "LIPO", 10.50, 1.99),
    PaperRow(FORCED, "CoMeDi", 8.84, 1.61),
    PaperRow(FORCED, "XPM-WM", 14.23, 0.07),
    PaperRow(CIRCUIT, "LIPO", 8.47, 0.36),
    PaperRow(CIRCUIT, "CoMeDi", 8.94, 1.26),
    PaperRow(CIRCUIT, "XPM-WM", 8.25, 0.72),
    PaperRow(RENDEZVOUS, "LIPO", 2.12, -130.65, (0.0, 1.0, 1.0, 0.33, 0.5, 0.25, 0.98, 0.65), 0.59),
    PaperRow(RENDEZVOUS, "CoMeDi", 30.67, -114.01, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.175, 0.57), 0.09),
    PaperRow(RENDEZVOUS, "XPM-Sim", 21.50, -114.50, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.09, 0.0), 0.011),
)
"""Overcooked: appendix, "Average SP and XP Results". Rendezvous: table "Results of the MPPMR environment" (section
"Empirical Analysis of Self-Sabotage Behavior")."""

SABOTAGE = tuple(row for row in REPORTED if row.ended_early)
"""Rows of the paper's first table."""


def find_row(environment: str, method: str) -> PaperRow | None:
    """What the paper reports of a method (by its title) on a layout, None where it has nothing."""
    return next((row for row in REPORTED if (row.environment, row.method) == (environment, method)), None)


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

BASELINES = {"LIPO": (Kind.SP, Kind.XP), "CoMeDi": (Kind.SP, Kind.XP, Kind.MP)}
"""Title -> types of trajectories that the budget is given for."""


def baseline_budget(method: str, members: int, reading: str, budget: int = BASELINE_STEPS) -> dict[str, int]:
    """Environment steps by kind of M agents of LIPO or CoMeDi (titles), under a reading of the paper's budget.

    The first agent has self-play alone. With M agents that makes M budgets of self-play, and of each other type
    M (M - 1) / 2 (`per predecessor`) or M - 1 (`per agent`).

    Raises:
        KeyError: another method or reading.
    """
    others = {PER_PREDECESSOR: members * (members - 1) // 2, PER_AGENT: members - 1}[reading]
    return {str(kind): budget * (members if kind is Kind.SP else others) for kind in BASELINES[method]}


def xpm_wm_budget(layout: str, members: int) -> int | None:
    """Environment steps of M members of XPM-WM in the paper; None for a layout that is not in it."""
    if layout not in XPM_WM_STEPS:
        return None
    first, later = XPM_WM_STEPS[layout]
    return first + (members - 1) * later
