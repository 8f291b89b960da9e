"""What a table or figure of the paper needs: runs, columns, the paper's own figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

Record = Mapping[str, Any]
"""A finished target's JSON object, see the package's docstring."""


@dataclass(frozen=True)
class StudyBudget:
    """How large a simulated study is.

    Attributes:
        participants: in all; clones of people, or with `random_keys` nobody in particular.
        pairs: of games in each layout.
        tutorials: practice games.
        steps: of a game.
        random_keys: participants press keys at random.
    """

    participants: int
    pairs: int
    tutorials: int = 3
    steps: int = 400
    random_keys: bool = False


@dataclass(frozen=True)
class Budget:
    """How much is spent.

    Attributes:
        name, summary: of it.
        scale: the recipe of every run.
        agents: of populations in Overcooked.
        rendezvous_agents: of populations on rendezvous.
        layouts: that targets with several layouts take.
        ring: the layout of what the paper shows in the coordination ring alone.
        seeds: unless others are asked for.
        episodes: of every evaluation that is made for a target.
        settings: of all runs; one that a method lacks is left out for it.
        rendezvous: the same of runs on rendezvous alone.
        inline: runs that can do without Ray do.
        minutes: that a run takes, until one of its kind has been measured.
        proxy: of the search for a human proxy (`popgen.humans.proxies.ProxySearch`), where it is shorter.
    """

    name: str
    summary: str
    scale: str
    agents: int
    rendezvous_agents: int
    layouts: tuple[str, ...]
    ring: str
    seeds: tuple[int, ...]
    episodes: int
    settings: tuple[str, ...] = ()
    rendezvous: tuple[str, ...] = ()
    minutes: float = 15.0
    inline: bool = False
    study: StudyBudget = StudyBudget(participants=40, pairs=2)
    proxy: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class WantedStudy:
    """A study with simulated people, one for all its egos.

    Attributes:
        egos: runs of egos by their rows, in all layouts.
        size: of the study.
    """

    egos: tuple[WantedRun, ...]
    size: StudyBudget


@dataclass(frozen=True)
class WantedRun:
    """A run that a target wants.

    Attributes:
        row: of the table that it belongs to; runs of one row and environment are its seeds.
        words: overrides as for `popgen run`, seed aside; of an ego those of `popgen ego train`.
        seed: of training.
        measures: names of what is measured of it (`popgen.pipelines.run_measures`).
        teachers: runs whose populations an ego is trained with; none for a population.
        holdouts: runs whose populations an ego is held against.
        people: the study in which simulated people play with this row's egos, in all layouts at once.
        of_first: only its first member is measured, so that a finished run of more members serves as well.
    """

    row: str
    words: tuple[str, ...]
    seed: int
    measures: tuple[str, ...]
    teachers: tuple[WantedRun, ...] = ()
    holdouts: tuple[WantedRun, ...] = ()
    people: WantedStudy | None = None
    of_first: bool = False

    @property
    def method(self) -> str:
        """As its words name it."""
        return next(word.partition("=")[2] for word in self.words if word.startswith("method="))

    @property
    def needs(self) -> tuple[WantedRun, ...]:
        """Runs that must be finished before this one is measured, in order."""
        egos = () if self.people is None else self.people.egos
        return (
            *self.teachers,
            *self.holdouts,
            *(one for ego in egos for one in (*ego.needs, ego)),
        )


@dataclass(frozen=True)
class Column:
    """A column of a target's table.

    Attributes:
        title: its head.
        figure: `measure.name` of a run's figures.
        digits: after the point.
    """

    title: str
    figure: str
    digits: int = 2


@dataclass(frozen=True)
class PaperLine:
    """A row of the paper's: its label, and column title -> number."""

    label: str
    cells: Mapping[str, float]


def _no_lines(environment: str) -> list[PaperLine]:
    """For figures of which the paper prints no numbers."""
    return []


@dataclass(frozen=True)
class Target:
    """A table or figure.

    Attributes:
        name: on the command line.
        title: of our table.
        source: the paper's table or figure; "" where it has none.
        claim: what the paper says with it.
        list_runs: (budget, seeds) -> the runs that it wants.
        columns: of its table, one row for each row of runs and environment.
        chart: name of the function of `popgen.reports.charts.reproduction_charts` that draws it.
        charted: figures that it draws: columns' titles for bars, `measure.name` of lists for lines.
        paper: environment -> the paper's rows.
        notes: what a reader must know.
    """

    name: str
    title: str
    source: str
    claim: str
    list_runs: Callable[[Budget, Sequence[int]], list[WantedRun]]
    columns: tuple[Column, ...]
    chart: str
    charted: tuple[str, ...]
    paper: Callable[[str], list[PaperLine]] = _no_lines
    notes: tuple[str, ...] = field(default=())
