"""PATH, or PATH:1,3: a population, or some of its members only."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from popgen.errors import UserError
from popgen.population.store import Population, load_population


@dataclass(frozen=True)
class ChosenMembers:
    """Members of a population.

    Attributes:
        population: all of it, loaded and checked.
        members: numbers from 1, each once, in the order in which they were named.
        named: they were; without it they are all that there are.
    """

    population: Population
    members: tuple[int, ...]
    named: bool = False

    @staticmethod
    def of_all(population: Population) -> ChosenMembers:
        """Every member."""
        return ChosenMembers(population, tuple(range(1, len(population) + 1)))


def split_members(text: str) -> tuple[str, tuple[int, ...]]:
    """The path and the numbers behind its last colon, none where it has none; a path that exists is taken as it is."""
    path, _, numbers = text.rpartition(":")
    named = path and re.fullmatch(r"[0-9,]*[0-9][0-9,]*", numbers)
    if not named or Path(text).expanduser().exists():
        return text, ()
    return path, tuple(int(number) for number in numbers.split(",") if number)


def load_members(text: str, field: str = "") -> ChosenMembers:
    """Load the population that PATH or PATH:1,3 names.

    Args:
        text: as above.
        field: that is told where a member cannot be chosen; `text` without it.

    Raises:
        UserError: no population, no such member, or one that is named twice.
    """
    path, members = split_members(text)
    population = load_population(path)
    if wrong := [member for member in members if not 1 <= member <= len(population)]:
        which = f"{path} has" if field else "has"
        raise UserError(field or text, f"{which} no member {wrong[0]}", f"{path} has {len(population)}")
    if len(set(members)) < len(members):
        which = f"{text} names" if field else "names"
        raise UserError(field or text, f"{which} a member twice", "name each once")
    return ChosenMembers(population, members, named=True) if members else ChosenMembers.of_all(population)


def join_members(path: str, members: tuple[int, ...]) -> str:
    """The text that `load_members` reads."""
    return f"{path}:{','.join(map(str, members))}"
