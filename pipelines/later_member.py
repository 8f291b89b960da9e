"""Members 2..M: a fresh agent on the trained world model (phase 2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import ray

from popgen.nets.weights import under
from popgen.pipelines.snapshot import Published, Snapshot
from popgen.play.partner_strength import PartnerStrength
from popgen.play.sampler import Episode, Match
from popgen.runs.checkpoints import fitting
from popgen.types import Kind

if TYPE_CHECKING:
    from popgen.pipelines.xpm_wm_driver import XpmWm

PIECE = 50
"""Agent updates between two signs of progress."""


class LaterMember:
    """Imagination first, then few rounds of real episodes, fine-tuning of the world model and imagination."""

    def __init__(self, driver: XpmWm, member: int, seed: int) -> None:
        self.driver, self.config, self.phase = driver, driver.config, driver.config.phase2
        self.member, self.seed = member, seed
        self.partners = sorted(driver.members)
        self.pairs = [pair for partner in self.partners for pair in ((member, partner), (partner, member))]
        # Every partner's cross-play must be known to tell the strongest, in both seats.
        self.episodes_xp = max(self.phase.episodes_xp, len(self.pairs))
        self.returns = PartnerStrength(self.config.agent.partner)
        self.best: Snapshot | None = None
        self.number = 0
        self.plays = False

    def train(self, saved: dict[str, Any] | None) -> Snapshot:
        """All rounds; `saved` is a checkpoint to go on from, made when a round's episodes had been judged."""
        driver, rounds, phase = self.driver, self.rounds(), self.phase
        actors = {k: under("actor", weights) for k, weights in driver.members.items()}
        filters = {k: under("filter", weights) for k, weights in driver.members.items()}
        crew = driver.crew
        ray.get([crew.agent.begin_member.remote(self.member, self.seed, actors)])
        ray.get([crew.model.begin_member.remote(self.member, filters)])
        total = phase.first_updates + (rounds - 1) * phase.updates_per_round
        driver.reporter.phase(f"member {self.member}: imagined self-play and cross-play", total)
        if saved is not None:
            driver.restore_learners(saved)
            with fitting(driver.checkpoints.folder):
                self._restore(saved["later_member"])
        while self._goes_on(rounds):
            published = self._imagine()
            episodes = self._real_episodes(ray.get(published.acting))
            self.number += 1
            self._judge(published, episodes)
            if self._goes_on(rounds) and driver.checkpoints.due():
                self._save()
        assert self.best is not None
        return self.best

    def rounds(self) -> int:
        """Rounds of real episodes at most: those configured, fewer where the environment steps end first."""
        phase = self.phase
        most = max(phase.rounds, phase.max_rounds)
        each = (phase.episodes_sp + self.episodes_xp) * self.driver.spec.horizon
        return most if phase.max_steps is None else max(1, min(most, phase.max_steps // each))

    def _goes_on(self, most: int) -> bool:
        """The configured rounds are played in any case, further ones only by a member that is still weak."""
        weak = self.best is None or self.best.sp < self.phase.target_score
        return self.number < (most if weak else min(self.phase.rounds, most))

    def _imagine(self) -> Published:
        """Fine-tune the world model on the last episodes, refresh the start cache, then learn in imagination."""
        driver, crew, phase, number = self.driver, self.driver.crew, self.phase, self.number
        if number:
            *_, info = crew.model.train.options(num_returns=3).remote(phase.model_updates, 0)
            driver.log(self.member, **{f"model/{k}": v for k, v in ray.get(info).items()})
        updates, new_share = (phase.updates_per_round, phase.starts_new) if number else (phase.first_updates, 0.0)
        done = phase.first_updates + (number - 1) * phase.updates_per_round if number else 0
        scores = self.returns.scores()
        starts, model = crew.model.cache_starts.remote(), crew.model.weights.remote()
        for first in range(0, updates, PIECE):
            count = min(PIECE, updates - first)
            train = crew.agent.train.options(num_returns=3)
            acting, critics, info = train.remote(count, model, starts, new_share, scores, self.plays)
            metrics = ray.get(info)
            driver.log(self.member, **{f"agent/{k}": v for k, v in metrics.items()}, updates=done + first)
            driver.reporter.update(
                done + first + count, steps=driver.steps, entropy=round(metrics["entropy"], 2), **self._told()
            )
        return Published(acting, model, critics)

    def _told(self) -> dict[str, float]:
        """The best round so far, for the progress line."""
        return {} if self.best is None else {"SP": round(self.best.sp, 2), "XP": round(self.best.xp, 2)}

    def _real_episodes(self, acting: Any) -> list[Episode]:
        """One episode in each self-play and cross-play environment; partners act with their own archived filters."""
        driver, seed = self.driver, self.seed * 100 + self.number + 1
        matches = [Match(Kind.SP, (self.member, self.member), self.phase.episodes_sp)]
        order = np.random.default_rng(seed).permutation(len(self.pairs))
        counts = np.bincount(np.arange(self.episodes_xp) % len(self.pairs), minlength=len(self.pairs))
        matches += [Match(Kind.XP, self.pairs[i], int(n)) for i, n in zip(order, counts, strict=True)]
        weights = {**driver.members, self.member: acting}
        driver.crew.players.open(matches, {m: driver.parts(weights[m]) for m in weights}, seed)
        return driver.play(self.member, driver.spec.horizon)

    def _judge(self, published: Published, episodes: list[Episode]) -> None:
        """What the real episodes say: whether this is the best round, and each partner's cross-play return."""
        driver, horizon = self.driver, self.driver.spec.horizon
        own = [e for e in episodes if e.kind is Kind.SP]
        cross = {k: [e for e in episodes if e.kind is Kind.XP and k in e.members] for k in self.partners}
        for partner, found in cross.items():
            self.returns.add(partner, [e.shaped for e in found])
        strongest = max(float(np.mean([e.score for e in found])) for found in cross.values())
        snapshot = Snapshot(published, float(np.mean([e.score for e in own])), strongest)
        self.plays |= snapshot.sp >= self.config.agent.entropy_after * self.phase.target_score
        if self.best is None or snapshot.merit > self.best.merit:
            self.best = snapshot
        driver.log(
            self.member,
            real_sp=snapshot.sp,
            real_xp_max=strongest,
            real_shaped_sp=float(np.mean([e.shaped for e in own])) / horizon,
            round=self.number,
        )
        driver.reporter.note(
            f"member {self.member}, round {self.number}: SP {snapshot.sp:.2f}, strongest XP {strongest:.2f} "
            f"{driver.spec.score_name}, {driver.steps:,} steps"
        )

    def _save(self) -> None:
        assert self.best is not None
        state = {"best": self.best.state(), "returns": self.returns.state(), "number": self.number, "plays": self.plays}
        self.driver.save(
            self.member, self.number, {"later_member": state, "samplers": self.driver.crew.players.state()}
        )

    def _restore(self, state: dict[str, Any]) -> None:
        self.driver.check_published(state["best"]["published"])
        self.best, self.number = Snapshot.of(state["best"]), int(state["number"])
        self.plays = bool(state["plays"])
        self.returns.load_state(state["returns"])
