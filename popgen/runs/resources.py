"""What the processes of a run ask Ray for, and whether there is room for them. Without Ray: it is checked before."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from popgen.config.run_config import SECTIONS, RunConfig
from popgen.errors import UserError

ROUNDING = 1e-9


@dataclass(frozen=True)
class Demand:
    """`count` actors that take `amounts` of one node's resources each, which the config's `field` says."""

    field: str
    count: int
    amounts: dict[str, float]


def demands(config: RunConfig) -> list[Demand]:
    """What the method's actors ask Ray for. XPM-Sim's learner steps the simulator and stays on processors; the
    baselines' learner is in the driver's process."""
    cluster = config.cluster

    def ask(field: str, count: int, gpus: float = 0.0) -> Demand:
        amounts = {"CPU": getattr(cluster, field), "GPU": gpus, **cluster.resources}
        return Demand(f"cluster.{field}", count, {name: amount for name, amount in amounts.items() if amount})

    if "ppo" in SECTIONS[config.method]:
        return [ask("sampler_cpus", config.ppo.runners)]
    samplers = ask("sampler_cpus", cluster.samplers)
    if config.method == "xpm_sim":
        return [samplers, ask("agent_cpus", 1)]
    model, agent = ask("model_cpus", 1, cluster.model_gpus), ask("agent_cpus", 1, cluster.agent_gpus)
    return [samplers, ask("replay_cpus", 2), model, agent]


def total(wanted: Sequence[Demand]) -> dict[str, float]:
    """What all of them ask for together."""
    amounts: Counter[str] = Counter()
    for demand in wanted:
        amounts.update({name: demand.count * amount for name, amount in demand.amounts.items()})
    return dict(amounts)


def check_room(wanted: Sequence[Demand], nodes: Sequence[Mapping[str, float]]) -> None:
    """The actors must find room on the nodes, whose resources are given by name, or they wait for ever.

    Raises:
        UserError: all nodes have less than all actors ask for, or those of a kind do not fit on them.
    """
    for name, amount in total(wanted).items():
        if amount > (have := sum(node.get(name, 0.0) for node in nodes)) + ROUNDING:
            problem = f"the actors ask for {amount:g} {name}, the cluster has {have:g}"
            raise UserError("cluster", problem, "ask for less, or wait until its nodes are up")
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
