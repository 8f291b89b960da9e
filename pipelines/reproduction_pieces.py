"""What `popgen reproduce` is to make, and what of it is there: runs, measures, and an estimate of the rest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig, field_names
from popgen.durable_files import replace_file
from popgen.methods.registry import METHODS, recipe
from popgen.pipelines.run_batch import named
from popgen.reports.reproduction.measure_definitions import COMPARED, FIRST, define_measure
from popgen.reports.reproduction.target_records import Budget, Record, Target, WantedRun, WantedStudy
from popgen.reports.run_record import differences, is_finished, planned_run, read_run

ALL_LAYOUTS = "overcooked/all layouts"
"""The environment of what is pooled over layouts."""

MEASURE_SECONDS = 10.0
"""That a measure takes, until one has been made."""


HOLDOUT = "holdout"
"""The measure of an ego beside its hold-outs, of which each target has its own."""


@dataclass(frozen=True)
class ComposedRun:
    """A checked configuration, and the overrides that give it."""

    config: RunConfig
    words: tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """What is to be made.

    Attributes:
        targets, budget, seeds: as asked for.
        out: folder of all pieces.
        settings: given on top of the budget's, for all runs that have them.
        command: that makes it again.
        compose: overrides -> a checked configuration, and those of the overrides that its method has.
        elsewhere: folders with finished runs that are taken instead of new ones.
        records: earlier records, whose figures are kept where a run of today would have the same settings.
        trains: runs that are missing are made; without it what is finished is measured and told.
        ego_settings: dotted field -> value on top of the egos' recipe.
    """

    targets: Sequence[Target]
    budget: Budget
    seeds: Sequence[int]
    out: Path
    settings: Sequence[str]
    command: str
    compose: Callable[[Sequence[str]], ComposedRun]
    elsewhere: Sequence[Path] = ()
    records: Sequence[Record] = ()
    trains: bool = True
    ego_settings: Mapping[str, Any] = field(default_factory=dict)


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
        people: the study in which it plays.
    """

    wanted: WantedRun
    folder: Path
    config: RunConfig | None
    words: tuple[str, ...]
    taken_over: bool = False
    measures: list[str] = field(default_factory=list)
    failed: str = ""
    people: WantedStudy | None = None
    _done: bool = False

    @property
    def done(self) -> bool:
        """The run is finished; one that is stays so, and its folder is not read again."""
        self._done = self._done or is_finished(self.folder)
        return self._done

    @property
    def key(self) -> str:
        """The folder, and of an ego against whom it is held: one ego may be in several targets, each with its own."""
        return f"{self.folder}|{self.name_holdouts()}"

    def name_file(self, measure: str) -> str:
        """Of a measure."""
        return f"{self.folder.name}.{measure}{self.name_holdouts() if measure == HOLDOUT else ''}.json"

    def name_holdouts(self) -> str:
        """A short name of whom an ego is held against, empty where that is nobody."""
        whom = ", ".join(f"{one.row} {one.seed}" for one in self.wanted.holdouts)
        return f"-{hashlib.sha256(whom.encode()).hexdigest()[:8]}" if whom else ""


