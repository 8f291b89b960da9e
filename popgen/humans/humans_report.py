"""What people did and what their clones do, side by side, in 80 columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from popgen.errors import UserError
from popgen.humans.behaviour import MEASURES, Rates, compare_rates, measure_people, team_dishes
from popgen.humans.proxies import HALVES, METHOD
from popgen.humans.recordings import LAYOUTS, HumanGame, load_games
from popgen.population import load_population

PUBLISHED = {
    "cramped_room": {"A": 5.5, "B": 5.75},
    "asymmetric_advantages": {"A": 6.8, "B": 7.0},
    "coordination_ring": {"A": 3.4, "B": 3.4},
    "forced_coordination": {"A": 1.3, "B": 1.5},
    "counter_circuit_o_1order": {"A": 2.4, "B": 2.4},
}
"""Dishes of the published clones (Carroll et al. 2019) in play with themselves, by half: of the train games (A) and of
the test games (B)."""


@dataclass(frozen=True)
class LayoutReport:
    """One layout: its recorded games, the people's rates, and each half's clone where one was fitted.

    Attributes:
        layout: its name.
        games: number by half.
        steps: joint steps by half.
        people: rates over all games.
        clones: half -> rates of its first member.
        likelihoods: half -> negative log-likelihood.
    """

    layout: str
    games: dict[str, int]
    steps: dict[str, int]
    people: Rates
    clones: dict[str, Rates]
    likelihoods: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        clones = {
            half: {
                "mean": dict(zip(MEASURES, rates.mean, strict=True)),
                "within": compare_rates(self.people, rates).within,
                "dishes": team_dishes(rates),
                "likelihood": self.likelihoods[half],
            }
            for half, rates in self.clones.items()
        }
        return {
            "layout": self.layout,
            "games": self.games,
            "joint_steps": self.steps,
            "people": {
                "mean": dict(zip(MEASURES, self.people.mean, strict=True)),
                "deviation": dict(zip(MEASURES, self.people.deviation, strict=True)),
            },
            "clones": clones,
            "published_dishes": PUBLISHED[self.layout],
        }


def report_layouts(root: str | Path, layouts: Sequence[str]) -> list[LayoutReport]:
    """Read the recordings, and the populations that `fit` wrote under `root` (none are needed).

    Raises:
        UserError: missing recordings, or a folder that holds another population.
    """
    games = load_games(layouts=layouts)
    return [_report_layout(Path(root), layout, [game for game in games if game.layout == layout]) for layout in layouts]


def _report_layout(root: Path, layout: str, games: Sequence[HumanGame]) -> LayoutReport:
    clones, likelihoods = {}, {}
    for half in HALVES:
        folder = population_folder(root, layout, half)
        if not folder.exists():
            continue
        population = load_population(folder)
        if population.manifest.method != METHOD:
            raise UserError(str(folder), "is no population of human clones", "give the folder that `fit` wrote")
        if not len(population):
            raise UserError(str(folder), "holds no clone: its fit was broken off", "remove it and fit it again")
        extra = population.info(1).extra
        if extra["measures"] != list(MEASURES):
            raise UserError(str(folder), "was fitted by another version of popgen", "fit it again")
        figures = extra["clone"]
        clones[half] = Rates(np.array(figures["mean"]), np.array(figures["deviation"]), 0)
        likelihoods[half] = float(extra["likelihood"])
    halves = {half: [game for game in games if game.half == name] for half, name in HALVES.items()}
    return LayoutReport(
        layout,
        {half: len(part) for half, part in halves.items()},
        {half: sum(game.steps for game in part) for half, part in halves.items()},
        measure_people(games),
        clones,
        likelihoods,
    )


def population_folder(root: str | Path, layout: str, half: str) -> Path:
    """Where the clones of a layout and half lie."""
    return Path(root) / f"{layout}_{half}"


def to_tables(reports: Sequence[LayoutReport]) -> list[Table]:
    """One table a layout: people's mean and SD, and each clone with its distance in SD; at most 80 columns."""
    return [_to_table(report) for report in reports]


def _to_table(report: LayoutReport) -> Table:
    counts = ", ".join(f"{half} {report.games[half]} games {report.steps[half]:,} steps" for half in HALVES)
    table = Table(title=Text(f"{report.layout}: {counts}"), title_justify="left")
    table.add_column("in 400 steps")
    for name in ("people", "SD"):
        table.add_column(name, justify="right")
    for half in report.clones:
        table.add_column(f"clone {half}", justify="right")
        table.add_column("off by", justify="right")
    agreements = {half: compare_rates(report.people, rates) for half, rates in report.clones.items()}
    for number, name in enumerate(MEASURES):
        row = [name, f"{report.people.mean[number]:.2f}", f"{report.people.deviation[number]:.2f}"]
        for half, rates in report.clones.items():
            row += [f"{rates.mean[number]:.2f}", f"{agreements[half].distances[number]:.1f} SD"]
        table.add_row(*row)
    return table


def to_lines(reports: Sequence[LayoutReport]) -> list[str]:
    """A sentence for each clone, and the share of cells over all."""
    lines, within, cells = [], 0, 0
    for report in reports:
        for half, rates in report.clones.items():
            agreement = compare_rates(report.people, rates)
            within, cells = within + agreement.within, cells + len(MEASURES)
            dishes = f"{team_dishes(rates):.2f} dishes ({PUBLISHED[report.layout][half]} published)"
            lines.append(
                f"{report.layout} {half}: {dishes}, {agreement.within}/{len(MEASURES)} within 1 SD, "
                f"NLL {report.likelihoods[half]:.2f}"
            )
    if cells:
        lines.append(f"within one SD of all people's, of both halves: {within} of {cells} cells ({within / cells:.0%})")
    else:
        lines.append(f"no clones here; `popgen humans fit` makes them for {', '.join(LAYOUTS)}")
    return lines
