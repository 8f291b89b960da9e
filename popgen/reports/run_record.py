"""What a finished run's folder says about itself: its settings, members, steps, times, learning curves and scores.

Read from `config.json`, `population/`, `ledger.jsonl`, `metrics.jsonl` and `report/crossplay.json`; nothing is written.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.population import load_population
from popgen.population.manifest import EnvironmentInfo, MemberInfo
from popgen.population.member_pairs import find_mates
from popgen.reports.crossplay_report import restate_pairs
from popgen.reports.training_curves import Point, read_curves, read_lines
from popgen.reports.weak_members import is_unfinished, list_weak_members
from popgen.runs.ledger import Ledger, LedgerConflict
from popgen.types import Kind, LedgerEntry

REAL = (Kind.RANDOM, Kind.SP, Kind.XP, Kind.MP)
"""Kinds of real environment steps that training takes; they make up a total. Simulated steps and those of evaluations
stand beside it and are never added to it."""

_FREE = ("run.", "cluster.", "tracking.", "population.", "evaluation.", "scale")
"""Settings in which runs may differ and still be seeds of one and the same thing."""


@dataclass(frozen=True)
class MemberRecord:
    """What one member took.

    Attributes:
        member: from 1.
        steps: environment steps by kind, evaluations aside; `simulated` ones of an exact model among them.
        seconds: of its training, None where it was not kept.
        adopted: taken over from another run, with that run's figures.
        curve: real play during training; empty where it was not kept.
    """

    member: int
    steps: Mapping[str, int]
    seconds: float | None
    adopted: bool
    curve: tuple[Point, ...]

    @property
    def real(self) -> int:
        """Real environment steps of all kinds."""
        return sum(self.steps.get(str(kind), 0) for kind in REAL)


@dataclass(frozen=True)
class RunRecord:
    """A finished run.

    Attributes:
        path, run_id: of its folder.
        label: what it is called in comparisons; the method unless another name was given.
        method, seed, scale: as configured.
        environment: as in the population's manifest.
        settings: dotted name -> value of all that decides the result, seed, sizes and places aside.
        members: in order.
        evaluation_steps: of its own evaluations.
        lost_steps: of interrupted work that was done again; in none of the members' figures.
        attempts: how often it was started; above 1 it was interrupted, and `seconds` miss what was lost.
        scores: `report/crossplay.json`, see `popgen.reports.crossplay_report`; of an older version with what it says
            of pairs put right.
        weak_members: a line for each member that does not play, see `popgen.reports.weak_members`.
        unfinished: members that are kept for their lower skill.
    """

    path: Path
    run_id: str
    label: str
    method: str
    seed: int
    scale: str
    environment: EnvironmentInfo
    settings: Mapping[str, Any]
    members: tuple[MemberRecord, ...]
    evaluation_steps: int
    lost_steps: int
    attempts: int
    scores: Mapping[str, Any]
    weak_members: tuple[str, ...] = ()
    unfinished: tuple[int, ...] = ()


def read_run(path: str | Path, label: str | None = None) -> RunRecord:
    """Read a finished run's folder, or that of its population.

    Raises:
        UserError: no run, one that is not finished, or one whose files are damaged or contradict each other.
    """
    path = _find_run(Path(path))
    config = _read_config(path)
    population = load_population(path / "population")
    wanted = int(config["population"]["size"])
    fix = f"finish it with `popgen run` and run.id={path.name}"
    if len(population) < wanted:
        raise UserError(str(path), f"is unfinished: it has {len(population)} of {wanted} members", fix)
    scores = _read_scores(path, fix, find_mates(population.members))
    ledger = read_ledger(path / "ledger.jsonl")
    curves = read_curves(path / "metrics.jsonl")
    origin, adopted = config["population"].get("init_from"), 0
    if origin:
        adopted = int(config["population"].get("init_members", 0))
        curves |= {member: curve for member, curve in _read_origin_curves(Path(origin)).items() if member <= adopted}
    return RunRecord(
        path=path,
        run_id=path.name,
        label=label or config["method"],
        method=config["method"],
        seed=int(config["run"]["seed"]),
        scale=str(config["scale"]),
        environment=population.env_info,
        settings=_decisive_settings(config),
        members=tuple(_record_member(path, info, ledger, curves, info.id <= adopted) for info in population.members),
        evaluation_steps=ledger.steps(kind=Kind.EVALUATION),
        lost_steps=_count_lost_steps(path / "ledger.lost.jsonl"),
        attempts=_count_attempts(path / "attempts.txt"),
        scores=scores,
        weak_members=_describe_weak_members(config, population.members, scores),
        unfinished=tuple(info.id for info in population.members if is_unfinished(info)),
    )


def _describe_weak_members(
    config: Mapping[str, Any], infos: Sequence[MemberInfo], scores: Mapping[str, Any]
) -> tuple[str, ...]:
    share = float(config.get("evaluation", {}).get("weak_share", 0.0))
    return tuple(one.describe(scores["unit"]) for one in list_weak_members(infos, scores, share))


def _find_run(path: Path) -> Path:
    """The run that a population lies in; other paths as they are."""
    if (path / "manifest.json").is_file() and (path.resolve().parent / "config.json").is_file():
        return path.parent if path.name == "population" else path.resolve().parent
    return path


def planned_run(config: RunConfig, label: str | None = None) -> RunRecord:
    """What is known of a run before it starts: enough to see what it can be compared with; it has no members."""
    spec = make_env(config.env.name, 1, **config.env.params).spec
    return RunRecord(
        path=Path(config.run.root) / str(config.run.id),
        run_id=str(config.run.id),
        label=label or config.method,
        method=config.method,
        seed=config.run.seed,
        scale=config.scale,
        environment=EnvironmentInfo.of(spec),
        settings=_decisive_settings(config.as_dict()),
        members=(),
        evaluation_steps=0,
        lost_steps=0,
        attempts=0,
        scores={},
    )


def is_finished(path: str | Path) -> bool:
    """Whether `read_run` would take this folder."""
    try:
        read_run(path)
    except UserError:
        return False
    return True


def read_ledger(path: Path) -> Ledger:
    """A ledger in memory; other than `Ledger(path)`, this leaves the file as it is.

    Raises:
        UserError: the file is missing, holds anything else, or contradicts itself.
    """
    ledger = Ledger()
    for number, line in enumerate(read_lines(path), start=1):
        try:
            ledger.record(LedgerEntry(**json.loads(line)))
        except (ValueError, TypeError, LedgerConflict) as error:
            problem = f"line {number} is no ledger entry ({error})"
            raise UserError(str(path), problem, "restore the file from a copy") from None
    return ledger


def differences(first: RunRecord, second: RunRecord) -> list[str]:
    """Dotted names of the settings in which two runs differ, `run.seed` and places aside."""
    names = sorted({*first.settings, *second.settings})
    return [name for name in names if first.settings.get(name) != second.settings.get(name)]


def _read_config(path: Path) -> dict[str, Any]:
    file = path / "config.json"
    fix = "give a folder that `popgen run` wrote"
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(str(path), f"is no run: it has no {file.name}", fix) from None
    except (OSError, ValueError) as error:
        raise UserError(str(file), f"cannot be read ({error})", fix) from None
    try:
        return RunConfig.parse(values).as_dict()  # with the defaults of fields that are younger than the run
    except (UserError, TypeError):
        pass  # of a version with other fields: what is needed is the same in all of them
    sections = ("population", "run", "env")
    known = isinstance(values, dict) and all(isinstance(values.get(name), dict) for name in sections)
    if not known or not {"method", "scale"} <= set(values) or "size" not in values["population"]:
        raise UserError(str(file), "is not the configuration of a run", fix)
    return values


def flatten_settings(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted names -> values."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        inner = isinstance(value, Mapping)
        found |= flatten_settings(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return found


def _decisive_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that decides the result, flat; the environment is compared by its fingerprint."""
    settings = flatten_settings(config)
    return {name: value for name, value in settings.items() if not name.startswith((*_FREE, "env."))}


