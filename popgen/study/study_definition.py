"""The definition of a study: a folder with `study.json` and `consent.md`, and the egos it names.

Egos are members of populations, each named by folder, number and the digest of its weights, so that a study refuses
to go on with other weights than it began with. Participants never learn an ego's name.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from popgen.durable_files import read_regular
from popgen.envs.overcooked import OvercookedEnv
from popgen.errors import UserError
from popgen.policies.portable_program import Program, write_program
from popgen.population import load_population
from popgen.population.manifest import Record, Sha256
from popgen.population.store import Population
from popgen.study.counterbalance import Design

DEFINITION, CONSENT = "study.json", "consent.md"
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,40}$")]
Key = Annotated[str, Field(pattern=r"^[a-z0-9_]{1,40}$")]
Line = Annotated[str, Field(min_length=1, max_length=500)]


class Ego(Record):
    """One member as a partner.

    Attributes:
        population: folder; relative to the study's.
        member: its number.
        sha256: of its kind, settings and weights.
    """

    population: str
    member: Annotated[int, Field(ge=1)]
    sha256: Sha256


class Question(Record):
    """One thing that is asked.

    Attributes:
        key: name of the column in the records.
        text: as people read it.
        options: to choose among.
        answer: the right one, where there is one (comprehension check).
    """

    key: Key
    text: Line
    options: Annotated[tuple[Line, ...], Field(min_length=2, max_length=20)]
    answer: Line | None = None

    @model_validator(mode="after")
    def _answer_is_an_option(self) -> Self:
        if self.answer is not None and self.answer not in self.options:
            raise ValueError(f"the answer of {self.key} is none of its options")
        return self


class StudyDefinition(Record):
    """study.json.

    Attributes:
        format, format_version: must be this library's.
        title: of the page.
        host: where games run, in the server or in the browser.
        consent_version: of the text in consent.md.
        layouts: names, in the order of the design.
        egos: name (blinded) -> layout -> the member; every ego has one in each layout.
        tutorial: partner of the tutorials, in no comparison.
        tutorials: games of the tutorial.
        pairs: of games in each layout.
        steps: of a game.
        step_milliseconds: length of a step.
        warn_seconds, end_seconds: without a key, until the warning and until the game is void.
        voids: void games after which a participant cannot go on.
        away_minutes: without any sign until a participant's slot is given to the next one.
        places: participants who are let in at most, so that nobody can fill the disk.
        check: comprehension questions.
        items: asked after each pair.
        demographics: asked at the end.
    """

    format: Literal["popgen-study"] = "popgen-study"
    format_version: Literal[1] = 1
    title: Line = "A study on human-AI collaboration"
    host: Literal["server", "browser"] = "server"
    consent_version: Line = "1"
    layouts: Annotated[tuple[Name, ...], Field(min_length=1, max_length=20)]
    egos: dict[Name, dict[Name, Ego]]
    tutorial: Ego
    tutorials: Annotated[int, Field(ge=0, le=20)] = 3
    pairs: Annotated[int, Field(ge=1, le=20)] = 2
    steps: Annotated[int, Field(ge=1, le=10_000)] = 400
    step_milliseconds: Annotated[int, Field(ge=1, le=10_000)] = 150
    warn_seconds: Annotated[float, Field(gt=0)] = 10.0
    end_seconds: Annotated[float, Field(gt=0)] = 15.0
    voids: Annotated[int, Field(ge=1)] = 2
    away_minutes: Annotated[float, Field(gt=0)] = 30.0
    places: Annotated[int, Field(ge=1)] = 1000
    check: tuple[Question, ...]
    items: tuple[Question, ...]
    demographics: tuple[Question, ...]

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if len(self.egos) < 2:
            raise ValueError("two egos at least are needed for pairs")
        for name, members in self.egos.items():
            if set(members) != set(self.layouts):
                raise ValueError(f"ego {name} must have one member in each of {', '.join(self.layouts)}")
        if len(set(self.layouts)) < len(self.layouts):
            raise ValueError("a layout is listed twice")
        if self.tutorial.sha256 in {ego.sha256 for members in self.egos.values() for ego in members.values()}:
            raise ValueError("the tutorial's ego is in the comparison too")
        for questions in (self.check, self.items, self.demographics):
            if len({question.key for question in questions}) < len(questions):
                raise ValueError("two questions of one form have the same key")
        return self

    @property
    def design(self) -> Design:
        """What is to be balanced."""
        return Design(self.layouts, tuple(sorted(self.egos)), self.pairs)


@dataclass(frozen=True)
class Study:
    """A study's folder, read and checked.

    Attributes:
        folder: of the study.
        definition: study.json.
        digest: sha256 of study.json and consent.md.
        consent: the text.
    """

    folder: Path
    definition: StudyDefinition
    digest: str
    consent: str

    @property
    def database(self) -> Path:
        """Where the records are."""
        return self.folder / "records.sqlite"

    def open_population(self, ego: Ego) -> Population:
        """The population of an ego.

        Raises:
            UserError: it is not there, or the member is another one.
        """
        path = self.folder / ego.population
        population = load_population(path)
        if ego.member > len(population) or digest_policy(population, ego.member) != ego.sha256:
            problem = f"member {ego.member} is not the one that the study was made with"
            raise UserError(str(path), problem, "restore the population, or make another study")
        check_kitchen(population)
        return population


def digest_policy(population: Population, member: int) -> str:
    """sha256 of all that decides how a member acts: kind, settings and the digest of its weights."""
    info = population.info(member)
    return hashlib.sha256(json.dumps([info.kind, info.config, info.policy_sha256], sort_keys=True).encode()).hexdigest()


def check_kitchen(population: Population) -> OvercookedEnv:
    """The population's environment.

    Raises:
        UserError: it is not Overcooked, which is what the records' columns describe.
    """
    env = population.make_env()
    if not isinstance(env, OvercookedEnv):
        raise UserError("population", f"{population.path} plays {env.spec.name}, not Overcooked", "give another one")
    return env


def find_program(population: Population, member: int) -> Program:
    """A member's program for the browser.

    Raises:
        UserError: it has none.
    """
    try:
        return write_program(population[member])
    except ValueError as error:
        problem = f"is browser, but member {member} of {population.path} cannot play there: {error}"
        raise UserError("host", problem, "set it to server, or take another member") from None


def read_study(folder: str | Path) -> Study:
    """Read a study's folder; nothing in it is executed.

    Raises:
        UserError: it is none, or something in it does not fit together.
    """
    folder = Path(folder)
    try:
        told, consent = (read_regular(folder / name) for name in (DEFINITION, CONSENT))
        text = consent.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        problem = f"is no study: {getattr(error, 'strerror', None) or 'consent.md is no text'}"
        raise UserError(str(folder), problem, "make one with popgen study init") from None
    try:
        definition = StudyDefinition.model_validate_json(told)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "study"
        raise UserError(f"{folder / DEFINITION}: {place}", first["msg"], "correct it") from None
    digest = hashlib.sha256(told + b"\0" + consent).hexdigest()
    return Study(folder, definition, digest, text)


def find_layout(population: Population) -> str:
    """The layout's name, without the family and without folders."""
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", population.env_info.name.rpartition("/")[2]).removesuffix(".layout")
    return name[:40] or "layout"


def gather_egos(
    named: Sequence[tuple[str, Population, int]], relative: Mapping[Path, str]
) -> dict[str, dict[str, Ego]]:
    """Name -> layout -> ego.

    Args:
        named: (name, population, member).
        relative: a population's path -> how the study names it.

    Raises:
        UserError: two members for one ego and layout.
    """
    egos: dict[str, dict[str, Ego]] = {}
    for name, population, member in named:
        layout = find_layout(population)
        if layout in egos.setdefault(name, {}):
            raise UserError("--ego", f"{name} has two members for {layout}", "leave one of them out")
        egos[name][layout] = make_ego(population, member, relative[population.path])
    return egos


def make_ego(population: Population, member: int, place: str) -> Ego:
    """A member as an ego.

    Raises:
        UserError: there is no such member.
    """
    if not 1 <= member <= len(population):
        raise UserError("--ego", f"{population.path} has no member {member}", f"it has {len(population)}")
    return Ego(population=place, member=member, sha256=digest_policy(population, member))
