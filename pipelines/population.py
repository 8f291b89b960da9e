"""The main job: an XPM-WM population, member after member (paper, algorithm 1 and section 4.2)."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ray

from actors.common import build_env
from actors.sampler import Collected, PolicyParts
from pipelines.books import Books
from pipelines.crew import Crew, start_ray
from pipelines.report import write_run_figures
from pipelines.rounds import run_rounds
from popgen.config import RunConfig
from popgen.data.checkpoint import load_state, save_state
from popgen.data.sampler import Episode, Team
from popgen.envs.base import EnvSpec
from popgen.evaluation.crossplay import evaluate_population
from popgen.evaluation.report import to_dict, write_report
from popgen.nets.weights import Weights, under
from popgen.policies.simple import RandomPolicy
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.types import RANDOM_MEMBER, Kind

SP_KINDS = (str(Kind.SP), str(Kind.RANDOM))
XP_KINDS = (str(Kind.XP),)
PREFILL_CHUNK = 400


@dataclass(frozen=True)
class Snapshot:
    """A policy as it played some real episodes: its weights and what it scored."""

    acting: Weights
    sp: float
    xp: float

    @property
    def merit(self) -> float:
        """Self-play less the strongest cross-play: what a member is chosen by."""
        return self.sp - self.xp


def run_population(config: RunConfig, *, reporter: Reporter) -> dict[str, Any]:
    """Train a population and evaluate it.

    Args:
        config: a validated run.
        reporter: told of progress.

    Returns:
        run_id, run_dir, population (path), members (count), ledger (steps by member and kind), matrix and evaluation
        (`popgen.evaluation.report`), files (report paths by suffix), seconds.
    """
    spec = build_env(config.env, 1).spec
    books = Books(config, spec)
    reporter.note(f"run {books.run_id} in {books.dir}")
    mine, status = False, "FAILED"
    try:
        mine = start_ray(config.cluster)
        books.tracker.start()
        books.save_tracking()
        driver = Driver(config, spec, books, reporter)
        driver.run()
        result = driver.finish()
        status = "FINISHED"
        return result
    except KeyboardInterrupt:
        status = "KILLED"
        raise
    finally:
        books.close(status)
        if mine:
            ray.shutdown()


class Driver:
    """Walks through the members; holds what they hand on to each other."""

    def __init__(self, config: RunConfig, spec: EnvSpec, books: Books, reporter: Reporter) -> None:
        self.config, self.spec, self.books, self.reporter = config, spec, books, reporter
        self.crew = Crew.hire(config, f"{books.run_id}.{books.attempt}")
        self.members: dict[int, Weights] = {}
        self.steps = 0
        self.began = time.time()

    # ---- the walk ------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Train every member that is not there yet."""
        try:
            for member in range(self._resume(), self.config.population.size + 1):
                began, self.steps = time.time(), 0
                seed = self.config.run.seed * 1000 + member
                snapshot = self.train_first(seed) if member == 1 else self.train_later(member, seed)
                self._complete(member, seed, snapshot, time.time() - began)
        finally:
            self.crew.dismiss()

    def _complete(self, member: int, seed: int, snapshot: Snapshot, seconds: float) -> None:
        """Add the member to the population, keep the buffers and the model, enter it in the books."""
        model, critics = ray.get([self.crew.model.weights.remote(), self.crew.agent.critics.remote()])
        training = {f"model.{k}": v for k, v in model.items() if not k.startswith("filter.")}
        training |= {f"critics.{k}": v for k, v in critics.items()}
        report = ray.get(self.crew.model.report.remote())
        extra = {"sp": snapshot.sp, "xp": snapshot.xp, "seconds": round(seconds, 1), "world_model": report}
        self.books.log(member, self.steps, final_sp=snapshot.sp, final_xp=snapshot.xp, **report)
        self._save_checkpoint(member)
        self.books.add_member(snapshot.acting, training, seed=seed, member=member, extra=extra)
        self.members[member] = snapshot.acting
        steps = sum(self.books.training_steps(member).values())
        self.reporter.note(
            f"member {member}: SP {snapshot.sp:.2f}, XP {snapshot.xp:.2f} {self.spec.score_name} in training, "
            f"{steps:,} environment steps, {seconds / 60:.1f} min"
        )

    # ---- member 1 ------------------------------------------------------------------------------------------------

    def train_first(self, seed: int) -> Snapshot:
        """Phase 1: the world model and a self-play agent together."""
        phase, crew = self.config.phase1, self.crew
        self._prefill(seed)
        self.reporter.phase("member 1: world model on random play", phase.pretrain_updates)
        model, starts = self._train_model(phase.pretrain_updates)
        ray.get(crew.agent.begin_member.remote(1, seed, {}))
        acting_ref, info = crew.agent.train.options(num_returns=2).remote(phase.agent_updates, model, starts, 0.0, {})
        loop = FirstMember(self, model, starts, acting_ref, seed)
        run_rounds(loop.work(), stop=loop.stop, after=loop.after, schedule=self.config.run.schedule)
        return loop.best()

    def _prefill(self, seed: int) -> None:
        """K random episodes (algorithm 1)."""
        phase, sampler = self.config.phase1, self.crew.samplers[0]
        self.reporter.phase("member 1: random play", phase.prefill_steps)
        interact = phase.prefill_interact
        names = self.spec.action_names
        probabilities = None
        if interact and "interact" in names:
            rest = (1.0 - interact) / (len(names) - 1)
            probabilities = [interact if name == "interact" else rest for name in names]
        random = RandomPolicy(self.spec.num_actions, probabilities)
        parts = {RANDOM_MEMBER: PolicyParts(random.kind, random.config(), {})}
        team = Team(Kind.RANDOM, (RANDOM_MEMBER, RANDOM_MEMBER), phase.envs)
        ray.get(sampler.open.remote([team], parts, seed, False))
        while self.steps < phase.prefill_steps:
            missing = (phase.prefill_steps - self.steps) // phase.envs
            segments, collected = self._collect(sampler, max(1, min(PREFILL_CHUNK, missing)))
            self._absorb(1, segments, collected)
            self.reporter.update(self.steps, steps=self.steps)

    def _collect(self, sampler: Any, steps: int, load: Any = None) -> tuple[Any, Collected]:
        segments, collected = sampler.collect.options(num_returns=2).remote(steps, load)
        return segments, ray.get(collected)

    def _absorb(self, member: int, segments: Any, collected: Collected) -> None:
        """Segments to the buffers by reference, counts to the ledger."""
        crew = self.crew
        ray.get(
            [
                crew.replay_sp.add.remote(segments, member, SP_KINDS),
                crew.replay_xp.add.remote(segments, member, XP_KINDS),
            ]
        )
        self.books.record(member, collected)
        self.steps += sum(steps for *_, steps in collected.counts)

    def _train_model(self, updates: int) -> tuple[Any, Any]:
        """World-model updates alone, in pieces for the progress bar; references to weights and starts."""
        done, per_update = 0, self.config.agent.starts_sp
        while True:
            count = min(100, updates - done)
            model, starts, info = self.crew.model.train.options(num_returns=3).remote(count, per_update)
            metrics = ray.get(info)
            done += count
            self.books.log(1, self.steps, **{f"model/{k}": v for k, v in metrics.items()})
            self.reporter.update(done, model_loss=round(metrics["loss_observation"], 2))
            if done >= updates:
                return model, starts

    # ---- members 2..M --------------------------------------------------------------------------------------------

    def train_later(self, member: int, seed: int) -> Snapshot:
        """Phase 2: imagination first, then few rounds of real episodes, fine-tuning and imagination."""
        phase, crew = self.config.phase2, self.crew
        partners = {k: under("actor", weights) for k, weights in self.members.items()}
        filters = {k: under("filter", weights) for k, weights in self.members.items()}
        ray.get(
            [crew.agent.begin_member.remote(member, seed, partners), crew.model.begin_member.remote(member, filters)]
        )
        rounds = self._rounds()
        total = phase.first_updates + (rounds - 1) * phase.updates_per_round
        self.reporter.phase(f"member {member}: imagined self-play and cross-play", total)
        acting = self._imagine(member, phase.first_updates, 0, 0.0, {})
        best: Snapshot | None = None
        for number in range(1, rounds + 1):
            episodes = self._real_episodes(member, acting, seed * 100 + number)
            snapshot, scores = self._judge(member, acting, episodes, number)
            if best is None or snapshot.merit > best.merit:
                best = snapshot
            if number < rounds:
                *_, info = crew.model.train.options(num_returns=3).remote(phase.model_updates, 0)
                self.books.log(member, self.steps, **{f"model/{k}": v for k, v in ray.get(info).items()})
                done = phase.first_updates + (number - 1) * phase.updates_per_round
                acting = self._imagine(member, phase.updates_per_round, done, phase.starts_new, scores)
        assert best is not None
        return best

    def _rounds(self) -> int:
        """Rounds of real episodes of a later member: those configured, fewer where its environment steps end first."""
        phase = self.config.phase2
        each = (phase.episodes_sp + phase.episodes_xp) * self.spec.horizon
        return phase.rounds if phase.max_steps is None else max(1, min(phase.rounds, phase.max_steps // each))

    def _imagine(self, member: int, updates: int, done: int, new_share: float, scores: dict[int, float]) -> Weights:
        """Refresh the start cache, then learn in imagination; the acting weights."""
        crew = self.crew
        starts, model = crew.model.cache_starts.remote(), crew.model.weights.remote()
        piece = 50
        for first in range(0, updates, piece):
            count = min(piece, updates - first)
            acting, info = crew.agent.train.options(num_returns=2).remote(count, model, starts, new_share, scores)
            metrics = ray.get(info)
            self.books.log(member, self.steps, **{f"agent/{k}": v for k, v in metrics.items()}, updates=done + first)
            self.reporter.update(done + first + count, entropy=round(metrics["entropy"], 2))
        return ray.get(acting)

    def _real_episodes(self, member: int, acting: Weights, seed: int) -> list[Episode]:
        """One episode in each self-play and cross-play environment; partners act with their own archived filters."""
        phase, sampler = self.config.phase2, self.crew.samplers[0]
        teams = [Team(Kind.SP, (member, member), phase.episodes_sp)]
        pairs = [pair for k in sorted(self.members) for pair in ((member, k), (k, member))]
        order = np.random.default_rng(seed).permutation(len(pairs))
        counts = np.bincount(np.arange(phase.episodes_xp) % len(pairs), minlength=len(pairs))
        teams += [Team(Kind.XP, pairs[i], int(n)) for i, n in zip(order, counts, strict=True) if n]
        weights = {**self.members, member: acting}
        present = sorted({m for team in teams for m in team.members})
        ray.get(sampler.open.remote(teams, {m: self._parts(weights[m]) for m in present}, seed, False))
        segments, collected = self._collect(sampler, self.spec.horizon)
        self._absorb(member, segments, collected)
        return collected.episodes

    def _parts(self, weights: Weights) -> PolicyParts:
        config = self.config
        sizes = {
            "world_model": config.world_model.model_dump(mode="json"),
            "agent": config.agent.model_dump(mode="json"),
        }
        return PolicyParts("world_model", sizes, weights)

    def _judge(
        self, member: int, acting: Weights, episodes: list[Episode], number: int
    ) -> tuple[Snapshot, dict[int, float]]:
        """What the real episodes say: a snapshot, and each partner's cross-play return (for the partner choice)."""
        own = [e.score for e in episodes if e.kind is Kind.SP]
        by_partner: dict[int, list[Episode]] = {}
        for episode in episodes:
            if episode.kind is Kind.XP:
                by_partner.setdefault(sum(episode.members) - member, []).append(episode)
        strongest = max(float(np.mean([e.score for e in found])) for found in by_partner.values())
        shaped = [e.shaped for e in episodes if e.kind is Kind.SP]
        snapshot = Snapshot(acting, float(np.mean(own)), strongest)
        self.books.log(
            member,
            self.steps,
            real_sp=snapshot.sp,
            real_xp_max=strongest,
            real_reward_sp=float(np.mean(shaped)) / self.spec.horizon,
            round=number,
        )
        self.reporter.note(
            f"member {member}, round {number}: SP {snapshot.sp:.2f}, strongest XP {strongest:.2f} "
            f"{self.spec.score_name}, {self.steps:,} steps"
        )
        return snapshot, {k: float(np.mean([e.shaped for e in found])) for k, found in by_partner.items()}

    # ---- resume and finish ---------------------------------------------------------------------------------------

    def _checkpoint(self, root: Path, member: int) -> Path:
        return root / "checkpoints" / f"member_{member:03d}"

    def _save_checkpoint(self, member: int) -> None:
        crew = self.crew
        names = ("replay_sp", "replay_xp", "model")
        states = ray.get([getattr(crew, name).state.remote() for name in names])
        save_state(self._checkpoint(self.books.dir, member), dict(zip(names, states, strict=True)))

    def _resume(self) -> int:
        """Take over finished members of this run, or of the run this one continues; the next member to train."""
        present, origin = len(self.books.population), self.config.population
        if origin.init_from and present <= origin.init_members:
            root, known = Path(origin.init_from), origin.init_members
        elif present:
            root, known = self.books.dir, present
        else:
            return 1
        source = load_population(root / "population")
        state = load_state(self._checkpoint(root, known))
        crew = self.crew
        ray.get([getattr(crew, name).load_state.remote(part) for name, part in state.items()])
        for member in range(1, known + 1):
            self.members[member] = source[member].weights()
            if member > present:
                self.books.adopt(source[member], source.info(member), source.training(member))
        self.reporter.note(f"going on after member {known} of {root}")
        return known + 1

    def finish(self) -> dict[str, Any]:
        """Evaluate the population, write the report, return the summary (keys: see `run_population`)."""
        path, config, books = self.books.dir / "population", self.config, self.books
        self.reporter.phase("evaluation", 1)
        result = evaluate_population(
            load_population(path),
            config.evaluation.episodes,
            config.run.seed,
            progress=lambda done, total: self.reporter.update(done / total, episodes=done),
        )
        files = write_report(result, books.dir / "report")
        size = len(books.population)
        episodes = result.episodes * len(result.pairings)
        books.record_steps(size, Kind.EVALUATION, f"evaluation.{books.attempt}", 0, result.steps, episodes)
        steps = [sum(books.training_steps(member).values()) for member in range(1, size + 1)]
        files |= write_run_figures(
            books.dir, books.dir / "report", steps, unit=self.spec.score_name, title=self.spec.name
        )
        for file in files.values():
            books.tracker.log_artifact(file, "report")
        figures = {"sp": result.sp.mean, "xp": result.xp.mean}
        books.tracker.log({name: value for name, value in figures.items() if np.isfinite(value)}, step=size)
        evaluation = to_dict(result)
        return {
            "run_id": books.run_id,
            "run_dir": str(books.dir),
            "population": str(path),
            "members": size,
            "ledger": books.ledger.table(),
            "matrix": evaluation["matrix"],
            "evaluation": evaluation,
            "files": {suffix: str(file) for suffix, file in files.items()},
            "seconds": round(time.time() - self.began, 1),
        }


class FirstMember:
    """State of member 1's loop: what each of the three kinds of work published last."""

    def __init__(self, driver: Driver, model: Any, starts: Any, acting: Any, seed: int) -> None:
        self.driver, self.phase, self.seed = driver, driver.config.phase1, seed
        self.model, self.starts, self.acting = model, starts, acting
        self.recent: deque[float] = deque(maxlen=max(16, self.phase.envs // 2))
        self.shaped: deque[float] = deque(maxlen=max(16, self.phase.envs // 2))
        self.figures: dict[str, float] = {}
        self.rounds = self.since_best = 0
        self.top: Snapshot | None = None
        self.restarted = False
        driver.reporter.phase("member 1: self-play", self.phase.max_steps)
        parts = {1: driver._parts(ray.get(acting))}
        team = Team(Kind.SP, (1, 1), self.phase.envs)
        ray.get(driver.crew.samplers[0].open.remote([team], parts, seed, True))

    def work(self) -> dict[str, tuple[Any, Any]]:
        """The three kinds of work; their order is that in which a synchronous round takes the results."""
        crew, phase = self.driver.crew, self.phase
        per_update = self.driver.config.agent.starts_sp

        def sample() -> Any:
            return (
                crew.samplers[0]
                .collect.options(num_returns=2)
                .remote(phase.steps_per_iteration, {1: ray.get(self.acting)})
            )

        def learn_model() -> Any:
            return crew.model.train.options(num_returns=3).remote(phase.model_updates, per_update)

        def learn_agent() -> Any:
            return crew.agent.train.options(num_returns=2).remote(phase.agent_updates, self.model, self.starts, 0.0, {})

        return {
            "sampler": (sample, self.sampled),
            "model": (learn_model, self.model_learned),
            "agent": (learn_agent, self.agent_learned),
        }

    def sampled(self, result: tuple[Any, Collected]) -> None:
        segments, collected = result
        self.driver._absorb(1, segments, collected)
        self.recent.extend(e.score for e in collected.episodes)
        self.shaped.extend(e.shaped for e in collected.episodes)

    def model_learned(self, result: tuple[Any, Any, dict[str, float]]) -> None:
        self.model, self.starts, metrics = result
        self.figures |= {f"model/{name}": value for name, value in metrics.items()}

    def agent_learned(self, result: tuple[Any, dict[str, float]]) -> None:
        self.acting, metrics = result
        self.figures |= {f"agent/{name}": value for name, value in metrics.items()}

    def after(self) -> None:
        """Book-keeping at the end of a round."""
        driver = self.driver
        self.rounds += 1
        if self.recent:
            self.figures |= {
                "real_sp": float(np.mean(self.recent)),
                "real_reward_sp": float(np.mean(self.shaped)) / driver.spec.horizon,
            }
        if self.rounds % self.phase.check_every == 0:
            self.figures |= {f"report/{k}": v for k, v in ray.get(driver.crew.model.report.remote()).items()}
        driver.books.log(1, driver.steps, **self.figures)
        self._keep_best()
        self._restart_if_due()
        score = round(self.figures.get("real_sp", 0.0), 2)
        driver.reporter.update(driver.steps, steps=driver.steps, **{driver.spec.score_name: score})

    def _keep_best(self) -> None:
        score = float(np.mean(self.recent)) if len(self.recent) == self.recent.maxlen else -np.inf
        if self.top is None or score > self.top.sp:
            self.top = Snapshot(ray.get(self.acting), score, 0.0)
            self.since_best = 0
        else:
            self.since_best += 1

    def _restart_if_due(self) -> None:
        """Fresh actor and critics on the world model learned so far, once (an actor can get stuck, a model less)."""
        phase, driver = self.phase, self.driver
        if self.restarted or not phase.restart_updates or driver.steps < phase.restart_after:
            return
        self.restarted = True
        driver.reporter.note(f"member 1: actor and critics start again on the world model of {driver.steps:,} steps")
        ray.get(driver.crew.agent.restart.remote(self.seed + 500))
        for _ in range(0, phase.restart_updates, phase.agent_updates):
            self.acting, info = driver.crew.agent.train.options(num_returns=2).remote(
                phase.agent_updates, self.model, self.starts, 0.0, {}
            )
            ray.get(info)

    def stop(self) -> bool:
        """Budget spent, target reached over a full window of episodes, or no better for `patience` rounds."""
        full = len(self.recent) == self.recent.maxlen
        reached = full and float(np.mean(self.recent)) >= self.phase.target_score
        return self.driver.steps >= self.phase.max_steps or reached or self.since_best >= self.phase.patience

    def best(self) -> Snapshot:
        """The weights with the best window, unless the last ones are about as good (they learned longer)."""
        last = Snapshot(ray.get(self.acting), float(np.mean(self.recent)) if self.recent else 0.0, 0.0)
        if self.top is None or not np.isfinite(self.top.sp) or last.sp >= 0.95 * self.top.sp:
            return last
        return self.top
