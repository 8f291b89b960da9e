"""Who plays in a hold-out evaluation: egos, hold-out partners, and best responses to these.

A group is one name: an ego with its seeds, or the partners of one kind. A player is one policy of a group. An ego is an
ordinary population folder; what it was trained with stands in its members' records (`holdout_lineages`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from popgen.envs.contract import BatchedEnv
from popgen.envs.env_registry import make_env
from popgen.errors import UserError
from popgen.evaluation.holdout_lineages import (
    Lineage,
    describe_lineage,
    identify_member,
    read_partners,
    read_people,
    tells_origin,
)
from popgen.evaluation.user_agents import is_agent_name, open_user_agent
from popgen.play.policy import Policy
from popgen.population import Population
from popgen.population.chosen_members import ChosenMembers, load_members
from popgen.population.manifest import EnvironmentInfo, MemberInfo
from popgen.population.member_pairs import match_pairs, read_pair

EGO = "ego"
"""The side of egos; all others are of partners."""


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
        identity: sha256 of all that decides how it acts (`identify_member`), None for a user's agent. Players with one
            identity are the same policy, which counts once.
        mate: the other of its pair, where that was not chosen to play too.
    """

    group: str
    source: str
    member: int
    digest: str | None
    make: Callable[[], Policy]
    part: str = ""
    pair: int = 0
    identity: str | None = None
    mate: Player | None = None

    @property
    def name(self) -> str:
        """For tables and messages."""
        return f"{self.group} {self.member}"


@dataclass(frozen=True)
class Response:
    """A best response that was trained for a partner.

    Attributes:
        player: that plays.
        scale, settings: of its training: the recipe, and dotted field -> value on top of it.
        steps: environment steps of its training.
    """

    player: Player
    scale: str
    settings: Mapping[str, Any]
    steps: int


@dataclass(frozen=True)
class Group:
    """Players of one name.

    Attributes:
        label: the name.
        method: that trained them; None for a user's agent.
        players: in order.
        lineages: of the populations that they come from.
        partners: lineages of the populations that they were trained with, and of those that these were trained with;
            empty where nothing is known of any.
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
        """Methods of the populations in `partners`; its own method where there are none."""
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
        wanted: side -> (label or None, folder of a population or run, with `:1,3` behind it for some members only, or
            `module:Agent`); one label twice on a side makes one group.
        title: a method's name -> label of populations that were given none.

    Raises:
        UserError: what cannot be loaded, an empty population, a member given twice among egos or among partners, none
            at all, two of different environments, or one label on two sides of partners.
    """
    populations: dict[str, ChosenMembers] = {}
    for source in (source for named in wanted.values() for _, source in named):
        if source not in populations and not is_agent_name(source):
            populations[source] = load_members(source)
    environment: EnvironmentInfo | None = None
    for population in (chosen.population for chosen in populations.values()):
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
                chosen = populations[source]
                group = _describe_population(label or title(chosen.population.manifest.method), chosen)
            else:
                group = _describe_agent(label or source.rpartition(":")[2], source, rules)
            found[group.label] = _join_groups(found[group.label], group) if group.label in found else group
        sides[side] = tuple(found.values())
    _check_groups(sides)
    return Sides(sides, environment)


def _check_groups(sides: Mapping[str, Sequence[Group]]) -> None:
    """A member counts once among egos and once among partners, and a label of partners has one side."""
    labels: dict[str, str] = {}
    places: set[tuple[bool, str, int]] = set()
    for side, groups in sides.items():
        for group in groups:
            if side != EGO and labels.setdefault(group.label, side) != side:
                problem = f"is on two sides, {labels[group.label]} and {side}"
                raise UserError(group.label, problem, "give them different names: NAME=POPULATION")
            for player in group.players:
                agent = is_agent_name(player.source)
                source = player.source if agent else str(Path(player.source).resolve())
                if (place := (side == EGO, source, player.member)) in places:
                    which = "" if agent else f"member {player.member} "
                    raise UserError(player.source, f"{which}is given twice", "give each once")
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


def _describe_population(label: str, chosen: ChosenMembers) -> Group:
    """The chosen members; where they come from tells of all."""
    population = chosen.population
    everybody = [_describe_member(label, population, info) for info in population.members]
    mates = find_mates(everybody)
    apart = {n for n in chosen.members if mates[n - 1] + 1 not in chosen.members}
    players = tuple(
        replace(everybody[n - 1], mate=everybody[mates[n - 1]]) if n in apart else everybody[n - 1]
        for n in chosen.members
    )
    partners = [one for info in population.members for one in read_partners(str(population.path), info.extra)]
    method, path = population.manifest.method, str(population.path)
    on_record = all(
        tells_origin(method, read_people(path, info.extra) is not None, info.extra) for info in population.members
    )
    own = (describe_lineage(population),)
    return Group(label, population.manifest.method, players, own, tuple(dict.fromkeys(partners)), on_record)


def _describe_member(label: str, population: Population, info: MemberInfo) -> Player:
    return Player(
        *(label, str(population.path), info.id, info.policy_sha256, lambda: population[info.id]),
        part=str(info.extra.get("skill") or info.extra.get("role") or ""),
        pair=read_pair(info.extra),
        identity=identify_member(info, population.env_info.fingerprint),
    )


def find_mates(players: Sequence[Player]) -> tuple[int, ...]:
    """Place of each player's mate among them, the other of the pair that it was trained in; its own without one."""
    return match_pairs([(one.source, one.pair) if one.pair else None for one in players])


def seat_mates(players: Sequence[Player]) -> tuple[list[Player], list[int]]:
    """The players, after them their mates that were not chosen, and the place of each player's mate as above."""
    everybody, places = list(players), list(find_mates(players))
    for place, player in enumerate(players):
        if places[place] == place and player.mate is not None:
            places[place] = len(everybody)
            everybody.append(player.mate)
    return everybody, places


def list_distinct(players: Sequence[Player]) -> list[int]:
    """Places of the players that are no copy of an earlier one; users' agents are none."""
    known = [one.identity for one in players]
    return [place for place, own in enumerate(known) if own is None or own not in known[:place]]


def _describe_agent(label: str, source: str, rules: BatchedEnv) -> Group:
    return Group(label, None, (Player(label, source, 1, None, open_user_agent(source, rules)),))


def _join_groups(first: Group, second: Group) -> Group:
    if first.method != second.method:
        problem = f"names {first.method or 'an agent'} and {second.method or 'an agent'}"
        raise UserError(first.label, problem, "give them different names")
    return Group(
        first.label,
        first.method,
        first.players + second.players,
        tuple(dict.fromkeys(first.lineages + second.lineages)),
        tuple(dict.fromkeys(first.partners + second.partners)),
        first.on_record and second.on_record,
    )
