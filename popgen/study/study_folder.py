"""Make a study's folder: `popgen study init`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from popgen.durable_files import replace_file
from popgen.errors import UserError
from popgen.population import load_population
from popgen.population.store import Population
from popgen.study.study_definition import (
    CONSENT,
    DEFINITION,
    Study,
    StudyDefinition,
    check_kitchen,
    find_program,
    gather_egos,
    make_ego,
    read_study,
)
from popgen.study.study_texts import CONSENT_TEXT, list_check, list_demographics, list_items


@dataclass(frozen=True)
class NamedMember:
    """`NAME=POPULATION[:MEMBER]` of the command line.

    Attributes:
        name: of the ego; not shown to participants.
        population: folder.
        member: its number.
    """

    name: str
    population: str
    member: int = 1


def make_study(
    folder: Path, egos: Sequence[NamedMember], tutorial: NamedMember, settings: Mapping[str, Any] | None = None
) -> Study:
    """Write a new study.

    Args:
        folder: of the study; must not hold one.
        egos: for each ego one member in each layout.
        tutorial: partner of the tutorials.
        settings: further fields of `StudyDefinition`.

    Raises:
        UserError: a population is not there, egos do not fit together or cannot play where games are to run, or the
            folder cannot be written.
    """
    if (folder / DEFINITION).exists():
        raise UserError(str(folder), "holds a study already", "choose another folder")
    opened = {one.population: load_population(one.population) for one in (*egos, tutorial)}
    cooking = find_cooking(list(opened.values()))
    places = {population.path: name_path(population.path, folder) for population in opened.values()}
    named = [(one.name, opened[one.population], one.member) for one in egos]
    gathered = gather_egos(named, places)
    teacher = opened[tutorial.population]
    values: dict[str, Any] = {
        "layouts": tuple(dict.fromkeys(layout for members in gathered.values() for layout in members)),
        "egos": gathered,
        "tutorial": make_ego(teacher, tutorial.member, places[teacher.path]),
        "check": list_check(cooking),
        "items": list_items(),
        "demographics": list_demographics(),
    }
    try:
        definition = StudyDefinition(**values, **(settings or {}))
    except ValidationError as error:
        raise UserError("study", error.errors()[0]["msg"].removeprefix("Value error, "), "see docs/study.md") from None
    if definition.host == "browser":
        for one in (*egos, tutorial):
            find_program(opened[one.population], one.member)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / CONSENT, CONSENT_TEXT.encode())
        replace_file(folder / DEFINITION, definition.model_dump_json(indent=2).encode())
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from None
    return read_study(folder)


def find_cooking(populations: Sequence[Population]) -> str:
    """The cooking mode of all of them.

    Raises:
        UserError: they differ, so that no instructions could fit.
    """
    modes = {check_kitchen(population).cooking for population in populations}
    if len(modes) > 1:
        raise UserError("--ego", "some egos cook automatically and some by interact", "take egos of one cooking mode")
    return modes.pop()


def name_path(path: Path, folder: Path) -> str:
    """A population's path relative to the study's folder, so that both can move together."""
    return os.path.relpath(path.resolve(), folder.resolve())