class Pieces:
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
        self._digests: dict[WantedRun, str] = {}
        self._elsewhere = [read_run(path) for path in _find_runs(plan.elsewhere)]
        for runs in self.wanted.values():
            for run in runs:
                self._add_job(run)
        self._recorded = {target.name: self._find_recorded(target) for target in plan.targets}

    def find_job(self, run: WantedRun) -> Job:
        """The job that makes a wanted run."""
        return self.jobs[self._keys[run]]

    def _add_job(self, run: WantedRun) -> Job:
        for needed in run.needs:
            self._add_job(needed)
        if run not in self._keys:
            job = self._make_ego_job(run) if run.teachers else self._make_job(run)
            self._keys[run] = job.key
            self.jobs.setdefault(job.key, job)
        job = self.find_job(run)
        job.people = job.people or run.people
        job.measures += [name for name in run.measures if name not in job.measures]
        return job

    def _make_job(self, run: WantedRun) -> Job:
        composed = self.plan.compose(keep_last((*run.words, f"seed={run.seed}", *self.plan.settings)))
        config, words = named(composed.config, self.plan.out / "runs"), composed.words
        planned = planned_run(config)
        for one in self._elsewhere:
            size = len(one.members)
            enough = size >= config.population.size if run.of_first else size == config.population.size
            same = (one.seed, one.environment.fingerprint) == (planned.seed, planned.environment.fingerprint)
            if same and enough and one.method == planned.method and not differences(planned, one):
                return Job(run, one.path, config, words, taken_over=True)
        return Job(run, planned.path, config, words)

    def _make_ego_job(self, run: WantedRun) -> Job:
        folders = [self.find_job(one).folder for one in run.teachers]
        given = (f"{key}={value}" for key, value in self.list_ego_settings(run).items())
        words = (*run.words, f"seed={run.seed}", *given)
        own = [one.name if one.parent == self.plan.out / "runs" else str(one) for one in folders]
        digest = hashlib.sha256(" ".join((*own, *words)).encode()).hexdigest()[:8]
        more = f"-and-{len(folders) - 1}" if len(folders) > 1 else ""
        return Job(run, self.plan.out / "runs" / f"ego-{folders[0].name}{more}-{digest}", None, words)

    def list_ego_settings(self, run: WantedRun) -> dict[str, Any]:
        """Those of the plan's settings for egos that the method of this one has."""
        from popgen.pipelines.ego_training import find_ego_method

        own = set(field_names(METHODS[find_ego_method(run.method)].config))
        return {key: value for key, value in self.plan.ego_settings.items() if key in own}

    # What earlier records tell

    def digest_settings(self, run: WantedRun) -> str:
        """Of everything that decides a run's figures: its settings, and those of the runs that it needs."""
        if run not in self._digests:
            job = self.find_job(run)
            own = self._describe_ego(run) if job.config is None else _describe_run(job.config)
            parts = [run.seed, own, [self.digest_settings(needed) for needed in run.needs]]
            self._digests[run] = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
        return self._digests[run]

    def _describe_ego(self, run: WantedRun) -> list[Any]:
        """What decides an ego, its partners aside: its words, its method's recipe and what was given on top."""
        from popgen.pipelines.ego_training import find_ego_method

        teacher = self.find_job(run.teachers[0]).config
        assert teacher is not None
        config = recipe(find_ego_method(run.method), teacher.env.name, self.plan.budget.scale)
        settings = self.list_ego_settings(run)
        given = [settings] if settings else []
        return [list(run.words), _describe_run(config), *given]

    def _find_recorded(self, target: Target) -> dict[WantedRun, dict[str, Any]]:
        """Entries of earlier records of the same budget, by the run of today that they stand for; without figures whose
        meaning has changed. One that then lacks some counts where nothing is trained, but not in a new run's place."""
        budget = (target.name, self.plan.budget.name, self.plan.budget.episodes)
        same = [one for one in self.plan.records if (one["target"], one["budget"], one["episodes"]) == budget]
        entries = {(run["row"], run.get("settings_digest")): run for one in same for run in one["runs"]}
        if not entries:
            return {}
        found = {}
        for run in self.wanted[target.name]:
            told = entries.get((run.row, self.digest_settings(run)))
            today = {name: self.define_measure(self.find_job(run), name) for name in run.measures}
            figures = {} if told is None else _keep_comparable(told, today)
            if told is not None and figures and (len(figures) == len(run.measures) or not self.plan.trains):
                found[run] = {**told, "figures": figures}
        return found

    def find_recorded(self, target: Target, run: WantedRun) -> dict[str, Any] | None:
        """What an earlier record tells of a run; None where none does, or the run is here."""
        return None if self.find_job(run).done else self._recorded[target.name].get(run)

    # What is there

    def find_common_size(self, job: Job) -> int:
        """Members of the smallest population that a job's is compared with, 0 where there is none."""
        return _find_common_size(job, self.jobs.values())

    def define_measure(self, job: Job, name: str) -> str:
        """What a measure of a job means; see `popgen.reports.reproduction.measure_definitions`."""
        return define_measure(name, job.config.method if job.config else "", self.find_common_size(job))

    def is_measured(self, job: Job, name: str) -> bool:
        """A measure of today's meaning was made with as many episodes."""
        return self.read_measured(job, name) is not None

    def find_measured(self, job: Job, name: str) -> Path:
        """The file of a measure, of an ego's hold-outs one for each set of them."""
        return self.plan.out / "measured" / job.name_file(name)

    def read_measured(self, job: Job, name: str) -> dict[str, Any] | None:
        """Its figures; None where it is not there, has another meaning, or was made with other episodes or of another
        folder."""
        values = read_json(self.find_measured(job, name))
        found = [values.get("episodes"), values.get("run"), values.get("definition", FIRST)]
        same = found == [self.plan.budget.episodes, str(job.folder), self.define_measure(job, name)]
        return values["figures"] if same else None

    def count_pieces(self, target: Target) -> dict[str, int]:
        """Of a target: runs, runs done, measures, measures done."""
        jobs, wanted = self.list_jobs(target), self.wanted[target.name]
        told = [run for run in wanted if self.find_recorded(target, run)]
        own = [(self.find_job(run), name) for run in wanted if run not in told for name in run.measures]
        measures = {self.find_measured(job, name): (job, name) for job, name in own}.values()
        measures_told = sum(len(run.measures) for run in told)
        return {
            "runs": len(jobs) + len(told),
            "runs_done": sum(job.done for job in jobs) + len(told),
            "measures": len(measures) + measures_told,
            "measures_done": sum(self.is_measured(job, name) for job, name in measures) + measures_told,
        }

    def list_all_jobs(self) -> list[Job]:
        """Of all targets, each once."""
        return list({job.key: job for target in self.plan.targets for job in self.list_jobs(target)}.values())

    def list_jobs(self, target: Target) -> list[Job]:
        """Of a target, what its runs need first; without runs that an earlier record tells."""
        found: dict[str, Job] = {}
        for run in self.wanted[target.name]:
            if self.find_recorded(target, run) is not None:
                continue
            for one in (*run.needs, run):
                job = self.find_job(one)
                found[job.key] = job
        return list(found.values())

    def estimate_seconds(self, target: Target | None = None) -> float:
        """That what is left will take: runs of the same kind as long as those that are done, others as the budget says;
        of one target, or of all pieces once."""
        jobs = self.list_all_jobs() if target is None else self.list_jobs(target)
        times: dict[str, list[float]] = {}
        for job in self.jobs.values():
            seconds = read_json(self.find_piece(job)).get("seconds")
            if job.done and seconds is not None:
                times.setdefault(_kind_of(job), []).append(seconds)
        usual = 60 * self.plan.budget.minutes
        runs = {job.folder: _average(times.get(_kind_of(job), []), usual) for job in jobs if not job.done}
        todo = [name for job in jobs for name in job.measures if not self.is_measured(job, name)]
        return sum(runs.values()) + MEASURE_SECONDS * len(todo) * (self.plan.budget.episodes / 20)

    def find_piece(self, job: Job) -> Path:
        """The file that says who made a run."""
        return self.plan.out / "pieces" / f"{job.folder.name}.json"

    def describe_command(self, job: Job) -> str:
        """That makes the run."""
        if not job.wanted.teachers:
            return " ".join(["popgen run", *job.words])
        teachers = [f"{self.find_job(one).folder.name}/population" for one in job.wanted.teachers]
        return " ".join(["popgen ego train", *teachers, *job.words])

    def find_environment(self, run: WantedRun) -> str:
        """Where it plays: an ego where its teacher does, one beside people in all layouts."""
        if run.people is not None:
            return ALL_LAYOUTS
        job = self.find_job(run.teachers[0] if run.teachers else run)
        assert job.config is not None
        return job.config.env.name

    def list_failures(self) -> list[str]:
        """Why pieces are not there, after an attempt."""
        return [f"{job.wanted.row}, seed {job.wanted.seed}: {job.failed}" for job in self.jobs.values() if job.failed]


