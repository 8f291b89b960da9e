"""The baselines on RLlib: MAPPO self-play, LIPO and CoMeDi (paper, section 2.2), member by member or all together.

A member's iteration is one `train()` of a `popgen.rllib.algorithm.Mappo`. Between two iterations the driver writes a
checkpoint: learner, running episodes, generators, partners' returns, and how long the ledger was.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from pipelines.books import Books
from popgen.config import RunConfig
from popgen.data.checkpoint import load_state, save_state
from popgen.envs.base import EnvSpec
from popgen.nets.weights import Weights
from popgen.policies.feed_forward import FeedForwardPolicy
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.rllib.algorithm import Mappo as Algorithm
from popgen.rllib.algorithm import MappoConfig, Report
from popgen.rllib.job import Job, policy_config
from popgen.types import LedgerEntry

NEVER_GIVEN = ("sp", "xp")
"""Figures that an iteration may lack, since no episode has ended."""


class Baseline:
    """Trains the members of one run, one after the other (`concurrent`: all at once) with one RLlib algorithm each."""

    cross = False  # cross-play with the other members
    mixed = False  # mixed play, and a partner chosen by episodes of its own (CoMeDi)

    def __init__(self, config: RunConfig, spec: EnvSpec, books: Books, reporter: Reporter) -> None:
        self.config, self.spec, self.books, self.reporter = config, spec, books, reporter
        self.folder = books.dir / "checkpoints"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.saved = time.monotonic()
        self.sequence = 0

    @property
    def concurrent(self) -> bool:
        """All members learn together."""
        return self.cross and self.config.diversity.order == "concurrent"

    # ---- the walk ------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Train every member that is not there yet."""
        size = self.config.population.size
        first, saved = self._resume()
        while first <= size:
            last = size if self.concurrent else first
            # Members that learn together are added together; an interruption may have left some of them to add.
            begin = 1 if self.concurrent else first
            self._train(tuple(range(begin, last + 1)), first, saved)
            first, saved = last + 1, None

    def job(self, learning: tuple[int, ...]) -> Job:
        """What RLlib is to train."""
        config, frozen = self.config, {}
        if self.cross and learning[0] > 1:
            known = load_population(self.books.population.path)
            frozen = {member: known[member].weights() for member in range(1, learning[0])}
        return Job(
            env=config.env,
            ppo=config.ppo,
            diversity=config.diversity if self.cross else None,
            learning=learning,
            seed=config.run.seed * 1000 + learning[0],
            frozen=frozen,
            mixed=self.mixed,
            fresh=self.mixed,
        )

    def _train(self, learning: tuple[int, ...], first: int, saved: dict[str, Any] | None) -> None:
        """Train `learning`, then add its members from `first` on."""
        algorithm = MappoConfig.of(self.job(learning), self.spec, self.config.cluster).build_algo()
        try:
            began = time.time()
            if saved is not None:
                algorithm.resume(saved["algorithm"])
                self.sequence, began = int(saved["sequence"]), began - float(saved["seconds"])
            names = f"member {learning[0]}" + (f" to {learning[-1]}" if len(learning) > 1 else "")
            self.reporter.phase(f"{names}: {self.config.method}", 1.0)
            if saved is not None:
                self.reporter.note(f"going on after {algorithm.rounds} iterations of {names}")
            while not algorithm.finished:
                algorithm.train()
                self._enter(learning, algorithm)
                if not algorithm.finished and time.monotonic() - self.saved >= self.config.run.checkpoint_seconds:
                    self._save(learning, algorithm, time.time() - began)
            self._save(learning, algorithm, time.time() - began)
            for member in range(first, learning[-1] + 1):
                self._add(member, learning, algorithm, time.time() - began)
        finally:
            algorithm.stop()

    def _enter(self, learning: tuple[int, ...], algorithm: Algorithm) -> None:
        """An iteration's steps to the ledger, its figures to the metrics.

        Raises:
            FloatingPointError: a figure is not finite: the networks will not recover.
        """
        report = algorithm.report
        self._count(report)
        for member in learning:
            figures = report.figures[member]
            steps = sum(self.books.training_steps(member).values())
            shown = {f"real_{k}" if k in NEVER_GIVEN else f"ppo/{k}": v for k, v in figures.items()}
            self.books.log(member, steps, **shown, iteration=algorithm.rounds)
            for name, value in figures.items():
                if not math.isfinite(value):
                    raise FloatingPointError(f"{name} of member {member} is {value} after {steps:,} steps")
        self._tell(learning, algorithm)

    def _count(self, report: Report) -> None:
        for counted in report.counted:
            sampler = f"runner{counted.runner}.{self.books.run_id}.{self.books.attempt}"
            entry = LedgerEntry(
                self.books.run_id,
                counted.owner,
                counted.kind,
                sampler,
                self.sequence,
                counted.steps,
                counted.episodes,
                counted.score,
            )
            self.books.ledger.record(entry)
            self.sequence += 1
        self.books.ledger.flush()

    def _tell(self, learning: tuple[int, ...], algorithm: Algorithm) -> None:
        scores = [algorithm.scores(member) for member in learning]
        told = {name.upper(): [score[name] for score in scores if name in score] for name in NEVER_GIVEN}
        means = {name: round(sum(values) / len(values), 2) for name, values in told.items() if values}
        steps = sum(sum(self.books.training_steps(member).values()) for member in learning)
        self.reporter.update(min(1.0, algorithm.progress), steps=steps, **means)

    # ---- members -------------------------------------------------------------------------------------------------

    def _add(self, member: int, learning: tuple[int, ...], algorithm: Algorithm, seconds: float) -> None:
        """A trained member to the population, its critics beside it."""
        policy = self.policy(algorithm.actors()[member])
        scores = algorithm.scores(member)
        extra = {**scores, "iterations": algorithm.rounds, "seconds": round(seconds / len(learning), 1)}
        critics = {f"critics.{name}": array for name, array in algorithm.critics(member).items()}
        save_state(self._member(member), {"ledger": len(self.books.ledger), "sequence": self.sequence})
        self.books.add_member(policy, critics, seed=self.config.run.seed * 1000 + member, extra=extra)
        steps = sum(self.books.training_steps(member).values())
        told = ", ".join(f"{name.upper()} {value:.2f}" for name, value in scores.items())
        self.reporter.note(
            f"member {member}: {told} {self.spec.score_name} in training, {steps:,} environment steps, "
            f"{seconds / 60:.1f} min"
        )

    def policy(self, weights: Weights) -> FeedForwardPolicy:
        """A member as it is saved: the actor alone."""
        return FeedForwardPolicy.from_parts(policy_config(self.config.ppo), weights, self.spec)

    # ---- resume --------------------------------------------------------------------------------------------------

    def _save(self, learning: tuple[int, ...], algorithm: Algorithm, seconds: float) -> None:
        state = {
            "learning": list(learning),
            "algorithm": algorithm.snapshot(),
            "ledger": len(self.books.ledger),
            "sequence": self.sequence,
            "seconds": seconds,
        }
        save_state(self._progress, state)
        self.saved = time.monotonic()
        self.books.checkpointed(learning[-1], algorithm.rounds)

    def _resume(self) -> tuple[int, dict[str, Any] | None]:
        """The next member to add, and the checkpoint of its training if there is one."""
        present = len(self.books.population)
        saved = load_state(self._progress) if self._written(self._progress) else None
        if saved is not None and present + 1 not in saved["learning"]:
            saved = None
        if saved is not None:
            self._forget(saved["ledger"])
        elif present:
            done = load_state(self._member(present))
            self._forget(done["ledger"])
            self.sequence = int(done["sequence"])
        else:
            self._forget(0)
        return present + 1, saved

    def _forget(self, entries: int) -> None:
        """Work that no checkpoint holds will be done again: its steps leave the ledger."""
        if lost := self.books.ledger.cut(entries):
            self.reporter.note(f"{lost} ledger entries without a checkpoint are set aside: their work is done again")

    @property
    def _progress(self) -> Path:
        return self.folder / "progress"

    def _member(self, member: int) -> Path:
        return self.folder / f"member_{member:03d}"

    @staticmethod
    def _written(folder: Path) -> bool:
        return folder.exists() or folder.with_name(folder.name + ".old").exists()


class Mappo(Baseline):
    """Self-play alone: members that differ by their seeds."""


class Lipo(Baseline):
    """LIPO (Charakorn et al. 2023): self-play less the strongest partner's cross-play, of all partners."""

    cross = True


class CoMeDi(Baseline):
    """CoMeDi (Sarkar et al. 2023): one after the other against frozen predecessors, with mixed play."""

    cross = True
    mixed = True
