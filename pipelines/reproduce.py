"""Tables and figures of the paper: the runs that targets want, what is measured of them, and their records.

Everything is a piece in one folder, shared by all targets, and a finished piece stays:

    OUT/runs/RUN/            a run, finished or with checkpoints to go on from
    OUT/pieces/RUN.json      who made it: command, machine, seconds
    OUT/measured/RUN.MEASURE.json
    OUT/studies/STUDY/       a simulated study with its records and tables; OUT/studies/people/LAYOUT: clones of people
    OUT/TARGET/              record.json, report.md, rows.csv, chart.png and .svg

Whatever ends the process, the same command goes on with the next piece.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.durable_files import replace_file
from popgen.errors import UserError
from popgen.jsonable import jsonable
from popgen.pipelines.reproduction_pieces import Job, Pieces, read_json, write_json
from popgen.pipelines.run_batch import run_all
from popgen.pipelines.run_measures import MEASURES, RunToMeasure, describe_seconds, round_figures
from popgen.pipelines.simulated_study import StudyToSimulate
from popgen.progress import Reporter
from popgen.reports.charts.chart_style import Pictures
from popgen.reports.charts.reproduction_charts import draw_target
from popgen.reports.method_titles import title_of
from popgen.reports.reproduction.results_page import FORMAT, VERSION, to_record_text, to_report
from popgen.reports.reproduction.run_lists import EGO_MARK
from popgen.reports.reproduction.run_tables import to_rows_csv
from popgen.reports.reproduction.target_records import Record, Target, WantedRun
from popgen.reports.run_record import is_finished, read_run
from popgen.runs.machine import describe_machine
from popgen.runs.provenance import read_attempts


def make_all(pieces: Pieces, reporter: Reporter) -> dict[str, Record]:
    """Make what is missing; a piece that fails does not hold up the others. Gives the targets' records by name."""
    for folder in ("runs", "pieces", "measured"):
        (pieces.plan.out / folder).mkdir(parents=True, exist_ok=True)
    jobs = pieces.list_all_jobs()
    for number, job in enumerate(jobs, start=1):
        if not job.done and pieces.plan.trains:
            reporter.note(f"piece {number} of {len(jobs)}: {job.wanted.row}, seed {job.wanted.seed}")
            _attempt(job, lambda job=job: _make_run(pieces, job, reporter))
    for job in jobs:
        for name in job.measures if job.done else ():
            if not pieces.is_measured(job, name):
                _attempt(job, lambda job=job, name=name: _measure_run(pieces, job, name))
    return {target.name: _write_target(pieces, target) for target in pieces.plan.targets}


def _attempt(job: Job, work: Callable[[], None]) -> None:
    try:
        work()
    except UserError as error:
        job.failed = str(error)


def _make_run(pieces: Pieces, job: Job, reporter: Reporter) -> None:
    if blocked := [need for need in job.wanted.needs if not pieces.find_job(need).done]:
        raise UserError("run", f"needs {blocked[0].row}, seed {blocked[0].seed}", "finish that run first")
    config = _configure_ego(pieces, job) if job.config is None else job.config
    began = time.time()
    run_all([config], reporter=reporter)
    piece = {
        "command": pieces.describe_command(job),
        "machine": describe_machine(),
        "seconds": round(time.time() - began, 1),
    }
    write_json(pieces.find_piece(job), piece)


def _configure_ego(pieces: Pieces, job: Job) -> RunConfig:
    from popgen.pipelines.ego_training import make_ego_config

    place = {"run.root": str(job.folder.parent), "run.id": job.folder.name}
    settings = {**pieces.list_ego_settings(job.wanted), **place, "run.seed": job.wanted.seed, "tracking.enabled": False}
    teachers = [str(pieces.find_job(one).folder / "population") for one in job.wanted.teachers]
    return make_ego_config(job.wanted.method, teachers, settings, scale=pieces.plan.budget.scale)