def _read_scores(path: Path, fix: str, mates: Sequence[int]) -> dict[str, Any]:
    file = path / "report" / "crossplay.json"
    try:
        scores = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(str(path), "is unfinished: its members were not evaluated", fix) from None
    except (OSError, ValueError) as error:
        raise UserError(str(file), f"cannot be read ({error})", fix) from None
    if not isinstance(scores, dict) or scores.get("format") != "popgen-crossplay":
        raise UserError(str(file), "is no report of an evaluation", fix)
    return restate_pairs(scores, mates)


def _record_member(
    path: Path, info: MemberInfo, ledger: Ledger, curves: Mapping[int, tuple[Point, ...]], adopted: bool
) -> MemberRecord:
    """A member's figures: of its own run's ledger, or of its record where another run trained it."""
    counted = {
        str(kind): steps for kind in (*REAL, Kind.SIMULATED) if (steps := ledger.steps(member=info.id, kind=kind))
    }
    if adopted:
        counted = {kind: steps for kind, steps in info.steps.items() if kind != Kind.EVALUATION}
    for kind in REAL:
        told, found = info.steps.get(str(kind), 0), counted.get(str(kind), 0)
        if told != found:
            problem = f"counts {found:,} {kind} steps for member {info.id}, member.json {told:,}"
            raise UserError(str(path / "ledger.jsonl"), problem, "restore the run from a good copy")
    seconds = info.extra.get("seconds")
    return MemberRecord(
        member=info.id,
        steps=counted,
        seconds=float(seconds) if isinstance(seconds, int | float) else None,
        adopted=adopted,
        curve=curves.get(info.id, ()),
    )


def _read_origin_curves(origin: Path) -> dict[int, tuple[Point, ...]]:
    """Of the run that members were taken over from, where it is still there."""
    try:
        return read_curves(origin / "metrics.jsonl")
    except (UserError, OSError):
        return {}


def _count_lost_steps(path: Path) -> int:
    """Steps of training set aside by resumed runs; a repeated evaluation is set aside there too."""
    if not path.exists():
        return 0
    total = 0
    for line in read_lines(path):
        try:
            entry = json.loads(line)
            total += int(entry["steps"]) if entry["kind"] != Kind.EVALUATION else 0
        except (ValueError, TypeError, KeyError) as error:
            raise UserError(str(path), f"holds something else than ledger entries ({error})", "restore it") from None
    return total


def _count_attempts(path: Path) -> int:
    return len(read_lines(path)) if path.exists() else 1
