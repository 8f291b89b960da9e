"""Who plays in a hold-out evaluation: egos, hold-out partners, and the proof that they have nothing in common.

A group is one name: an ego with its seeds, or the partners of one kind. A player is one policy of a group. An ego is an
ordinary population folder; what it was trained beside stands in the record of its members under `trained_with`: a list
of objects, one for each population, with the keys method, seed, config_digest and policy_sha256 (a list) among others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popgen.envs.contract import BatchedEnv
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.evaluation.user_agents import is_agent_name, open_user_agent
from popgen.methods.registry import METHODS
from popgen.play.policy import Policy
from popgen.population import Population, load_population
from popgen.population.files import digest, to_tensors
from popgen.population.manifest import EnvironmentInfo

EGO = "ego"
"""The side of egos; all others are of partners."""

TRAINED_WITH = "trained_with"
"""Key in a member's `extra` under which an ego's training partners stand."""

NO_WEIGHTS = digest(to_tensors(Path("policy.safetensors"), {}))
"""Digest of the weights of a policy that has none; two of these have learned nothing from each other."""


@dataclass(frozen=True)
class Lineage:
    """Where a population comes from: two of one lineage may share what they learned.

    Attributes:
        method, seed: of its run. Two runs of one method and seed start from the same weights.
        config_digest: of its run; tells apart what no method of the registry made, such as clones of people.
        digests: of its members' weights.
    """

    method: str
    seed: int
    config_digest: str
    digests: frozenset[str] = frozenset()

    def is_related(self, other: Lineage) -> bool:
        """Whether both come from one seed of one method."""
        same = (self.method, self.seed) == (other.method, other.seed)
        return same and (self.method in METHODS or self.config_digest == other.config_digest)


@dataclass(frozen=True)
class Player:
    """One policy.

    Attributes:
        group: label of its group.
        source: folder, or `module:Agent`.
        member: number in its population; 1 for a user's agent.
        digest: sha256 of its weights, None for a user's agent.
        make: () -> the policy.
        part: skill or role of a member of which its population has several kinds, "" elsewhere.
        pair: number of the pair that it was trained in (HSP), 0 for a member that was trained with itself.
    """

    group: str
    source: str
    member: int
    digest: str | None
    make: Callable[[], Policy]
    part: str = ""
    pair: int = 0

    @property
    def name(self) -> str:
        """For tables and messages."""
        return f"{self.group} {self.member}"


@dataclass(frozen=True)
class Group:
    """Players of one name.

    Attributes:
        label: the name.
        method: that trained them; None for a user's agent.
        players: in order.
        lineages: of the populations that they come from.
        partners: lineages of the populations that they were trained with; empty where nothing is known of any.
        on_record: the records of all say with whom they were trained, if with nobody.
    """

    label: str
    method: str | None
    players: tuple[Player, ...]
    lineages: tuple[Lineage, ...] = ()
    partners: tuple[Lineage, ...] = ()
    on_record: bool = False

    @property
    def taught_by(self) -> frozenset[str]:
        """Methods of the populations it was trained with; its own method where there were none."""
        found = frozenset(one.method for one in self.partners)
        return found or frozenset([self.method] if self.method else [])


@dataclass(frozen=True)
class Sides:
    """Groups of players by the side that they are on, and the environment of all."""

    sides: Mapping[str, tuple[Group, ...]]
    environment: EnvironmentInfo


def open_sides(wanted: Mapping[str, Sequence[tuple[str | None, str]]], title: Callable[[str], str]) -> Sides:
    """Load the groups of players of all sides.

    Args:
        wanted: side -> (label or None, folder of a population or run, or `module:Agent`); one label twice on a side
            makes one group.
        title: a method's name -> label of populations that were given none.

    Raises:
        UserError: what cannot be loaded, an empty population, one given twice among egos or among partners, none at
            all, two of different environments, or one label on two sides of partners.
    """
    populations: dict[str, Population] = {}
    for source in (source for named in wanted.values() for _, source in named):
        if source not in populations and not is_agent_name(source):
            populations[source] = load_population(source)
    environment: EnvironmentInfo | None = None
    for population in populations.values():
        if not len(population):
            raise UserError(str(population.path), "has no members yet", "train at least one first")
        environment = environment or population.env_info
        _check_environment(population, environment)
    if environment is None:
        raise UserError("populations", "there are none, so that nothing names the environment", "give at least one")
    rules = make_env(environment.name, 1, **environment.params)
    sides = {}
    for side, named in wanted.items():
        found: dict[str, Group] = {}
        for label, source in named:
            if source in populations:
                group = _describe_population(label or title(populations[source].manifest.method), populations[source])
            else:
                group = _describe_agent(label or source.rpartition(":")[2], source, rules)
            found[group.label] = _join_groups(found[group.label], group) if group.label in found else group
        sides[side] = tuple(found.values())
    _check_groups(sides)
    return Sides(sides, environment)


def _check_groups(sides: Mapping[str, Sequence[Group]]) -> None:
    """A population counts once among egos and once among partners, and a label of partners has one side."""
    labels: dict[str, str] = {}
    places: set[tuple[bool, str]] = set()
    for side, groups in sides.items():
        for group in groups:
            if side != EGO and labels.setdefault(group.label, side) != side:
                problem = f"is on two sides, {labels[group.label]} and {side}"
                raise UserError(group.label, problem, "give them different names: NAME=POPULATION")
            for source in dict.fromkeys(player.source for player in group.players):
                place = (side == EGO, source if is_agent_name(source) else str(Path(source).resolve()))
                if place in places:
                    raise UserError(source, "is given twice", "give each once")
                places.add(place)


def _check_environment(population: Population, environment: EnvironmentInfo) -> None:
    own = population.env_info
    if own.fingerprint != environment.fingerprint:
        problem = f"is of {own.name} ({own.fingerprint[:12]}), the others of {environment.name}"
        raise UserError(
            str(population.path),
            f"{problem} ({environment.fingerprint[:12]})",
            "evaluate in one environment: its rules are part of what was learned",
        )


def _describe_population(label: str, population: Population) -> Group:
    manifest = population.manifest
    players = tuple(
        Player(
            *(label, str(population.path), info.id, info.policy_sha256, _open_member(population, info.id)),
            part=str(info.extra.get("skill") or info.extra.get("role") or ""),
            pair=_read_pair(info.extra),
        )
        for info in population.members
    )
    digests = frozenset(info.policy_sha256 for info in population.members) - {NO_WEIGHTS}
    own = Lineage(manifest.method, manifest.seed, manifest.config_digest, digests)
    partners = [one for info in population.members for one in read_partners(str(population.path), info.extra)]
    on_record = all(TRAINED_WITH in info.extra for info in population.members)
    return Group(label, manifest.method, players, (own,), tuple(dict.fromkeys(partners)), on_record)


def _read_pair(extra: Mapping[str, Any]) -> int:
    pair = extra.get("pair", 0)
    return pair if type(pair) is int and "role" in extra else 0


def _open_member(population: Population, member: int) -> Callable[[], Policy]:
    return lambda: population[member]


def read_partners(place: str, extra: Mapping[str, Any]) -> list[Lineage]:
    """Lineages of the populations that a member was trained with, by its record.

    Raises:
        UserError: the record holds something else.
    """
    try:
        return [
            Lineage(
                method=str(one["method"]),
                seed=int(one["seed"]),
                config_digest=str(one["config_digest"]),
                digests=frozenset(map(str, one["policy_sha256"])) - {NO_WEIGHTS},
            )
            for one in extra.get(TRAINED_WITH) or []
        ]
    except (KeyError, TypeError, ValueError, AttributeError):
        raise UserError(place, f"{TRAINED_WITH} of a member cannot be read", "restore it from a good copy") from None


def _describe_agent(label: str, source: str, rules: BatchedEnv) -> Group:
    return Group(label, None, (Player(label, source, 1, None, open_user_agent(source, rules)),))


def _join_groups(first: Group, second: Group) -> Group:
    if first.method != second.method:
        problem = f"names {first.method or 'an agent'} and {second.method or 'an agent'}"
        raise UserError(first.label, problem, "give them different names")
    if shared := {player.source for player in first.players} & {player.source for player in second.players}:
        raise UserError(shared.pop(), "is given twice", "give each once")
    return Group(
        first.label,
        first.method,
        first.players + second.players,
        first.lineages + second.lineages,
        tuple(dict.fromkeys(first.partners + second.partners)),
        first.on_record and second.on_record,
    )


def check_disjoint(egos: Sequence[Group], partners: Sequence[Group]) -> None:
    """Make sure that no ego has met a partner, or learned from what a partner learned from.

    Raises:
        UserError: one line that names both, for a shared member, a training partner, or one seed of one method.
    """
    fix = "hold out populations of other seeds"
    for ego in egos:
        own = frozenset[str]().union(*(one.digests for one in ego.lineages))
        met = frozenset[str]().union(*(one.digests for one in ego.partners))
        for partner in (player for group in partners for player in group.players):
            if partner.digest in own:
                raise UserError(partner.source, f"member {partner.member} is the ego {ego.label} itself", fix)
            if partner.digest in met:
                problem = f"member {partner.member} is a training partner of the ego {ego.label}"
                raise UserError(partner.source, problem, fix)
        for group in partners:
            _check_lineages(ego, group, fix)


def _check_lineages(ego: Group, partner: Group, fix: str) -> None:
    for theirs in partner.lineages:
        for ours in (*ego.lineages, *ego.partners):
            if ours.is_related(theirs):
                what = "trained with" if ours in ego.partners else "itself of"
                problem = f"has seed {theirs.seed} of {theirs.method}, which the ego {ego.label} is {what}"
                raise UserError(partner.label, problem, fix)
