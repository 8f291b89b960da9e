"""What a report is made from: a run's folder, or a population's alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.evaluation.crossplay import evaluate_population
from popgen.population.member_pairs import find_mates
from popgen.population.store import Population, load_population
from popgen.reports.crossplay_report import restate_pairs, to_dict
from popgen.reports.run_record import MemberRecord, RunRecord, read_ledger, read_run
from popgen.runs.ledger import Ledger
from popgen.types import Kind


@dataclass(frozen=True)
class ReportSource:
    """Everything that a report shows.

    Attributes:
        population: whose members play the replays.
        run: its members' steps, curves and scores; made of the manifest where there is no run.
        folder: of the run, None where the population stands alone or its run is not finished.
        config: of the run.
        ledger: of the run.
    """

    population: Population
    run: RunRecord
    folder: Path | None = None
    config: RunConfig | None = None
    ledger: Ledger | None = None


def read_source(
    path: str | Path, *, episodes: int = 20, progress: Callable[[int, int], None] | None = None
) -> ReportSource:
    """Read a run's or a population's folder; a population without figures is evaluated.

    Args:
        path: of a run, of its population, or of a population alone.
        episodes: for each pair, where there is no evaluation yet.
        progress: called with (episodes done, episodes in all).

    Raises:
        UserError: neither a run nor a population with members, or damaged files.
    """
    population = load_population(path)
    place = population.path.resolve().parent
    if population.path.resolve().name == "population" and (place / "config.json").is_file():
        try:
            return _of_run(population, place if Path(path).is_absolute() else _relative_place(Path(path)))
        except UserError as error:
            if not error.problem.startswith("is unfinished"):
                raise
    return _of_population(population, episodes, progress)


def _relative_place(path: Path) -> Path:
    """The run's folder as the user would write it."""
    return path if (path / "config.json").is_file() else path.parent


def _of_run(population: Population, place: Path) -> ReportSource:
    run = read_run(place)
    try:
        config = RunConfig.parse(json.loads((place / "config.json").read_text(encoding="utf-8")))
    except (UserError, TypeError):
        config = None  # of a version with other fields
    return ReportSource(population, run, place, config, read_ledger(place / "ledger.jsonl"))


def _of_population(population: Population, episodes: int, progress: Callable[[int, int], None] | None) -> ReportSource:
    scores = read_scores(population.path / "evaluation" / "crossplay.json", population)
    if scores is None:
        scores = to_dict(evaluate_population(population, episodes, 0, progress=progress))
    manifest = population.manifest
    members = []
    for info in population.members:
        steps = {kind: count for kind, count in info.steps.items() if kind != Kind.EVALUATION}
        seconds = info.extra.get("seconds")
        time = float(seconds) if isinstance(seconds, int | float) else None
        members.append(MemberRecord(info.id, steps, time, False, ()))
    run = RunRecord(
        path=population.path,
        run_id=population.path.name,
        label=manifest.method,
        method=manifest.method,
        seed=manifest.seed,
        scale="",
        environment=manifest.environment,
        settings={},
        members=tuple(members),
        evaluation_steps=0,
        lost_steps=0,
        attempts=0,
        scores=scores,
    )
    return ReportSource(population, run)


def read_scores(file: Path, population: Population) -> Mapping[str, Any] | None:
    """An evaluation of exactly these members, None where there is none."""
    try:
        scores = json.loads(file.read_text(encoding="utf-8"))
        whole = scores["members"] == list(range(1, len(population) + 1))
        same = scores["environment"]["fingerprint"] == population.env_info.fingerprint
        known = whole and same and scores["format"] == "popgen-crossplay"
        return restate_pairs(scores, find_mates(population.members)) if known else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
