"""Where players come from: what tells that two of them may have learned the same.

What an ego was trained with stands in the record of its members (`extra` of `member.json`) under `trained_with`: a list
of objects, one for each population, with the keys

    method, seed, config_digest    of the population's run
    members, policy_sha256         numbers of those that played, and digests of their weights
    population_sha256              digests of the weights of all members of the population
    identity                       of those that played, see `identify_member`
    people                         of clones: a list of objects layout, half, games (numbers of recorded games)
    trained_with                   of partners that are egos themselves: the same of what those were trained with

Records of earlier versions lack the last four: less is known of such an ego then, and it is loaded all the same.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popgen.errors import UserError
from popgen.methods.registry import METHODS
from popgen.population.files import digest, to_tensors
from popgen.population.manifest import MemberInfo
from popgen.population.store import Population

TRAINED_WITH = "trained_with"
"""Key of a record, and of an entry in it, under which training partners stand."""

NO_WEIGHTS = digest(to_tensors(Path("policy.safetensors"), {}))
"""Digest of the weights of a policy that has none; two of these have learned nothing from each other."""


@dataclass(frozen=True)
class People:
    """Recorded people whom a clone was fitted to: numbers of their games in one half of a layout's recordings."""

    layout: str
    half: str
    games: frozenset[int]

    def __str__(self) -> str:
        return f"half {self.half} of {self.layout}"

    def overlap(self, other: People) -> bool:
        """Whether both hold a game of the same two people."""
        return (self.layout, self.half) == (other.layout, other.half) and bool(self.games & other.games)

    def as_dict(self) -> dict[str, Any]:
        """As it stands in a record."""
        return {"layout": self.layout, "half": self.half, "games": sorted(self.games)}


@dataclass(frozen=True)
class Lineage:
    """Where a population comes from: two of one lineage may share what they learned.

    Attributes:
        method, seed: of its run.
        config_digest: of its run; tells apart what no method of the registry made.
        digests: of the weights of the members that are concerned.
        population: of the weights of all its members, where these are known.
        people: whom its members are clones of.
    """

    method: str
    seed: int
    config_digest: str
    digests: frozenset[str] = frozenset()
    population: frozenset[str] = frozenset()
    people: frozenset[People] = frozenset()

    def __str__(self) -> str:
        return f"seed {self.seed} of {self.method}"

    @property
    def known(self) -> frozenset[str]:
        """Digests of all members that it names."""
        return self.digests | self.population

    def is_related(self, other: Lineage) -> bool:
        """Whether both learned from the same: clones the games of the same people, whatever their seeds and settings;
        others from one seed, if their methods share a learner (`Method.family`) and so start from the same weights.

        Of clones whose record does not name the games, and of methods that nobody here knows, the digest of the run's
        configuration must do: that of clones is of their games and settings.
        """
        if self.people and other.people:
            return any(mine.overlap(theirs) for mine in self.people for theirs in other.people)
        same = (self.method, self.config_digest) == (other.method, other.config_digest)
        if self.people or other.people:
            return same
        if self.seed != other.seed:
            return False
        if self.method in METHODS and other.method in METHODS:
            return METHODS[self.method].family == METHODS[other.method].family
        return same


def describe_lineage(population: Population) -> Lineage:
    """Of a population with all its members."""
    manifest = population.manifest
    digests = frozenset(info.policy_sha256 for info in population.members) - {NO_WEIGHTS}
    found = (read_people(str(population.path), info.extra) for info in population.members)
    people = frozenset(one for one in found if one is not None)
    return Lineage(manifest.method, manifest.seed, manifest.config_digest, digests, digests, people)


def identify_member(info: MemberInfo, fingerprint: str) -> str:
    """sha256 of all that decides how a member acts: kind, configuration and weights of its policy, and the rules of the
    environment (`fingerprint`) that it acts in. Clones of people with one network may differ in the configuration."""
    parts = [info.kind, info.config, info.policy_sha256, fingerprint]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read_people(place: str, extra: Mapping[str, Any]) -> People | None:
    """Whom a clone was fitted to, by a record that names layout, half and games; None for others.

    Raises:
        UserError: these hold something else.
    """
    if not {"layout", "half", "games"} <= extra.keys():
        return None
    try:
        return People(str(extra["layout"]), str(extra["half"]), frozenset(map(int, extra["games"])))
    except (TypeError, ValueError):
        problem = "what people it is a clone of cannot be read (layout, half, games)"
        raise UserError(place, problem, "restore it from a good copy") from None


def read_partners(place: str, extra: Mapping[str, Any]) -> list[Lineage]:
    """Lineages of the populations that a member was trained with, by its record, and of those that these were.

    Raises:
        UserError: the record holds something else.
    """
    try:
        return list(_iter_partners(place, extra))
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(place, f"{TRAINED_WITH} of a member cannot be read", "restore it from a good copy") from None


def _iter_partners(place: str, extra: Mapping[str, Any]) -> Iterator[Lineage]:
    for one in extra.get(TRAINED_WITH) or []:
        people = (read_people(place, group) for group in one.get("people") or [])
        yield Lineage(
            method=str(one["method"]),
            seed=int(one["seed"]),
            config_digest=str(one["config_digest"]),
            digests=frozenset(map(str, one["policy_sha256"])) - {NO_WEIGHTS},
            population=frozenset(map(str, one.get("population_sha256") or [])) - {NO_WEIGHTS},
            people=frozenset(group for group in people if group is not None),
        )
        yield from _iter_partners(place, one)


def is_on_record(extra: Mapping[str, Any]) -> bool:
    """Whether a record that `read_partners` read says with whom a member was trained, if with nobody, and the same of
    those: partners that are egos must name theirs, clones their people."""
    return TRAINED_WITH in extra and all(
        tells_origin(str(one["method"]), bool(one.get("people")), one) for one in extra[TRAINED_WITH] or []
    )


def tells_origin(method: str, cloned: bool, extra: Mapping[str, Any]) -> bool:
    """Whether it is known whom a member has met: one of a method that makes populations has met these alone, a clone
    its people, and an ego what its record says.

    Args:
        method: of its population.
        cloned: its record names people.
        extra: the record.
    """
    known = METHODS.get(method)
    generated = known is not None and not known.trains_ego
    return generated or cloned or is_on_record(extra)


def merge_records(members: Sequence[MemberInfo]) -> list[Any] | None:
    """What some members of a population were trained with, each entry once; None where the record of one is silent."""
    if not all(TRAINED_WITH in info.extra for info in members):
        return None
    entries = [one for info in members for one in info.extra[TRAINED_WITH] or []]
    return [one for place, one in enumerate(entries) if one not in entries[:place]]
