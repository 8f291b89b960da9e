"""The study of docs/study.md with egos of several methods and clones of people, as a piece of `popgen reproduce`."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from popgen.durable_files import replace_file
from popgen.errors import UserError
from popgen.evaluation.convention_effects import tabulate_effects
from popgen.evaluation.played_games import PlayedGame, count_table_games
from popgen.humans.proxies import fit_missing_population
from popgen.humans.record_tables import read_table_games
from popgen.policies.portable_program import write_program
from popgen.population import load_population
from popgen.reports.conventions_report import PlayersReport, write_conventions
from popgen.reports.reproduction.target_records import StudyBudget
from popgen.study.recording_check import check_recordings
from popgen.study.simulated_participants import Casting
from popgen.study.study_definition import Study, read_study
from popgen.study.study_dry_run import DryRunPlan, run_dry, summarize_visits
from popgen.study.study_export import export_study
from popgen.study.study_folder import NamedMember, make_study
from popgen.study.study_tables import Database

TOGETHER = 20
"""Participants at once."""

CONVENTION_SPREAD = 0.5
"""Standard deviations from the mean at which the paper calls a convention high or low."""

HALF = "B"
"""Of the recorded people, those that are held out from training partners."""

FINISHED = "finished.json"


@dataclass(frozen=True)
class StudyToSimulate:
    """A study, and the ego whose games are wanted.

    Attributes:
        folder: of all studies.
        ego: name of the one that is wanted.
        egos: name -> populations of its egos, one a layout.
        tutor: population whose first member is the partner of the practice games.
        size: how many take part, and how much they play.
        seed: of the participants.
    """

    folder: Path
    ego: str
    egos: Mapping[str, Sequence[Path]]
    tutor: Path
    size: StudyBudget
    seed: int


def play_study(wanted: StudyToSimulate) -> list[PlayedGame]:
    """The games of people with the wanted ego; the study is simulated once for all egos.

    Raises:
        UserError: egos do not fit together, or people are recorded in none of these layouts.
    """
    folder = wanted.folder / _name_study(wanted)
    if not (folder / FINISHED).exists():
        _simulate_study(wanted, folder)
    played = count_table_games(read_table_games(folder / "export" / "steps.parquet"))
    return played.get(f"people with {wanted.ego}", [])


def _name_study(wanted: StudyToSimulate) -> str:
    """The same for the same egos, size and seed."""
    facts = [sorted((name, *map(str, paths)) for name, paths in wanted.egos.items()), asdict(wanted.size), wanted.seed]
    return f"study-s{wanted.seed}-{hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:8]}"


def _simulate_study(wanted: StudyToSimulate, folder: Path) -> None:
    """Make the study, let everybody take part, prove the recordings and write the tables; one that was broken off is
    begun anew."""
    shutil.rmtree(folder, ignore_errors=True)
    study = _make_study(wanted, folder)
    size = wanted.size
    layouts = [] if size.random_keys else study.definition.layouts
    people = [fit_missing_population(wanted.folder / "people", layout, HALF) for layout in layouts]
    plan = DryRunPlan(participants=size.participants, together=TOGETHER, seed=wanted.seed)
    casting = Casting(study, [load_population(path) for path in people])
    found = run_dry(study, casting, plan, lambda done: None)
    database = Database(study.database)
    checked = check_recordings(study, database)
    if wrong := [one for one in checked if one.problem]:
        raise UserError("study", f"game {wrong[0].game} is not proven: {wrong[0].problem}", "look into its records")
    exported = export_study(study, database, folder / "export")
    database.close()
    _write_tables(folder)
    told = {"seconds": round(found.seconds, 1), "steps": exported.steps, "proven": len(checked)}
    told |= summarize_visits(found.visits)
    replace_file(folder / FINISHED, (json.dumps(told, sort_keys=True) + "\n").encode())


def _make_study(wanted: StudyToSimulate, folder: Path) -> Study:
    egos = [NamedMember(name, str(path)) for name, paths in wanted.egos.items() for path in paths]
    tutor = NamedMember("tutorial", str(wanted.tutor))
    size = wanted.size
    settings: dict[str, Any] = {"pairs": size.pairs, "tutorials": size.tutorials, "steps": size.steps}
    settings["host"] = "browser" if all(_has_program(one) for one in (*egos, tutor)) else "server"
    make_study(folder, egos, tutor, settings)
    return read_study(folder)


def _has_program(one: NamedMember) -> bool:
    try:
        write_program(load_population(one.population)[one.member])
    except ValueError:
        return False
    return True


def _write_tables(folder: Path) -> None:
    """Table 3 of every ego with sizes and intervals, as `popgen conventions --records` writes it."""
    played = count_table_games(read_table_games(folder / "export" / "steps.parquet"))
    reports = []
    for label, games in sorted(played.items()):
        within, pooled = (tabulate_effects(games, CONVENTION_SPREAD, pooled=whole) for whole in (False, True))
        if label != "people with tutorial":
            reports.append(PlayersReport(label, len(games), within, pooled, {}))
    write_conventions(reports, folder / "conventions")
