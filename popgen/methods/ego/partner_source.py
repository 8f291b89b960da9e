"""Where partners come from: what an ego's record says of those it was trained with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PartnerSource:
    """A population whose members an ego is trained with.

    Attributes:
        method: that generated it.
        seed: of the run that generated it.
        config_digest: of that run's configuration.
        members: those that play, from 1.
        policy_sha256: of the weights that they act with, in this order.
        identity: sha256 of all that decides how they act, in this order.
        population_sha256: of the weights of all members of the population.
        people: whom they are clones of; empty for all others.
        trained_with: what they were trained with, as their own records list it; None where these do not.
    """

    method: str
    seed: int
    config_digest: str
    members: tuple[int, ...]
    policy_sha256: tuple[str, ...]
    identity: tuple[str, ...] = ()
    population_sha256: tuple[str, ...] = ()
    people: tuple[Mapping[str, Any], ...] = ()
    trained_with: tuple[Mapping[str, Any], ...] | None = None

    def as_dict(self) -> dict[str, Any]:
        """As `member.json` of an ego lists it under `trained_with`; hold-out evaluation reads it
        (`popgen.evaluation.holdout_lineages`)."""
        return {
            "method": self.method,
            "seed": self.seed,
            "config_digest": self.config_digest,
            "members": list(self.members),
            "policy_sha256": list(self.policy_sha256),
            "identity": list(self.identity),
            "population_sha256": list(self.population_sha256),
            **({"people": list(self.people)} if self.people else {}),
            **({} if self.trained_with is None else {"trained_with": list(self.trained_with)}),
        }


def name_partners(sources: Sequence[PartnerSource]) -> list[str]:
    """A short name for each partner, in the order of the sources and their members; all are different."""
    names: list[str] = []
    for number, source in enumerate(sources, 1):
        own = [f"{source.method}_{source.seed}/{member}" for member in source.members]
        names += [f"{number}.{name}" for name in own] if set(own) & set(names) else own
    return names
