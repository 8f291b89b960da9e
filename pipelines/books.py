"""What a run leaves behind: its folder, ledger, metrics, MLflow runs, population and checkpoints."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from actors.sampler import Collected
from actors.tracker import RemoteTracker
from popgen.config import RunConfig
from popgen.data.ledger import Ledger
from popgen.envs.base import EnvSpec
from popgen.errors import UserError
from popgen.nets.weights import Weights
from popgen.policies.base import Policy
from popgen.population import PopulationWriter, load_population
from popgen.population.manifest import MemberInfo
from popgen.types import Kind, LedgerEntry


class Books:
    """One run's records. Everything is on disk when `close` returns, and enough of it to go on before that."""

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        self.config, self.spec = config, spec
        stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        variant = Path(config.env.name).stem
        self.run_id = config.run.id or f"{config.method}-{variant}-s{config.run.seed}-{stamp}"
        self.dir = Path(config.run.root) / self.run_id
        self.dir.mkdir(parents=True, exist_ok=True)
        self.began = time.time()
        self._check_same_config()
        self.attempt = self._next_attempt()
        self._mend_metrics()
        self.ledger = Ledger(self.dir / "ledger.jsonl")
        self.population = PopulationWriter(
            self.dir / "population",
            spec,
            method=config.method,
            config_digest=config.digest(),
            seed=config.run.seed,
            resume=True,
        )
        params = config.relevant()
        self.tracker = RemoteTracker(config.tracking, self.dir, self.run_id, params, self._resumed())

    def _check_same_config(self) -> None:
        path = self.dir / "config.json"
        if path.exists():
            try:
                known = RunConfig.parse(json.loads(path.read_text()))
            except ValueError as error:  # damaged, or of a version with other fields
                raise UserError("run.id", f"cannot go on with {path} ({error})", "choose another id") from None
            if known.digest() != self.config.digest():
                raise UserError("run.id", f"{self.run_id} exists with another config", "choose another id")
        _replace(path, json.dumps(self.config.relevant(), indent=1))

    def _next_attempt(self) -> int:
        path = self.dir / "attempts.txt"
        attempt = 1 + (len(path.read_text().splitlines()) if path.exists() else 0)
        with path.open("a") as file:
            file.write(datetime.now(UTC).isoformat() + "\n")
        return attempt

    def _resumed(self) -> dict[str, Any] | None:
        path = self.dir / "tracking.json"
        return json.loads(path.read_text()) if path.exists() else None

    def _mend_metrics(self) -> None:
        """A process that died while it wrote a point leaves half a line."""
        path = self.dir / "metrics.jsonl"
        data = path.read_bytes() if path.exists() else b""
        if data and not data.endswith(b"\n"):
            os.truncate(path, data.rfind(b"\n") + 1)

    def record(self, member: int, collected: Collected) -> None:
        """Enter a round of sampling: one ledger entry per segment."""
        teams = Counter((e.kind, e.members) for e in collected.episodes)
        scores: Counter[tuple[Kind, tuple[int, int]]] = Counter()
        for episode in collected.episodes:
            scores[episode.kind, episode.members] += episode.score
        for kind, members, sequence, steps in collected.counts:
            key = (kind, members)
            entry = LedgerEntry(
                self.run_id, member, kind, collected.sampler, sequence, steps, teams[key], float(scores[key])
            )
            self.ledger.record(entry)
        self.ledger.flush()

    def record_steps(self, member: int, kind: Kind, name: str, sequence: int, steps: int, episodes: int) -> None:
        """Enter steps that no sampler actor took, such as the final evaluation."""
        self.ledger.record(LedgerEntry(self.run_id, member, kind, name, sequence, steps, episodes, 0.0))
        self.ledger.flush()

    def training_steps(self, member: int) -> dict[str, int]:
        """This member's environment steps by kind, evaluation aside."""
        kinds = (Kind.RANDOM, Kind.SP, Kind.XP, Kind.MP)
        return {str(kind): steps for kind in kinds if (steps := self.ledger.steps(member=member, kind=kind))}

    def log(self, member: int, step: int, **figures: float) -> None:
        """One point of all given metrics, in metrics.jsonl and MLflow."""
        row = {"member": member, "step": step, "seconds": round(time.time() - self.began, 2)}
        with (self.dir / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(row | {k: _rounded(v) for k, v in figures.items()}) + "\n")
        self.tracker.log(figures, step=step, member=member)

    def add_member(self, policy: Policy, training: Weights | None, *, seed: int, extra: dict[str, Any]) -> None:
        """Save the next member, with its steps so far, and enter it in the scaling figure."""
        member = len(self.population) + 1
        self.population.add_member(policy, seed=seed, steps=self.training_steps(member), training=training, extra=extra)
        self.tracker.log_scaling(member, sum(self.member_steps()))
        self.save_tracking()

    def member_steps(self) -> list[int]:
        """Environment steps that each member's training took, those of another run included."""
        return [info.total_steps for info in load_population(self.population.path).members]

    def save_tracking(self) -> None:
        """Keep the MLflow run ids: a resumed run goes on in the same MLflow runs."""
        _replace(self.dir / "tracking.json", json.dumps(self.tracker.flush()))

    def adopt(self, policy: Policy, info: MemberInfo, training: Weights | None) -> None:
        """Copy a member of another run; its steps stay in that run's ledger and in the member's record."""
        self.population.add_member(policy, seed=info.seed, steps=info.steps, training=training, extra=info.extra)

    def close(self, status: str) -> None:
        """Everything to disk; status is MLflow's FINISHED, FAILED or KILLED."""
        self.ledger.flush()
        self.tracker.finish(status)


def _replace(path: Path, text: str) -> None:
    """The old contents or the new, whatever interrupts it."""
    fresh = path.with_name(path.name + ".writing")
    fresh.write_text(text)
    fresh.replace(path)


def _rounded(value: float) -> float | None:
    return round(float(value), 5) if np.isfinite(value) else None
