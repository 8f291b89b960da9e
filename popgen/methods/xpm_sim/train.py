"""XPM-Sim with the exact simulator as dynamics model F (paper, section 3): member after member, few real episodes.

    for every member j, the archive holding j - 1 policies:
        fresh actor and critics, empty buffers B_SP and B_XP
        until the updates are done:
            real episodes of the present policy: self-play into B_SP, cross-play into B_XP
            the strongest partner k is the one with the highest return in real cross-play
            some updates on trajectories that F simulates from states of both buffers, self-play and cross-play with k
        add the policy to the archive

Where the workers are: `popgen.actors.xpm_sim_workers`. What a record leads to: `popgen.pipelines.training_driver`.
"""

from __future__ import annotations

import time
from dataclasses import asdict, replace

from popgen.envs.contract import EnvSpec
from popgen.envs.reward import rewards_events
from popgen.methods.training import (
    Checkpoint,
    Loop,
    Pending,
    Phase,
    PlannedPhase,
    PolicySnapshot,
    Progress,
    Round,
    Sampled,
    State,
    StepCount,
    TrainedMember,
)
from popgen.methods.xpm_sim.agent import make_actor
from popgen.methods.xpm_sim.config import XpmSimRun
from popgen.methods.xpm_sim.round_rules import MemberProgress, round_matches, score_round, seatings, updates_of_round
from popgen.methods.xpm_sim.workers import Learned, Workers
from popgen.nets.weights import prefixed
from popgen.play.episodes import Episode
from popgen.play.partner_strength import PartnerConstraint, PartnerStrength
from popgen.types import Kind, Weights

SIMULATED_PLAY = "simulated play"
STEP_SECONDS = 5e-5  # of a simulated step and what is learned from it, on a laptop's core


