"""What the processes of a run ask Ray for, and whether there is room for them. Without Ray: it is checked before."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.methods.method import ActorDemand
from popgen.methods.registry import METHODS

ROUNDING = 1e-9

MOST_ON_A_CORE = 4
"""Processes of one kind that a core of this machine may be shared by."""


def count_cores() -> int:
    """Cores that this process may use: those of a batch job, not of its node."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def demands(config: RunConfig) -> list[ActorDemand]:
    """What the actors of the run's method ask Ray for."""
    return METHODS[config.method].actors(config)


def total(wanted: Sequence[ActorDemand]) -> dict[str, float]:
    """What all of them ask for together."""
    amounts: Counter[str] = Counter()
    for demand in wanted:
        amounts.update({name: demand.count * amount for name, amount in demand.amounts.items()})
    return dict(amounts)


def check_room(wanted: Sequence[ActorDemand], nodes: Sequence[Mapping[str, float]]) -> None:
    """The actors must find room on the nodes, whose resources are given by name, or they wait for ever.

    Raises:
        UserError: all nodes have less than all actors ask for, or those of a kind do not fit on them.
    """
    have = {name: sum(node.get(name, 0.0) for node in nodes) for name in total(wanted)}
    missing = [
        f"{amount:g} {name}, the cluster has {have[name]:g}"
        for name, amount in total(wanted).items()
        if amount > have[name] + ROUNDING
    ]
    if missing:
        fix = "ask for less, or wait until its nodes are up"
        gpus = "cluster=cpu_nodes asks for no GPU; " if not have.get("GPU", 1.0) else ""
        raise UserError("cluster", f"the actors ask for {'; for '.join(missing)}", gpus + fix)
    for demand in wanted:
        if (room := places(demand.amounts, nodes, demand.count)) < demand.count:
            each = " and ".join(f"{amount:g} {name}" for name, amount in demand.amounts.items())
            problem = f"{demand.count} of {each} each, the nodes have room for {room}"
            raise UserError(demand.field, problem, "ask for less, or wait until its nodes are up")


def places(amounts: Mapping[str, float], nodes: Sequence[Mapping[str, float]], most: int) -> int:
    """How many actors, `most` at most, that take `amounts` each find room on nodes of these resources."""
    if not amounts:
        return most
    room = (min(math.floor(node.get(n, 0.0) / amount + ROUNDING) for n, amount in amounts.items()) for node in nodes)
    return min(most, sum(room))