def _keep_comparable(told: Mapping[str, Any], today: Mapping[str, str]) -> dict[str, Any]:
    """Figures of a record's entry, those of measures whose meaning is today's."""
    known = dict.fromkeys(told["figures"], FIRST) | told.get("definitions", {})
    return {name: figures for name, figures in told["figures"].items() if today.get(name) == known[name]}


def _find_common_size(job: Job, jobs: Iterable[Job]) -> int:
    """The smallest population in a job's environment of which something is measured that depends on it."""
    every = [one.config for one in jobs if not set(COMPARED).isdisjoint(one.measures)]
    same = [one for one in every if one is not None and job.config is not None and one.env == job.config.env]
    return min((one.population.size for one in same), default=0)


def _describe_run(config: RunConfig) -> list[Any]:
    """What decides a population: rules, method, size and settings."""
    planned, unused = planned_run(config), config.unused_fields()
    settings = {name: value for name, value in planned.settings.items() if name not in unused}
    return [planned.environment.fingerprint, planned.method, config.population.size, settings]


def keep_last(words: Sequence[str]) -> tuple[str, ...]:
    """Overrides of which only the last of each setting counts, in order of their first."""
    return tuple({word.partition("=")[0]: word for word in words}.values())


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


def read_json(path: Path) -> dict[str, Any]:
    """Empty for a file that is not there, or no JSON."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """In place of what was there, at once."""
    replace_file(path, (json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())
