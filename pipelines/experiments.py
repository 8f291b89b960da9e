"""The paper's experiments as calls: self-sabotage on rendezvous (its first table)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.evaluation.sabotage import SabotageResult, leave_event, measure_sabotage, to_dict
from popgen.pipelines.run_batch import run_all
from popgen.population import Population, load_population
from popgen.progress import Reporter
from popgen.reports import sabotage_report
from popgen.reports.charts.chart_style import Pictures
from popgen.reports.charts.path_charts import PathSample, path_grid, path_samples
from popgen.reports.method_titles import title_of
from popgen.reports.sabotage_report import TERMINATIONS, build_report, termination_of
from popgen.runs.ledger import Ledger
from popgen.types import Kind, LedgerEntry


@dataclass(frozen=True)
class Source:
    """A finished population and what it is called: a method, or any other name."""

    label: str
    path: Path
    population: Population


@dataclass(frozen=True)
class Measured:
    """A population and who leaves in it.

    Attributes:
        source: what was measured.
        termination: by which an exit is paid in training.
        own: as in training.
        other: rule -> the same play paid by it.
    """

    source: Source
    termination: str
    own: SabotageResult
    other: Mapping[str, SabotageResult]

    @property
    def name(self) -> str:
        """On tables."""
        return title_of(self.source.label)

    @property
    def file(self) -> str:
        """Part of the names of its files."""
        seed = self.source.population.manifest.seed
        parts = (re.sub(r"[/:]", "_", self.source.label), self.termination, f"s{seed}")
        return "-".join(part for part in parts if part)


def open_sources(named: Sequence[tuple[str, str | Path]]) -> list[Source]:
    """Load populations, given as their own folders or as those of their runs, and check that they can be measured.

    Raises:
        UserError: no population, one without members, one of an environment that players cannot leave, environments
            that differ in more than how an exit is paid, or one population twice.
    """
    sources: list[Source] = []
    for label, path in named:
        folder = Path(path)
        population = load_population(folder)
        leave_event(population.spec)
        if not len(population):
            raise UserError(str(path), "has no members yet", "train at least one first")
        source = Source(label, population.path, population)
        _check_alike(sources, source)
        sources.append(source)
    return sources


def _check_alike(sources: Sequence[Source], new: Source) -> None:
    info, seed = new.population.env_info, new.population.manifest.seed
    for known in sources:
        if known.path.resolve() == new.path.resolve():
            raise UserError(str(new.path), "is given twice", "give each population once")
        there = known.population.env_info
        if (new.label, info.params, seed) == (known.label, there.params, known.population.manifest.seed):
            problem = f"is called {new.label} and has seed {seed}, like {known.path}"
            raise UserError(str(new.path), problem, "give them different names")
        names = {*info.params, *there.params} - {"exit_penalty", "exit_reward"}
        different = sorted(name for name in names if info.params.get(name) != there.params.get(name))
        if info.name != there.name or different:
            here = f"{different[0]} is {info.params.get(different[0])}" if different else f"is of {info.name}"
            that = there.params.get(different[0]) if different else there.name
            raise UserError(str(new.path), f"{here}, {known.path} has {that}", "compare populations of one environment")


def self_sabotage(
    sources: Sequence[tuple[str, str | Path]],
    starts: Sequence[tuple[str, RunConfig]],
    out: str | Path,
    *,
    episodes: int,
    seed: int,
    reporter: Reporter,
) -> dict[str, Any]:
    """Train populations or take finished ones, and measure who sabotages whom.

    Args:
        sources: (method or another name, folder of a population or run).
        starts: (method, or method:objective, and the run to start first), see `popgen.pipelines.run_batch`.
        out: folder of the report, its figures and `ledger.jsonl`, which counts the evaluation's steps.
        episodes: per ordered pair of members.
        seed: of the evaluation.
        reporter: told of progress.

    Returns:
        The object of `popgen.reports.sabotage_report` and `files` (paths by name).

    Raises:
        UserError: see `open_sources`; a run that fails; a folder that cannot be written.
    """
    open_sources(sources)
    folders = run_all([config for _, config in starts], reporter=reporter)
    trained = [(label, folder) for (label, _), folder in zip(starts, folders, strict=True)]
    opened = open_sources([*sources, *trained])
    if not opened:
        raise UserError("populations", "there are none to measure", "give --population METHOD=PATH or methods to train")
    reporter.phase("self-sabotage", len(opened))
    measured = []
    for number, source in enumerate(opened, start=1):
        measured.append(measure_source(source, episodes, seed))
        reporter.update(number, population=source.label)
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        steps = _record_steps(folder, measured)
        report = build_report(
            measured[0].own.environment, episodes, seed, steps, [describe_population(one) for one in measured]
        )
        files = _write_texts(folder, report) | _draw_paths(folder, measured)
    except OSError as error:
        raise UserError(str(folder), f"cannot be written: {error.strerror}", "choose another folder") from error
    return report | {"files": {name: str(path) for name, path in files.items()}}


def measure_source(source: Source, episodes: int, seed: int) -> Measured:
    """In the environment of its training, and the same play paid by the other rule."""
    termination = termination_of(source.population.env_info.params)
    own = measure_sabotage(source.population, episodes, seed)
    others = {name: rule for name, rule in TERMINATIONS.items() if termination and name != termination}
    other = {name: measure_sabotage(source.population, episodes, seed, rule) for name, rule in others.items()}
    return Measured(source, termination, own, other)


def _record_steps(folder: Path, measured: Sequence[Measured]) -> int:
    """Enter the evaluation in the experiment's own ledger; every call adds to it. Gives the steps of this call."""
    ledger = Ledger(folder / "ledger.jsonl")
    total = 0
    for one in measured:
        for rule, result in ((one.termination, one.own), *one.other.items()):
            sampler = f"self_sabotage.{one.file}.{rule}" if rule else f"self_sabotage.{one.file}"
            count, size = result.scores.size, result.size
            entry = LedgerEntry(
                folder.name,
                size,
                Kind.EVALUATION,
                sampler,
                len(ledger),
                result.steps,
                count,
                float(result.scores.sum()),
            )
            ledger.record(entry)
            total += result.steps
    ledger.flush()
    return total


