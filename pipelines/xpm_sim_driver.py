"""XPM-Sim with the exact simulator as dynamics model F (paper, section 3): member after member, few real episodes."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import ray

from popgen.actors.actor_setup import options
from popgen.actors.sampler_actor import PolicySnapshot, SamplerActor
from popgen.actors.simulated_agent_actor import ExactLearnerActor, Learned
from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.envs.reward import rewards_events
from popgen.methods.xpm_sim.agent import make_actor
from popgen.nets.weights import Weights, prefixed
from popgen.pipelines.sampler_pool import SamplerPool
from popgen.play.partner_strength import PartnerStrength
from popgen.play.sampler import Episode, Match
from popgen.population import load_population
from popgen.progress import Reporter
from popgen.runs.checkpoints import Checkpoints, finished_member, fitting, member_folder, same_form
from popgen.runs.recorder import RunRecorder
from popgen.runs.state_files import save_state
from popgen.types import Kind, Segment


@dataclass
class Crew:
    """The actors of one run: samplers of real episodes, and the learner with its buffers and simulator."""

    players: SamplerPool
    learner: Any

    @staticmethod
    def hire(config: RunConfig, attempt: str) -> Crew:
        """Create all actors; sampler names carry the run and its attempt."""
        cluster = config.cluster
        sampler = ray.remote(SamplerActor).options(**options(cluster, cluster.sampler_cpus))
        learner = ray.remote(ExactLearnerActor).options(**options(cluster, cluster.agent_cpus))
        names = [f"sampler{index}.{attempt}" for index in range(cluster.samplers)]
        samplers = [sampler.remote(config.env, name, cluster.threads) for name in names]
        return Crew(SamplerPool(samplers), learner.remote(config, cluster.threads))

    def dismiss(self) -> None:
        """End all actors."""
        for actor in (*self.players.samplers, self.learner):
            ray.kill(actor)


class XpmSim:
    """The driver: real episodes of the present policy, then simulated updates, in turn."""

    def __init__(self, config: RunConfig, spec: EnvSpec, recorder: RunRecorder, reporter: Reporter) -> None:
        self.config, self.spec, self.recorder, self.reporter = config, spec, recorder, reporter
        self.crew = Crew.hire(config, f"{recorder.run_id}.{recorder.attempt}")
        self.checkpoints = Checkpoints(recorder.dir, long=1, seconds=config.run.checkpoint_seconds)
        actor = make_actor(config.xpm_sim, spec)
        self.kind, self.sizes = actor.kind, actor.config()
        self.members: dict[int, Weights] = {}
        self.encoder: dict[str, Any] | None = None

    def run(self) -> None:
        """Train every member that is not there yet."""
        try:
            known, saved = self._resume()
            for member in range(known + 1, self.config.population.size + 1):
                began = time.time()
                if saved is None:
                    self.checkpoints.begin(None)
                trainer = Member(self, member)
                trainer.train(saved)
                self._complete(trainer, time.time() - began)
                saved = None
        finally:
            self.crew.dismiss()

    def parts(self, weights: Weights) -> PolicySnapshot:
        """A member's policy as it travels to a sampler."""
        return PolicySnapshot(self.kind, self.sizes, weights)

    def _complete(self, trainer: Member, seconds: float) -> None:
        """Add the member to the population and enter it in the recorder."""
        member, recorder = trainer.member, self.recorder
        figures, steps = ray.get(self.crew.learner.check.remote())
        recorder.record_steps(member, Kind.SIMULATED, f"check.{recorder.attempt}", 0, steps, 0)
        critics = prefixed("critics", ray.get(self.crew.learner.critics.remote()))
        trainer.log({f"check/{name}": value for name, value in figures.items()})
        self.encoder = ray.get(self.crew.learner.encoder.remote())
        save_state(member_folder(recorder.dir, member), {"ledger": len(recorder.ledger), "encoder": self.encoder})
        policy = make_actor(self.config.xpm_sim, self.spec)
        policy.load(trainer.acting)
        extra = {
            **{name: trainer.figures[name] for name in ("sp", "xp") if name in trainer.figures},
            "seconds": round(seconds, 1),
            "simulated_steps": recorder.ledger.steps(member=member, kind=Kind.SIMULATED),
            "check": figures,
        }
        recorder.add_member(policy, critics, seed=trainer.seed, extra=extra)
        self.members[member] = trainer.acting
        ratio, seen = figures.get("restart_ratio"), trainer.figures
        told = [f"SP {seen['sp']:.2f}"] + ([f"strongest XP {seen['xp']:.2f}"] if "xp" in seen else [])
        told[-1] += f" {self.spec.score_name} in training"
        told += [f"from XP states {ratio:.2f} of SP"] if ratio is not None else []
        told += [f"{trainer.steps:,} real and {extra['simulated_steps']:,} simulated steps", f"{seconds / 60:.1f} min"]
        self.reporter.note(f"member {member}: {', '.join(told)}")

    def _resume(self) -> tuple[int, dict[str, Any] | None]:
        """Finished members of this run, and the running one's last checkpoint; work behind neither is done again."""
        known = len(self.recorder.population)
        saved = self.checkpoints.load(known + 1)
        last = finished_member(self.recorder.dir, known) if known else {}
        self.encoder = last.get("encoder")
        if self.checkpoints.note:
            self.reporter.note(self.checkpoints.note)
        self.recorder.rewind_ledger((saved or last).get("ledger", 0), self.reporter.note)
        if known:
            population = load_population(self.recorder.dir / "population")
            self.members = {member: population[member].weights() for member in range(1, known + 1)}
        return known, saved