def _measure_run(pieces: Pieces, job: Job, name: str) -> None:
    holdouts = {one.row: pieces.find_job(one).folder for one in job.wanted.holdouts}
    if missing := [title for title, folder in holdouts.items() if not is_finished(folder)]:
        raise UserError(name, f"needs {missing[0]}", "finish that run first")
    episodes, people = pieces.plan.budget.episodes, _gather_study(pieces, job)
    humans, search = pieces.plan.out / "humans", pieces.plan.budget.proxy
    common = pieces.find_common_size(job)
    work = RunToMeasure(job.folder, job.wanted.row, episodes, holdouts, people, humans, search, common)
    figures = MEASURES[name](work)
    values = {"run": str(job.folder), "episodes": episodes, "figures": round_figures(jsonable(figures))}
    values["definition"] = pieces.define_measure(job, name)
    write_json(pieces.find_measured(job, name), values)


def _gather_study(pieces: Pieces, job: Job) -> StudyToSimulate | None:
    """The study that a job's ego plays in; raises UserError where one of its egos is missing."""
    if job.people is None:
        return None
    egos: dict[str, list[Path]] = {}
    for ego in job.people.egos:
        found = pieces.find_job(ego)
        if not found.done:
            raise UserError("study", f"needs the ego of {ego.row}, seed {ego.seed}", "finish that run first")
        egos.setdefault(f"{EGO_MARK}{ego.row}", []).append(found.folder / "population")
    tutor = pieces.find_job(job.people.egos[0].teachers[0]).folder / "population"
    name = f"{EGO_MARK}{job.wanted.teachers[0].row}"
    return StudyToSimulate(pieces.plan.out / "studies", name, egos, tutor, job.people.size, job.wanted.seed)


def _write_target(pieces: Pieces, target: Target) -> Record:
    record = make_record(pieces, target)
    folder = pieces.plan.out / target.name
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "record.json": to_record_text(record),
        "report.md": to_report(record),
        "rows.csv": to_rows_csv(record, target),
    }
    for name, text in texts.items():
        replace_file(folder / name, text.encode())
    if record["runs"]:
        draw_target(record, target, Pictures(folder).add("chart"))
    return record


def make_record(pieces: Pieces, target: Target) -> Record:
    """The JSON object of `popgen.reports.reproduction`, of what is there."""
    runs, missing = [], []
    for run in pieces.wanted[target.name]:
        job = pieces.find_job(run)
        if job.done and all(pieces.is_measured(job, name) for name in run.measures):
            runs.append(_describe_run(pieces, run, job))
        elif (told := pieces.find_recorded(target, run)) is not None:
            runs.append(told)
        else:
            why = job.failed or "not made yet"
            row, environment = name_missing(run, pieces.wanted[target.name]), pieces.find_environment(run)
            missing.append({"row": row, "environment": environment, "seed": run.seed, "why": why})
    return {
        "format": FORMAT,
        "format_version": VERSION,
        "target": target.name,
        "budget": pieces.plan.budget.name,
        "seeds": list(pieces.plan.seeds),
        "settings": list(pieces.plan.settings),
        "episodes": pieces.plan.budget.episodes,
        "command": pieces.plan.command,
        "written": datetime.now(UTC).strftime("%Y-%m-%d"),
        "runs": runs,
        "missing": missing,
    }


def name_missing(run: WantedRun, wanted: Sequence[WantedRun]) -> str:
    """A run by its row; an ego that shares the row of a population is told apart from it."""
    shared = run.teachers and any(one.row == run.row and not one.teachers for one in wanted)
    return f"{run.row}'s ego" if shared else run.row


def _describe_run(pieces: Pieces, run: WantedRun, job: Job) -> dict[str, Any]:
    record, piece = read_run(job.folder), read_json(pieces.find_piece(job))
    attempts = read_attempts(job.folder)
    last = attempts[-1] if attempts else {}
    return {
        "row": run.row,
        "method": title_of(record.method),
        "environment": pieces.find_environment(run),
        "seed": run.seed,
        "command": pieces.describe_command(job),
        "run": job.folder.name,
        "settings_digest": pieces.digest_settings(run),
        "commit": last.get("commit"),
        "changed": last.get("changed"),
        "versions": {name: last.get(name) for name in ("popgen", "python", "torch", "numpy")},
        "machine": piece.get("machine") or last.get("machine"),
        "taken_over": job.taken_over,
        "seconds": describe_seconds(record),
        **({"weak_members": list(record.weak_members)} if record.weak_members else {}),
        "definitions": {name: pieces.define_measure(job, name) for name in run.measures},
        "figures": {name: pieces.read_measured(job, name) for name in run.measures},
    }
