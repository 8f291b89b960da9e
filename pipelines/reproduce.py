"""Tables and figures of the paper: the runs that targets want, what is measured of them, and their records.

Everything is a piece in one folder, shared by all targets, and a finished piece stays:

    OUT/runs/RUN/            a run, finished or with checkpoints to go on from
    OUT/pieces/RUN.json      who made it: command, machine, seconds
    OUT/measured/RUN.MEASURE.json
    OUT/TARGET/              record.json, report.md, rows.csv, chart.png and .svg

Whatever ends the process, the same command goes on with the next piece.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.durable_files import replace_file
from popgen.errors import UserError
from popgen.jsonable import jsonable
from popgen.pipelines.run_batch import named, run_all
from popgen.pipelines.run_measures import MEASURES, RunToMeasure, describe_seconds, round_figures
from popgen.progress import Reporter
from popgen.reports.charts.chart_style import Pictures
from popgen.reports.charts.reproduction_charts import draw_target
from popgen.reports.method_titles import title_of
from popgen.reports.reproduction.results_page import FORMAT, VERSION, to_record_text, to_report
from popgen.reports.reproduction.run_tables import to_rows_csv
from popgen.reports.reproduction.target_records import Budget, Record, Target, WantedRun
from popgen.reports.run_record import differences, is_finished, planned_run, read_run
from popgen.runs.machine import describe_machine
from popgen.runs.provenance import read_attempts

MEASURE_SECONDS = 10.0
"""That a measure takes, until one has been made."""


@dataclass(frozen=True)
class Plan:
    """What is to be made.

    Attributes:
        targets, budget, seeds: as asked for.
        out: folder of all pieces.
        settings: given on top of the budget's, for all runs that have them.
        command: that makes it again.
        compose: overrides -> a checked configuration.
        elsewhere: folders with finished runs that are taken instead of new ones.
        trains: runs that are missing are made; without it what is finished is measured and told.
    """

    targets: Sequence[Target]
    budget: Budget
    seeds: Sequence[int]
    out: Path
    settings: Sequence[str]
    command: str
    compose: Callable[[Sequence[str]], RunConfig]
    elsewhere: Sequence[Path] = ()
    trains: bool = True


@dataclass
class Job:
    """A run of the plan.

    Attributes:
        wanted: as its first target wants it.
        folder: of the run.
        config: of a population; None of an ego, whose partners' digests are known only once they are trained.
        words: overrides, seed among them.
        taken_over: the run is elsewhere.
        measures: of all targets.
        failed: why it is not there, after an attempt.
    """

    wanted: WantedRun
    folder: Path
    config: RunConfig | None
    words: tuple[str, ...]
    taken_over: bool = False
    measures: list[str] = field(default_factory=list)
    failed: str = ""

    @property
    def done(self) -> bool:
        """The run is finished."""
        return is_finished(self.folder)


class Reproduction:
    """All pieces of a plan.

    Args:
        plan: what is to be made.

    Raises:
        UserError: a run that cannot work.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.jobs: dict[str, Job] = {}
        self.wanted = {target.name: target.list_runs(plan.budget, plan.seeds) for target in plan.targets}
        self._keys: dict[WantedRun, str] = {}
        self._elsewhere = [read_run(path) for path in _find_runs(plan.elsewhere)]
        for runs in self.wanted.values():
            for run in runs:
                self._add_job(run)

    def find_job(self, run: WantedRun) -> Job:
        """The job that makes a wanted run."""
        return self.jobs[self._keys[run]]

    def _add_job(self, run: WantedRun) -> Job:
        for needed in run.needs:
            self._add_job(needed)
        if run not in self._keys:
            job = self._make_job(run) if run.teacher is None else self._make_ego_job(run)
            self._keys[run] = str(job.folder)
            self.jobs.setdefault(str(job.folder), job)
        job = self.find_job(run)
        job.measures += [name for name in run.measures if name not in job.measures]
        return job

    def _make_job(self, run: WantedRun) -> Job:
        words = (*run.words, f"seed={run.seed}", *self.plan.settings)
        config = named(self.plan.compose(words), self.plan.out / "runs")
        planned = planned_run(config)
        for one in self._elsewhere:
            same = (one.seed, len(one.members)) == (planned.seed, config.population.size)
            rules = one.environment.fingerprint == planned.environment.fingerprint
            if same and rules and one.method == planned.method and not differences(planned, one):
                return Job(run, one.path, config, words, taken_over=True)
        return Job(run, planned.path, config, words)

    def _make_ego_job(self, run: WantedRun) -> Job:
        assert run.teacher is not None
        teacher = self.find_job(run.teacher)
        words = (*run.words, f"seed={run.seed}")
        digest = hashlib.sha256(" ".join((teacher.folder.name, *words)).encode()).hexdigest()[:8]
        return Job(run, self.plan.out / "runs" / f"ego-{teacher.folder.name}-{digest}", None, words)

    # What is there

    def is_measured(self, job: Job, name: str) -> bool:
        """A measure was made with as many episodes."""
        return self._read_measured(job, name) is not None

    def _measured_file(self, job: Job, name: str) -> Path:
        return self.plan.out / "measured" / f"{job.folder.name}.{name}.json"

    def _read_measured(self, job: Job, name: str) -> dict[str, Any] | None:
        values = _read_json(self._measured_file(job, name))
        same = values.get("episodes") == self.plan.budget.episodes and values.get("run") == str(job.folder)
        return values["figures"] if same else None

    def count_pieces(self, target: Target) -> dict[str, int]:
        """Of a target: runs, runs done, measures, measures done."""
        jobs = self._jobs_of(target)
        own = [(self.find_job(run), name) for run in self.wanted[target.name] for name in run.measures]
        measures = list({(str(job.folder), name): (job, name) for job, name in own}.values())
        return {
            "runs": len(jobs),
            "runs_done": sum(job.done for job in jobs),
            "measures": len(measures),
            "measures_done": sum(self.is_measured(job, name) for job, name in measures),
        }

    def _jobs_of(self, target: Target) -> list[Job]:
        found: dict[str, Job] = {}
        for run in self.wanted[target.name]:
            for one in (*run.needs, run):
                job = self.find_job(one)
                found[str(job.folder)] = job
        return list(found.values())

    def estimate_seconds(self, target: Target | None = None) -> float:
        """That what is left will take: runs of the same kind as long as those that are done, others as the budget says;
        of one target, or of all pieces once."""
        jobs = list(self.jobs.values()) if target is None else self._jobs_of(target)
        times: dict[str, list[float]] = {}
        for job in self.jobs.values():
            seconds = _read_json(self._piece_file(job)).get("seconds")
            if job.done and seconds is not None:
                times.setdefault(_kind_of(job), []).append(seconds)
        usual = 60 * self.plan.budget.minutes
        left = sum(_average(times.get(_kind_of(job), []), usual) for job in jobs if not job.done)
        todo = [name for job in jobs for name in job.measures if not self.is_measured(job, name)]
        return left + MEASURE_SECONDS * len(todo) * (self.plan.budget.episodes / 20)

    def _piece_file(self, job: Job) -> Path:
        return self.plan.out / "pieces" / f"{job.folder.name}.json"

    # Making it

    def make_all(self, reporter: Reporter) -> dict[str, Record]:
        """Make what is missing; a piece that fails does not hold up the others. Gives the targets' records by name."""
        for folder in ("runs", "pieces", "measured"):
            (self.plan.out / folder).mkdir(parents=True, exist_ok=True)
        jobs = list(self.jobs.values())
        for number, job in enumerate(jobs, start=1):
            if not job.done and self.plan.trains:
                reporter.note(f"piece {number} of {len(jobs)}: {job.wanted.row}, seed {job.wanted.seed}")
                self._attempt(job, lambda job=job: self._make_run(job, reporter))
        for job in jobs:
            for name in job.measures if job.done else ():
                if not self.is_measured(job, name):
                    self._attempt(job, lambda job=job, name=name: self._measure(job, name))
        return {target.name: self._write_target(target) for target in self.plan.targets}

    def _attempt(self, job: Job, work: Callable[[], None]) -> None:
        try:
            work()
        except UserError as error:
            job.failed = str(error)

    def _make_run(self, job: Job, reporter: Reporter) -> None:
        if blocked := [need for need in job.wanted.needs if not self.find_job(need).done]:
            raise UserError("run", f"needs {blocked[0].row}, seed {blocked[0].seed}", "finish that run first")
        config = self._configure_ego(job) if job.config is None else job.config
        began = time.time()
        run_all([config], reporter=reporter)
        piece = {
            "command": " ".join(self._command_words(job)),
            "machine": describe_machine(),
            "seconds": round(time.time() - began, 1),
        }
        _write_json(self._piece_file(job), piece)

    def _configure_ego(self, job: Job) -> RunConfig:
        from popgen.pipelines.ego_training import make_ego_config

        assert job.wanted.teacher is not None
        settings: dict[str, Any] = {"run.root": str(job.folder.parent), "run.id": job.folder.name}
        settings |= {"run.seed": job.wanted.seed, "tracking.enabled": False}
        values = dict(word.partition("=")[::2] for word in job.wanted.words)
        teacher = self.find_job(job.wanted.teacher)
        return make_ego_config(
            values["method"], [str(teacher.folder / "population")], settings, scale=self.plan.budget.scale
        )

    def _command_words(self, job: Job) -> list[str]:
        if job.wanted.teacher is None:
            return ["popgen run", *job.words]
        return ["popgen ego train", f"{self.find_job(job.wanted.teacher).folder.name}/population", *job.words]

    def _measure(self, job: Job, name: str) -> None:
        holdouts = {one.row: self.find_job(one).folder for one in job.wanted.holdouts}
        if missing := [title for title, folder in holdouts.items() if not is_finished(folder)]:
            raise UserError(name, f"needs {missing[0]}", "finish that run first")
        episodes = self.plan.budget.episodes
        figures = MEASURES[name](RunToMeasure(job.folder, job.wanted.row, episodes, holdouts))
        values = {"run": str(job.folder), "episodes": episodes, "figures": round_figures(jsonable(figures))}
        _write_json(self._measured_file(job, name), values)

    # Records

    def _write_target(self, target: Target) -> Record:
        record = self.make_record(target)
        folder = self.plan.out / target.name
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

    def make_record(self, target: Target) -> Record:
        """The JSON object of `popgen.reports.reproduction`, of what is there."""
        runs, missing = [], []
        for run in self.wanted[target.name]:
            job = self.find_job(run)
            if job.done and all(self.is_measured(job, name) for name in run.measures):
                runs.append(self._describe_run(run, job))
            else:
                why = job.failed or "not made yet"
                missing.append({"row": run.row, "environment": self._environment_of(run), "seed": run.seed, "why": why})
        return {
            "format": FORMAT,
            "format_version": VERSION,
            "target": target.name,
            "budget": self.plan.budget.name,
            "seeds": list(self.plan.seeds),
            "settings": list(self.plan.settings),
            "episodes": self.plan.budget.episodes,
            "command": self.plan.command,
            "written": datetime.now(UTC).strftime("%Y-%m-%d"),
            "runs": runs,
            "missing": missing,
        }

    def _environment_of(self, run: WantedRun) -> str:
        """Where it plays: an ego where its teacher does."""
        job = self.find_job(run.teacher or run)
        assert job.config is not None
        return job.config.env.name

    def _describe_run(self, run: WantedRun, job: Job) -> dict[str, Any]:
        record, piece = read_run(job.folder), _read_json(self._piece_file(job))
        attempts = read_attempts(job.folder)
        last = attempts[-1] if attempts else {}
        return {
            "row": run.row,
            "method": title_of(record.method),
            "environment": self._environment_of(run),
            "seed": run.seed,
            "command": " ".join(self._command_words(job)),
            "run": job.folder.name,
            "commit": last.get("commit"),
            "changed": last.get("changed"),
            "versions": {name: last.get(name) for name in ("popgen", "python", "torch", "numpy")},
            "machine": piece.get("machine"),
            "taken_over": job.taken_over,
            "seconds": describe_seconds(record),
            "figures": {name: self._read_measured(job, name) for name in run.measures},
        }

    def list_failures(self) -> list[str]:
        """Why pieces are not there, after an attempt."""
        return [f"{job.wanted.row}, seed {job.wanted.seed}: {job.failed}" for job in self.jobs.values() if job.failed]


def _find_runs(folders: Sequence[Path]) -> list[Path]:
    """Finished runs in folders and in theirs, without what a run keeps of itself."""
    found = []
    for folder in folders:
        for depth in ("", "*/", "*/*/", "*/*/*/"):
            found += [path.parent for path in sorted(folder.glob(f"{depth}config.json")) if is_finished(path.parent)]
    return list(dict.fromkeys(found))


def _kind_of(job: Job) -> str:
    """Method, environment and size: runs alike in these take alike long."""
    return "ego" if job.config is None else " ".join(word for word in job.words if word.split("=")[0] in _KINDS)


_KINDS = ("method", "env", "population.size")


def _average(values: Sequence[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _read_json(path: Path) -> dict[str, Any]:
    """Empty for a file that is not there, or no JSON."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    replace_file(path, (json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())
