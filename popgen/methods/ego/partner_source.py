"""Where a partner comes from: what an ego's record says of those it was trained with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Partner:
    """One member of a population, as `member.json` of an ego lists it under `trained_with`.

    Attributes:
        name: short, unique among an ego's partners: `xpm_sim_1/3`.
        method: that generated its population.
        population_seed: of the run that generated it.
        config_digest: of that run's configuration.
        member: from 1.
        seed: the member's own.
        policy_sha256: of the weights that it acted with.
        snapshot: of its training, "" for the finished member.
    """

    name: str
    method: str
    population_seed: int
    config_digest: str
    member: int
    seed: int
    policy_sha256: str
    snapshot: str = ""