class Member:
    """The rounds of one member: what it plays, learns and enters in the recorder."""

    def __init__(self, driver: XpmSim, member: int) -> None:
        self.driver, self.member, self.seed = driver, member, driver.config.run.seed * 1000 + member
        self.config = driver.config.xpm_sim
        self.partners = sorted(driver.members)
        # Both seatings of all partners, in an order of this member's own; rounds take them in turn.
        order = np.random.default_rng(self.seed).permutation(self.partners)
        self.pairs = [pair for k in order.tolist() for pair in ((member, k), (k, member))]
        self.returns = PartnerStrength(self.config.partner)
        self.figures: dict[str, float] = {}
        self.round = self.updates = self.trained = self.steps = 0
        self.acting: Weights = {}

    def train(self, saved: dict[str, Any] | None) -> None:
        """All rounds; `saved` is a checkpoint to go on from, made after a round."""
        driver, learner = self.driver, self.driver.crew.learner
        self.acting = ray.get(learner.begin_member.remote(self.member, self.seed, driver.members, driver.encoder))
        driver.reporter.phase(f"member {self.member}: simulated self-play and cross-play", self.config.updates)
        if saved is not None:
            with fitting(driver.checkpoints.folder):
                ray.get(learner.load_state.remote(saved["learner"]))
                self._restore(saved["progress"])
        while self.updates < self.config.updates:
            learned = self._round(min(self.config.updates_per_round, self.config.updates - self.updates))
            self._enter(learned)
            self.round += 1
            if driver.checkpoints.due() and self.updates < self.config.updates:
                self._save()

    def _round(self, updates: int) -> Learned:
        """Real episodes and updates: one after the other, or with schedule=async at the same time, the episodes then
        being those of the policy before the updates and the starts one round older."""
        learner, together = self.driver.crew.learner, self.driver.config.run.schedule == "async" and self.round > 0
        running = learner.train.remote(updates) if together else None
        self._play()
        learned: Learned = ray.get(running or learner.train.remote(updates))
        self.acting, self.updates = learned.acting, self.updates + updates
        return learned

    # ---- real episodes -------------------------------------------------------------------------------------------

    def _teams(self) -> list[Match]:
        """Self-play, and cross-play with as many pairs as there are episodes, in turn."""
        matches = [Match(Kind.SP, (self.member, self.member), self.config.episodes_sp)]
        if not self.pairs:
            return matches
        count, episodes = min(len(self.pairs), self.config.episodes_xp), self.config.episodes_xp
        chosen = [self.pairs[(self.round * count + i) % len(self.pairs)] for i in range(count)]
        return matches + [
            Match(Kind.XP, pair, episodes // count + (i < episodes % count)) for i, pair in enumerate(chosen)
        ]

    def _play(self) -> None:
        """One episode in each environment; its states go into the buffers, its steps into the ledger."""
        self.trained = self.updates
        driver, crew, seed = self.driver, self.driver.crew, self.seed * 1000 + self.round
        matches = self._teams()
        weights = {**driver.members, self.member: self.acting}
        crew.players.open(matches, {member: driver.parts(own) for member, own in weights.items()}, seed)
        episodes: list[Episode] = []
        segments: list[Segment] = []
        for reference, collected in crew.players.collect(driver.spec.horizon):
            driver.recorder.record_sampling(self.member, collected)
            self.steps += sum(steps for *_, steps in collected.counts)
            episodes += collected.episodes
            segments += ray.get(reference)
        self._judge(episodes)
        added = crew.learner.add.remote(segments, self.returns.scores())
        if driver.config.run.schedule == "sync":  # else it waits in the learner's queue
            ray.get(added)

    def _judge(self, episodes: list[Episode]) -> None:
        """Self-play's mean score, each partner's latest cross-play return, and the strongest partner's."""
        events = rewards_events(self.driver.spec)
        self.figures["sp"] = float(np.mean([e.score for e in episodes if e.kind is Kind.SP]))
        for partner in self.partners:
            found = [e for e in episodes if e.kind is Kind.XP and partner in e.members]
            self.returns.add(partner, [e.shaped if events else e.score for e in found])
            if found:
                self.figures[f"xp/{partner}"] = float(np.mean([e.score for e in found]))
        if known := [value for name, value in self.figures.items() if name.startswith("xp/")]:
            self.figures["xp"] = max(known)

    # ---- recorder ---------------------------------------------------------------------------------------------------

    def _enter(self, learned: Learned) -> None:
        driver, recorder, real = self.driver, self.driver.recorder, self._real()
        recorder.record_steps(
            self.member,
            Kind.SIMULATED,
            f"simulator.{recorder.attempt}",
            self.round,
            learned.steps,
            learned.trajectories,
        )
        self.log({f"learner/{name}": value for name, value in learned.metrics.items()} | real)
        name = driver.spec.score_name
        told = {name: round(self.figures["sp"], 2), **({"XP": round(self.figures["xp"], 2)} if self.pairs else {})}
        driver.reporter.update(self.updates, steps=self.steps, **told)

    def _real(self) -> dict[str, float]:
        """Figures of the round's real episodes, and what the policy that played them had been trained with."""
        simulated = self.driver.recorder.ledger.steps(member=self.member, kind=Kind.SIMULATED)
        return {f"real_{k}": v for k, v in self.figures.items()} | {
            "updates": float(self.trained),
            "simulated_steps": float(simulated),
        }

    def log(self, figures: dict[str, float]) -> None:
        """A point of metrics at the member's real steps.

        Raises:
            FloatingPointError: a learner's figure is not finite: it will not recover.
        """
        self.driver.recorder.record_metrics(self.member, self.steps, **figures)
        for name, value in figures.items():
            if name.startswith("learner/") and not math.isfinite(value):
                raise FloatingPointError(f"{name} of member {self.member} is {value} after {self.updates:,} updates")

    # ---- checkpoints ---------------------------------------------------------------------------------------------

    def _save(self) -> None:
        driver = self.driver
        progress = {
            "counters": [self.round, self.updates, self.steps],
            "figures": dict(self.figures),
            "returns": self.returns.state(),
            "acting": self.acting,
            "samplers": driver.crew.players.state(),
        }
        state = {"learner": ray.get(driver.crew.learner.state.remote()), "progress": progress}
        driver.checkpoints.save(self.member, {**state, "ledger": len(driver.recorder.ledger)}, dict)
        driver.recorder.record_checkpoint(self.member, self.round)

    def _restore(self, progress: dict[str, Any]) -> None:
        self.round, self.updates, self.steps = map(int, progress["counters"])
        self.figures = {str(name): float(value) for name, value in progress["figures"].items()}
        same_form(progress["acting"], self.acting, "the policy")
        self.acting = progress["acting"]
        self.returns.load_state(progress["returns"])
        # Fresh samplers have played nothing; only the running number of their segments matters.
        self.driver.crew.players.load_state(progress["samplers"])
        self.driver.reporter.note(f"going on after {self.updates} updates of member {self.member}")
