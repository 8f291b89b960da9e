"""The baselines on RLlib: MAPPO self-play, LIPO and CoMeDi (paper, section 2.2), member by member or all together.

A member's iteration is one `train()` of a `popgen.methods.mappo.algorithm.Mappo`. Between two iterations the driver
writes a checkpoint: learner, running episodes, generators, partners' returns, and how long the ledger was.
"""

from __future__ import annotations

import math
import time
from typing import Any

import torch

from popgen.config.run_config import RunConfig
from popgen.config.sections import ClusterConfig
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.methods.mappo.algorithm import Mappo as Algorithm
from popgen.methods.mappo.algorithm import MappoConfig, Report
from popgen.methods.mappo.training_job import Job, policy_config
from popgen.nets.weights import Weights
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.runs.checkpoints import Checkpoints, finished_member, fitting, member_folder
from popgen.runs.recorder import RunRecorder
from popgen.runs.recovery import wait_for_room
from popgen.runs.state_files import save_state
from popgen.types import LedgerEntry

SCORES = ("sp", "xp")
"""Figures of whole episodes, `real_...` in the metrics; an iteration lacks them until some have ended."""


class Baseline:
    """Trains the members of one run, one after the other (`concurrent`: all at once) with one RLlib algorithm each."""

    cross = False  # cross-play with the other members
    mixed = False  # mixed play, and a partner chosen by episodes of its own (CoMeDi)

    def __init__(self, config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> None:
        self.config, self.spec, self.recorder, self.reporter = config, spec, recorder, reporter
        self.checkpoints = Checkpoints(recorder.dir, long=1, seconds=config.run.checkpoint_seconds)
        self.sequence = 0

    @property
    def concurrent(self) -> bool:
        """All members learn together."""
        return self.cross and self.config.diversity.order == "concurrent"

    # ---- the walk ------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Train every member that is not there yet.

        Raises:
            UserError: the machine or the cluster has not what the training needs, or no checkpoint is whole.
        """
        size = self.config.population.size
        first, saved = self._resume()
        while first <= size:
            last = size if self.concurrent else first
            if saved is None:
                self.checkpoints.begin(None)
            # Members that learn together are added together; an interruption may have left some of them to add.
            self._train(tuple(range(self._begin(first), last + 1)), first, saved)
            first, saved = last + 1, None

    def _begin(self, first: int) -> int:
        """The first of the members that learn together with `first`."""
        return 1 if self.concurrent else first

    def job(self, learning: tuple[int, ...]) -> Job:
        """What RLlib is to train."""
        config, frozen = self.config, {}
        if self.cross and learning[0] > 1:
            known = load_population(self.recorder.population.path)
            frozen = {member: known[member].weights() for member in range(1, learning[0])}
        return Job(
            env=config.env,
            ppo=config.ppo,
            diversity=config.diversity if self.cross else None,
            learning=learning,
            seed=config.run.seed * 1000 + learning[0],
            frozen=frozen,
            mixed=self.mixed and config.diversity.lambda_mp > 0.0,
            fresh=self.mixed,
        )

    def _train(self, learning: tuple[int, ...], first: int, saved: dict[str, Any] | None) -> None:
        """Train `learning`, then add its members from `first` on."""
        job, cluster = self.job(learning), self.config.cluster
        check_card(cluster)
        wait_for_room(self.config, self.reporter.note)  # RLlib would wait for ever
        algorithm = MappoConfig.of(job, self.spec, cluster).build_algo()
        try:
            began = time.time()
            if saved is not None:
                with fitting(self.checkpoints.folder):
                    algorithm.resume(saved["algorithm"])
                    self.sequence, began = int(saved["sequence"]), began - float(saved["seconds"])
            names = f"member {learning[0]}" + (f" to {learning[-1]}" if len(learning) > 1 else "")
            self.reporter.phase(f"{names}: {self.config.method}", 1.0)
            if saved is not None:
                self.reporter.note(f"going on after {algorithm.rounds} iterations of {names}")
            while not algorithm.finished:
                algorithm.train()
                self._enter(learning, algorithm)
                if not algorithm.finished and self.checkpoints.due():
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
        report, ppo = algorithm.report, self.config.ppo
        self._count(report)
        for runner in report.lost:
            self.reporter.note(f"runner {runner} was lost: its environments are missing until Ray has restarted it")
        for member in learning:
            figures = report.figures[member]
            steps = sum(self.recorder.training_steps(member).values())
            shown = {f"real_{k}" if k in SCORES else f"ppo/{k}": v for k, v in figures.items()}
            shown["ppo/update_ms"] = 1000.0 * report.seconds["learning"] / (ppo.epochs * ppo.minibatches)
            self.recorder.record_metrics(member, steps, **shown, iteration=algorithm.rounds)
            for name, value in figures.items():
                if not math.isfinite(value):
                    raise FloatingPointError(f"{name} of member {member} is {value} after {steps:,} steps")
        self._tell(learning, algorithm)

    def _count(self, report: Report) -> None:
        for counted in report.counted:
            sampler = f"runner{counted.runner}.{self.recorder.run_id}.{self.recorder.attempt}"
            entry = LedgerEntry(
                self.recorder.run_id,
                counted.owner,
                counted.kind,
                sampler,
                self.sequence,
                counted.steps,
                counted.episodes,
                counted.score,
            )
            self.recorder.ledger.record(entry)
            self.sequence += 1
        self.recorder.ledger.flush()

    def _tell(self, learning: tuple[int, ...], algorithm: Algorithm) -> None:
        scores = [algorithm.scores(member) for member in learning]
        told = {name.upper(): [score[name] for score in scores if name in score] for name in SCORES}
        means = {name: round(sum(values) / len(values), 2) for name, values in told.items() if values}
        steps = sum(sum(self.recorder.training_steps(member).values()) for member in learning)
        self.reporter.update(min(1.0, algorithm.progress), steps=steps, **means)

    # ---- members -------------------------------------------------------------------------------------------------

    def _add(self, member: int, learning: tuple[int, ...], algorithm: Algorithm, seconds: float) -> None:
        """A trained member to the population, its critics beside it."""
        policy = self.policy(algorithm.actors()[member])
        scores = algorithm.scores(member)
        extra = {**scores, "iterations": algorithm.rounds, "seconds": round(seconds / len(learning), 1)}
        critics = {f"critics.{name}": array for name, array in algorithm.critics(member).items()}
        known = {"ledger": len(self.recorder.ledger), "sequence": self.sequence}
        save_state(member_folder(self.recorder.dir, member), known)
        self.recorder.add_member(policy, critics, seed=self.config.run.seed * 1000 + member, extra=extra)
        steps = sum(self.recorder.training_steps(member).values())
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
            "ledger": len(self.recorder.ledger),
            "sequence": self.sequence,
            "seconds": seconds,
        }
        self.checkpoints.save(learning[0], state, dict)
        self.recorder.record_checkpoint(learning[-1], algorithm.rounds)

    def _resume(self) -> tuple[int, dict[str, Any] | None]:
        """The next member to add, and the last checkpoint of its training if there is one; other work is done again."""
        present, saved = len(self.recorder.population), None
        if present < self.config.population.size:
            saved = self.checkpoints.load(self._begin(present + 1))
        if self.checkpoints.note:
            self.reporter.note(self.checkpoints.note)
        done = finished_member(self.recorder.dir, present) if present else {}
        self.sequence = int(done.get("sequence", 0))
        self.recorder.rewind_ledger((saved or done).get("ledger", 0), self.reporter.note)
        return present + 1, saved


class Mappo(Baseline):
    """Self-play alone: members that differ by their seeds."""


class Lipo(Baseline):
    """LIPO (Charakorn et al. 2023): self-play less the strongest partner's cross-play, of all partners."""

    cross = True


class CoMeDi(Baseline):
    """CoMeDi (Sarkar et al. 2023): one after the other against frozen predecessors, with mixed play."""

    cross = True
    mixed = True


def check_card(cluster: ClusterConfig) -> None:
    """A learner that asks for a GPU finds one in this process.

    Raises:
        UserError: there is none.
    """
    if cluster.agent_gpus > 0.0 and not torch.cuda.is_available():
        problem = f"{cluster.agent_gpus:g}, but the driver, in whose process the baselines learn, sees no GPU"
        raise UserError("cluster.agent_gpus", problem, "set it to 0, or start the driver where there is one")
