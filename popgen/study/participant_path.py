"""The way through a study: a list of stations, the same for everybody."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from popgen.study.study_definition import Question, StudyDefinition

Kind = Literal["consent", "instructions", "check", "game", "items", "demographics", "end"]


@dataclass(frozen=True)
class Station:
    """One page of the study.

    Attributes:
        kind: what is to be done.
        number: of the game (tutorials first), or of the pair whose items are asked.
    """

    kind: Kind
    number: int = 0

    @property
    def form(self) -> str:
        """Name of its answers in the records."""
        return f"pair_{self.number}" if self.kind == "items" else self.kind


def list_stations(definition: StudyDefinition) -> list[Station]:
    """All stations in order; the last one is the end."""
    stations = [Station("consent"), Station("instructions")]
    stations += [Station("check")] if definition.check else []
    stations += [Station("game", number) for number in range(definition.tutorials)]
    for pair in range(count_pairs(definition)):
        stations += [Station("game", definition.tutorials + 2 * pair + position) for position in (0, 1)]
        stations += [Station("items", pair)] if definition.items else []
    stations += [Station("demographics")] if definition.demographics else []
    return [*stations, Station("end")]


def count_pairs(definition: StudyDefinition) -> int:
    """Pairs of games of a participant."""
    return definition.pairs * len(definition.layouts)


def list_questions(definition: StudyDefinition, station: Station) -> tuple[Question, ...]:
    """What a station asks; nothing where it asks nothing."""
    asked = {"check": definition.check, "items": definition.items, "demographics": definition.demographics}
    return asked.get(station.kind, ())