def describe_population(one: Measured) -> dict[str, Any]:
    """A row of `popgen.reports.sabotage_report`."""
    manifest, members = one.source.population.manifest, one.source.population.members
    figures = to_dict(one.own)
    results = {one.termination: one.own, **one.other} if one.termination else {}
    paid = {rule: to_dict(result) for rule, result in results.items()}
    kinds = sorted({kind for member in members for kind in member.steps})
    return {
        "method": manifest.method,
        "name": one.name,
        "termination": one.termination,
        "training_seed": manifest.seed,
        "population": str(one.source.path),
        "training_steps": {kind: sum(member.steps.get(kind, 0) for member in members) for kind in kinds},
        **{name: figures[name] for name in ("members", "self_sabotage", "average", "ended_early")},
        **{name: figures[name] for name in ("average_ended_early", "sp", "xp", "landmarks", "matrix", "exits")},
        **{name: figures[name] for name in ("xp_apart", "pairs", "beside")},
        "scored": {rule: {"sp": dues["sp"], "xp": dues["xp"]} for rule, dues in paid.items()},
    }


def _write_texts(folder: Path, report: Mapping[str, Any]) -> dict[str, Path]:
    texts = {
        "self_sabotage.json": sabotage_report.to_json(report),
        "self_sabotage.csv": sabotage_report.members_csv(report),
        "self_sabotage.md": sabotage_report.to_markdown(report),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return {name: folder / name for name in texts}


def _draw_paths(folder: Path, measured: Sequence[Measured]) -> dict[str, Path]:
    """All pairs of each population, and for each rule of termination one pair of each population side by side."""
    pictures = Pictures(folder)
    samples: dict[str, list[PathSample]] = {}
    for one in measured:
        if one.own.paths is None:
            continue
        who = f"{one.name}, seed {one.source.population.manifest.seed}"
        path_grid(one.own.paths, pictures.add(f"paths-{one.file}"), title=f"{who}: one episode of each pair")
        if one.own.size > 1:
            pair = sample_pair(one.own)
            title = f"{who}\nagents {pair[0]} and {pair[1]}"
            samples.setdefault(one.termination, []).append(PathSample(title, one.own.paths, pair))
    for termination, chosen in samples.items():
        path_samples(chosen, pictures.add(f"paths-samples-{termination}" if termination else "paths-samples"))
    return pictures.files


def sample_pair(result: SabotageResult) -> tuple[int, int]:
    """Members in seat 0 and 1 of the cross-play episode to show: the pair in which most leave, the last one if none."""
    size = result.size
    pairs = [(i, j) for i in range(size) for j in range(i)]
    shown = {pair: result.paths.left[pair].any() if result.paths else False for pair in pairs}
    worst = max(pairs, key=lambda pair: (result.exits[pair].any(axis=-1).mean(), shown[pair], pair))
    return worst[0] + 1, worst[1] + 1
