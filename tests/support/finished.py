"""Folders of finished runs with chosen figures, made by the library's own writers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.config.run_config import RunConfig
from popgen.envs import EnvSpec, make_env
from popgen.evaluation.crossplay import evaluate_population
from popgen.policies.simple_policies import RandomPolicy
from popgen.population import PopulationWriter, load_population
from popgen.reports.crossplay_report import to_dict
from popgen.runs.ledger import Ledger
from popgen.types import Kind, LedgerEntry

CRAMPED = "overcooked/cramped_room"
Curve = Sequence[tuple[int, float, float | None]]


def finished_run(
    root: Path,
    name: str,
    steps: Sequence[Mapping[str, int]],
    *,
    method: str = "xpm_wm",
    seed: int = 0,
    seconds: Sequence[float | None] | None = None,
    curves: Mapping[int, Curve] | None = None,
    env: str = CRAMPED,
    params: Mapping[str, Any] | None = None,
    scores: tuple[float, float | None] = (10.0, 0.5),
    settings: Mapping[str, Any] | None = None,
    extras: Sequence[Mapping[str, Any]] | None = None,
) -> Path:
    """A run of random players.

    Args:
        steps: of each member, by kind.
        seconds: of each member's training, 60 if not given.
        curves: member -> (step, real self-play, strongest real cross-play).
        params: of the environment.
        scores: SP and XP of its report.
        settings: further sections of its config.
        extras: of the members, on top of their times.
    """
    folder = root / name
    horizon = {"horizon": 20} if env.startswith("overcooked") else {}
    values = {
        "method": method,
        "env": {"name": env, "params": {**horizon, **(params or {})}},
        "population": {"size": len(steps)},
        "run": {"id": name, "root": str(root), "seed": seed},
        **(settings or {}),
    }
    config = RunConfig.parse(values)
    spec = make_env(config.env.name, 1, **config.env.params).spec
    writer = _start_run(folder, config, spec)
    ledger = Ledger(folder / "ledger.jsonl")
    times = seconds or [60.0] * len(steps)
    for member, (taken, time, more) in enumerate(zip(steps, times, extras or [{}] * len(steps), strict=True), start=1):
        _record_steps(ledger, name, member, taken)
        recorded = {kind: count for kind, count in taken.items() if kind != "simulated"}
        extra = {**more} if time is None else {"seconds": time, **more}
        writer.add_member(RandomPolicy(spec.num_actions), seed=member, steps=recorded, extra=extra)
    ledger.record(LedgerEntry(name, len(steps), Kind.EVALUATION, "evaluation", 0, 77, 1, 0.0))
    ledger.flush()
    _write_metrics(folder, curves or {})
    write_scores(folder, *scores)
    return folder


def _start_run(folder: Path, config: RunConfig, spec: EnvSpec) -> PopulationWriter:
    identity = {"method": config.method, "config_digest": config.digest(), "seed": config.run.seed}
    writer = PopulationWriter(folder / "population", spec, **identity, resume=True)
    (folder / "config.json").write_text(json.dumps(config.as_dict()))
    (folder / "attempts.txt").write_text("2026-01-01\n")
    return writer


def _record_steps(ledger: Ledger, name: str, member: int, taken: Mapping[str, int]) -> None:
    """Two entries of each kind."""
    for number, (kind, count) in enumerate(taken.items()):
        for part, half in enumerate((count // 2, count - count // 2)):
            ledger.record(LedgerEntry(name, member, Kind(kind), "sampler", 2 * number + part, half, 0, 0.0))


def _write_metrics(folder: Path, curves: Mapping[int, Curve]) -> None:
    rows: list[dict[str, Any]] = [{"member": 1, "step": 0, "seconds": 0.0, "model/kl": 1.0}]
    for member, curve in curves.items():
        for step, sp, xp in curve:
            row = {"member": member, "step": step, "seconds": 1.0, "real_sp": sp}
            rows.append(row if xp is None else row | {"real_xp_max": xp})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def write_scores(folder: Path, sp: float, xp: float | None) -> None:
    """The report of an evaluation, with these means."""
    report = to_dict(evaluate_population(load_population(folder / "population"), 1, 0))
    report["sp"]["mean"], report["xp"]["mean"] = sp, xp
    (folder / "report").mkdir(exist_ok=True)
    (folder / "report" / "crossplay.json").write_text(json.dumps(report))