class XpmSimTraining:
    """The training of one run's members in one attempt (`popgen.methods.training.Training`)."""

    learners = ("learner",)
    log_rows = 1  # no log: the learner's state holds its buffers
    begins_workers = False

    def __init__(self, config: XpmSimRun, spec: EnvSpec, attempt: str, workers: Workers) -> None:
        self.run, self.config, self.spec, self.workers = config.run, config.xpm_sim, spec, workers
        self.run_size = config.population.size
        self.attempt = attempt.rpartition(".")[2]
        self.policy = make_actor(self.config, spec)
        self.archive: dict[int, Pending[Weights]] = {}
        self.encoder: Pending[State | None] | None = None
        self.member, self.seed, self.began = 0, 0, time.time()
        self.partners: list[int] = []
        self.pairs: list[tuple[int, int]] = []
        self.progress, self.strength = MemberProgress(), PartnerStrength(self.config.partner)
        self.constraint = PartnerConstraint(self.config.xp_limit, self.config.multiplier_step)
        self.acting: Pending[Weights] = workers.put({})

    def train(self) -> Loop:
        """Real episodes and updates in turn, to the end of the member."""
        config, now = self.config, self.progress
        yield Phase(SIMULATED_PLAY, config.updates, self.member, done=now.updates)
        if now.rounds:
            yield Progress(
                self.member, now.steps, note=f"continuing after {now.updates} updates of member {self.member}"
            )
        while updates := updates_of_round(config, now.updates):
            # With schedule=async at the same time: episodes of the policy before the updates, starts one round older.
            overlap = self.run.schedule == "async" and now.rounds > 0
            learning = self.workers.learn(updates) if overlap else None
            sampled = self._play_episodes()
            counted = tuple(replace(one, segments={}) for one in sampled)  # a checkpoint needs no log of segments
            now.steps += sum(one.collected.steps for one in sampled)
            yield Progress(self.member, now.steps, sampled=counted)
            self._score_episodes([episode for one in sampled for episode in one.collected.episodes])
            multipliers = {partner: self.constraint.multiplier(partner) for partner in self.partners}
            segments = [one.segments for one in sampled]
            ingested = self.workers.ingest(segments, self.strength.scores(), multipliers)
            learned = (learning or self.workers.learn(updates)).result()
            ingested.result()
            yield self._end_round(learned, updates)
        yield from self._finish_member()

    def _play_episodes(self) -> list[Sampled]:
        """One episode in each environment."""
        number, horizon = self.progress.rounds, self.spec.horizon
        weights = {**self.archive, self.member: self.acting}
        policies = {k: PolicySnapshot(self.policy.kind, self.policy.config(), own) for k, own in weights.items()}
        matches = round_matches(self.config, self.member, self.pairs, number)
        return self.workers.play(matches, policies, self.seed * 1000 + number, horizon)

    def _score_episodes(self, episodes: list[Episode]) -> None:
        """Scores of the round, each partner's latest return in cross-play, and what follows for its multiplier."""
        events = rewards_events(self.spec)
        met_now: dict[int, float] = {}
        for partner in self.partners:
            met = [e for e in episodes if e.kind is Kind.XP and partner in e.members]
            self.strength.add(partner, [e.shaped if events else e.score for e in met])
            if met:
                met_now[partner] = sum(e.score for e in met) / len(met)
        self.progress.scores = score_round(self.progress.scores, episodes, self.partners)
        self.constraint.add(met_now, self.progress.scores["sp"])

    def _end_round(self, learned: Learned, updates: int) -> Round:
        """The record of a round: what the policy that played had been trained with, and what the updates gave."""
        now, scores = self.progress, self.progress.scores
        played = {"updates": float(now.updates), "simulated_steps": float(now.simulated)}
        figures = {f"learner/{name}": value for name, value in learned.metrics.items()}
        figures |= {f"real_{name}": value for name, value in scores.items()} | played
        counted = self._count_simulated("simulator", now.rounds, learned.steps, learned.trajectories)
        self.acting = learned.acting
        now.rounds, now.updates = now.rounds + 1, now.updates + updates
        shown: dict[str, float] = {"steps": now.steps, self.spec.score_name: round(scores["sp"], 2)}
        if self.pairs:
            shown["XP"] = round(scores["xp"], 2)
        return Round(
            self.member,
            now.steps,
            figures,
            counted=(counted,),
            done=now.updates,
            shown=shown,
            number=now.rounds,
        )

    def _count_simulated(self, name: str, sequence: int, steps: int, trajectories: int) -> StepCount:
        self.progress.simulated += steps
        return StepCount(self.member, Kind.SIMULATED, f"{name}.{self.attempt}", sequence, steps, trajectories)

    def _finish_member(self) -> Loop:
        """Check the member, and hand it over."""
        now, check = self.progress, self.workers.check().result()
        counted = self._count_simulated("check", 0, check.steps, 0)
        figures = {f"check/{name}": value for name, value in check.figures.items()}
        yield Progress(self.member, now.steps, figures, counted=(counted,))
        critics, seconds = prefixed("critics", self.workers.critics().result()), time.time() - self.began
        self.encoder = self.workers.encoder()
        weights = self.acting.result()
        self.archive[self.member] = self.workers.put(weights)
        policy = make_actor(self.config, self.spec)
        policy.load(weights)
        extra = {name: now.scores[name] for name in ("sp", "xp") if name in now.scores}
        extra |= {"seconds": round(seconds, 1), "simulated_steps": now.simulated, "check": check.figures}
        note = self._describe_member(check.figures, seconds)
        yield TrainedMember(self.member, policy, critics, self.seed, extra, {"encoder": self.encoder}, note)

    def _describe_member(self, check: dict[str, float], seconds: float) -> str:
        now, scores = self.progress, self.progress.scores
        parts = [f"SP {scores['sp']:.2f}"] + ([f"strongest XP {scores['xp']:.2f}"] if "xp" in scores else [])
        parts[-1] += f" {self.spec.score_name} in training"
        parts += [f"from XP states {check['restart_ratio']:.2f} of SP"] if "restart_ratio" in check else []
        parts += [f"{now.steps:,} real and {now.simulated:,} simulated steps", f"{seconds / 60:.1f} min"]
        return f"member {self.member}: {', '.join(parts)}"

    # ---- members and checkpoints ---------------------------------------------------------------------------------

    def adopt(self, weights: dict[int, Weights], left: State) -> None:
        """See `Training`."""
        self.archive = {member: self.workers.put(own) for member, own in weights.items()}
        self.encoder = left.get("encoder")

    def first_of_group(self, member: int) -> int:
        """Members learn one after the other."""
        return member

    def plan(self) -> list[PlannedPhase]:
        """See `Training`. Whoever has predecessors simulates cross-play too."""
        now = self.config
        alone = now.sims_sp * now.unroll
        cross = now.sims_restart * now.restart_horizon + now.sims_xp * now.xp_horizon
        costs = {member: alone + cross * (member > 1) for member in range(1, self.run_size + 1)}
        return [PlannedPhase(SIMULATED_PLAY, m, now.updates * cost * STEP_SECONDS) for m, cost in costs.items()]

    def begin(self, first: int) -> tuple[int, ...]:
        """See `Training`."""
        self.member, self.seed, self.began = first, self.run.seed * 1000 + first, time.time()
        self.partners = sorted(self.archive)
        self.pairs = seatings(first, self.partners, self.seed)
        self.progress, self.strength = MemberProgress(), PartnerStrength(self.config.partner)
        self.constraint = PartnerConstraint(self.config.xp_limit, self.config.multiplier_step)
        self.acting = self.workers.begin_member(first, self.seed, self.archive, self.encoder)
        self.policy.load(self.acting.result())
        return (first,)

    def checkpoint(self) -> State:
        """See `Training`."""
        progress, strength = asdict(self.progress), self.strength.state()
        state = {"progress": progress, "strength": strength, "constraint": self.constraint.state()}
        state |= {"workers": self.workers.state(), "acting": self.acting, "seconds": time.time() - self.began}
        return state

    def restore(self, checkpoint: Checkpoint) -> None:
        """See `Training`."""
        state = checkpoint.state
        self.workers.load_state(state["workers"])
        self.progress = MemberProgress.from_state(state["progress"])
        self.strength.load_state(state["strength"])
        self.constraint.load_state(state["constraint"])
        self.policy.load(state["acting"])  # refuses weights of other sizes
        self.acting = self.workers.put(state["acting"])
        self.began -= float(state.get("seconds", 0.0))  # an earlier version did not keep them

    def buffers(self) -> State:
        """The learner's state holds them."""
        return {}

    def close(self) -> None:
        """See `Training`."""
        self.workers.end()
