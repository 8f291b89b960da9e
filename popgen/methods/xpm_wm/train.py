"""Algorithm 1 of the paper, XPM-WM training of the m-th agent; numbers in comments are its lines.

Member 1 learns together with the world model (phase 1), every later one mostly in imagination (phase 2). The loops ask
`Workers` and yield what happened; where workers run, and what is kept of their work, is not seen from here.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence

import numpy as np

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.training import Pending, Phase, Progress, Record, Round, Sampled
from popgen.methods.xpm_wm import member_progress as rules
from popgen.methods.xpm_wm.config import PREFILL_CHUNK
from popgen.methods.xpm_wm.member_progress import Candidate, FirstMemberProgress, LaterMemberProgress, MemberWeights
from popgen.methods.xpm_wm.overlap import Overlap
from popgen.methods.xpm_wm.real_matches import (
    later_matches,
    policy_snapshot,
    random_match,
    random_snapshot,
    seatings,
    self_play_match,
)
from popgen.methods.xpm_wm.workers import AgentTask, AgentUpdate, ModelUpdate, Workers
from popgen.nets.weights import Weights
from popgen.play.episodes import Episode
from popgen.types import RANDOM_MEMBER

Loop = Generator[Record, bool | None, Candidate]

FIRST = 1
LEARNERS = ("model", "agent")
MODEL_PIECE, AGENT_PIECE = 100, 50
"""Updates between two signs of progress."""


def episodes_of(sampled: Sequence[Sampled]) -> list[Episode]:
    """The episodes that ended, in the samplers' order."""
    return [episode for one in sampled for episode in one.collected.episodes]


class FirstMember:
    """Phase 1: random play, world-model updates alone, then rounds of sampling, model and agent learning."""

    def __init__(
        self, work: Workers, config: RunConfig, spec: EnvSpec, seed: int, progress: FirstMemberProgress
    ) -> None:
        self.work, self.config, self.spec, self.seed, self.progress = work, config, spec, seed, progress
        self.phase = config.phase1
        self.report: Pending[dict[str, float]] | None = None

    def train(self, resumed: bool) -> Loop:
        """Until the budget, the target or the patience ends; line 1 is done."""
        if not resumed:
            yield from self.collect_random_episodes()
            yield from self.pretrain()
        yield Phase("member 1: self-play", self.phase.max_steps)
        if not resumed:
            self.start_self_play()
            yield Round(FIRST, self.progress.steps, number=0, must_save=True)
        overlap = Overlap(
            [*self.work.samplers(), *LEARNERS],
            LEARNERS,
            schedule=self.config.run.schedule,
            overlap=self.config.run.overlap,
            wait=self.work.wait,
        )
        while True:
            yield from self.play_rounds(overlap)
            if not rules.reached_target(self.progress, self.phase) or (yield from self.confirm()):
                return rules.choose_first(self.progress)
            self.start_self_play()

    def collect_random_episodes(self) -> Generator[Record, bool | None, None]:
        """Lines 2 and 3: B_SP is populated with K random episodes."""
        phase, progress = self.phase, self.progress
        yield Phase("member 1: random play", phase.prefill_steps)
        snapshot = random_snapshot(self.spec, phase.prefill_interact, self.work.put)
        self.work.start_episodes([random_match(phase.envs)], {RANDOM_MEMBER: snapshot}, self.seed)
        while progress.steps < phase.prefill_steps:
            missing = (phase.prefill_steps - progress.steps) // phase.envs
            sampled = self.work.collect(max(1, min(PREFILL_CHUNK, missing)))
            self.add_to_buffers(sampled)
            shown = {"steps": progress.steps}
            yield Progress(FIRST, progress.steps, sampled=tuple(sampled), done=progress.steps, shown=shown)

    def pretrain(self) -> Generator[Record, bool | None, None]:
        """World-model updates alone, in pieces for the progress bar; then the agent's first ones."""
        total = self.phase.pretrain_updates
        yield Phase("member 1: world model on random play", total)
        for done in range(0, total, MODEL_PIECE):
            count = min(MODEL_PIECE, total - done)
            update = self.update_world_model(count).result()
            self.progress.model, self.progress.starts = update.weights, update.starts
            figures = {f"model/{name}": value for name, value in update.metrics.items()}
            shown = {"model_loss": round(update.metrics["loss_observation"], 2)}
            yield Progress(FIRST, self.progress.steps, figures, done=done + count, shown=shown)
        self.progress.published = self.update_agent().result().weights

    def start_self_play(self, stagger: bool = True) -> None:
        """Fresh episodes of the published policy."""
        assert self.progress.published is not None
        seed = self.seed + 10_000 * (2 * self.progress.confirmations - (not stagger))
        policies = {FIRST: policy_snapshot(self.config, self.progress.published.acting)}
        self.work.start_episodes([self_play_match(FIRST, self.phase.envs)], policies, seed, stagger)

    def play_rounds(self, overlap: Overlap) -> Generator[Record, bool | None, None]:
        """Line 4, with lines 5-7, 8-15 and 17-18 side by side: until the phase should stop, or rests for a checkpoint.

        A round ends when the slowest kind of work has advanced.
        """
        progress, resting = self.progress, False
        while True:
            if not resting and not rules.should_stop(progress, self.phase):
                for kind in overlap.startable():
                    overlap.start(kind, self.start_task(kind))
            if not overlap.running:
                if not resting:
                    return
                resting = False
                yield Round(FIRST, progress.steps, number=progress.rounds, must_save=True)
                continue
            sampled: list[Sampled] = []
            for kind, result in overlap.finish():
                cost = self.take_in(kind, result, sampled)
                overlap.took_in(kind, *cost)
            if overlap.round_ended():
                wants_rest = yield self.end_round(overlap, tuple(sampled))
                resting = bool(overlap.running) and bool(wants_rest or resting)
            elif sampled:
                yield Progress(FIRST, progress.steps, sampled=tuple(sampled))

    def start_task(self, kind: str) -> Pending[Sampled] | Pending[ModelUpdate] | Pending[AgentUpdate]:
        """One task of a kind, on what the others published last."""
        if kind == "model":
            return self.update_world_model(self.phase.model_updates)
        if kind == "agent":
            return self.update_agent()
        self.progress.played = self.progress.published
        assert self.progress.published is not None
        acting = self.progress.published.acting
        return self.work.start_sampling(kind, self.phase.steps_per_iteration, FIRST, acting)

    def update_world_model(self, updates: int) -> Pending[ModelUpdate]:
        """Lines 6 and 7. Imagination starts from chosen windows only once self-play has begun: before, the model does
        not know what follows a rare event, and nothing corrects it."""
        chosen = self.progress.plays or self.phase.event_starts == "always"
        return self.work.update_world_model(updates, self.config.agent.starts_sp, chosen)

    def update_agent(self) -> Pending[AgentUpdate]:
        """Lines 8 and 12 to 15, without partners."""
        model, starts = self.progress.model, self.progress.starts
        assert model is not None and starts is not None
        return self.work.update_agent(AgentTask(self.phase.agent_updates, model, starts, 0.0, {}, self.progress.plays))

    def take_in(
        self, kind: str, result: Sampled | ModelUpdate | AgentUpdate, sampled: list[Sampled]
    ) -> tuple[float, float]:
        """Seconds and processor seconds that a finished task took; what it gave is the newest now."""
        progress = self.progress
        if isinstance(result, Sampled):
            progress.add_episodes(self.add_to_buffers([result]))  # 18
            sampled.append(result)
            return 0.0, result.collected.cpu_seconds
        if isinstance(result, ModelUpdate):
            progress.model, progress.starts = result.weights, result.starts
        else:
            progress.published = result.weights
        progress.figures |= {f"{kind}/{name}": value for name, value in result.metrics.items()}
        return result.metrics["seconds"], result.metrics["cpu_seconds"]

    def add_to_buffers(self, sampled: list[Sampled]) -> list[Episode]:
        """Lines 3 and 18: into B_SP; the episodes that ended."""
        self.work.add_to_buffers(sampled, FIRST)
        self.progress.steps += sum(one.collected.steps for one in sampled)
        return episodes_of(sampled)

    def end_round(self, overlap: Overlap, sampled: tuple[Sampled, ...]) -> Round:
        """Judge the round; start actor and critics again if that is due."""
        progress = self.progress
        progress.rounds += 1
        progress.figures |= rules.window_figures(progress, self.spec.horizon)
        self.look_at_model()
        progress.figures |= overlap.figures()
        figures = dict(progress.figures)
        rules.keep_best(progress, self.phase, self.config.agent.entropy_after)
        return Round(
            FIRST,
            progress.steps,
            figures,
            sampled,
            done=progress.steps,
            shown={"steps": progress.steps, self.spec.score_name: round(figures.get("real_sp", 0.0), 2)},
            note=self.restart_if_due(),
            number=progress.rounds,
            at_rest=not overlap.running,
            work=dict(overlap.work),
        )

    def look_at_model(self) -> None:
        """Now and then a report of it; with `async` it is taken in when it is there, and nothing waits for it."""
        if self.report is None and self.progress.rounds % self.phase.check_every == 0:
            self.report = self.work.report_model()
        timeout = None if self.config.run.schedule == "sync" else 0.0
        if self.report is not None and self.work.wait([self.report], timeout):
            self.progress.figures |= {f"report/{name}": value for name, value in self.report.result().items()}
            self.report = None

    def restart_if_due(self) -> str:
        """Line 1 again on the world model learned so far; a note about it."""
        if not rules.restart_is_due(self.progress, self.phase):
            return ""
        self.progress.restarted = True
        self.work.restart_agent(self.seed + 500)
        for _ in range(0, self.phase.restart_updates, self.phase.agent_updates):
            self.progress.published = self.update_agent().result().weights
        return f"member 1: actor and critics start again on the world model of {self.progress.steps:,} steps"

    def confirm(self) -> Generator[Record, bool | None, bool]:
        """Whether the last policy is good by itself: a whole episode of it in each environment. Where the budget leaves
        no room for that, the window must do."""
        progress = self.progress
        if not rules.may_confirm(progress, self.phase, self.spec.horizon):
            return True
        progress.confirmations += 1
        self.start_self_play(stagger=False)
        sampled = self.work.collect(self.spec.horizon)
        episodes = self.add_to_buffers(sampled)
        progress.add_episodes(episodes)
        score = float(np.mean([episode.score for episode in episodes]))
        progress.confirmed = rules.is_confirmed(score, self.phase)
        outcome = "taken" if progress.confirmed else "learning continues"
        note = f"member 1: {score:.2f} {self.spec.score_name} in {len(episodes)} episodes of one policy: {outcome}"
        yield Progress(FIRST, progress.steps, sampled=tuple(sampled), note=note)
        return progress.confirmed


class LaterMember:
    """Phase 2: imagination first, then few rounds of real episodes, world-model updates and imagination."""

    def __init__(
        self,
        work: Workers,
        config: RunConfig,
        spec: EnvSpec,
        member: int,
        seed: int,
        archive: Mapping[int, Pending[Weights]],
        progress: LaterMemberProgress,
    ) -> None:
        self.work, self.config, self.spec, self.member, self.seed = work, config, spec, member, seed
        self.archive, self.progress, self.phase = archive, progress, config.phase2
        self.pairs = seatings(member, sorted(archive))
        # Every partner's cross-play must be known to tell the strongest, in both seats.
        self.episodes_xp = max(self.phase.episodes_xp, len(self.pairs))
        self.most_rounds = rules.most_rounds(self.phase, self.episodes_xp, spec.horizon)

    def train(self) -> Loop:
        """All rounds; line 1 is done."""
        phase, progress = self.phase, self.progress
        total = phase.first_updates + (self.most_rounds - 1) * phase.updates_per_round
        yield Phase(f"member {self.member}: imagined self-play and cross-play", total)
        while rules.plays_on(progress, phase, self.most_rounds):  # 4
            if progress.rounds:
                yield from self.fine_tune_world_model()  # 5-7
            published = yield from self.learn_in_imagination()  # 8-16
            sampled = self.collect_real_episodes(published)  # 17, 19, 20
            self.work.add_to_buffers(sampled, self.member)  # 18, 21
            yield self.judge(published, sampled)
        assert progress.best is not None
        return progress.best

    def fine_tune_world_model(self) -> Generator[Record, bool | None, None]:
        """Lines 5 to 7, on windows of both buffers, this member's and all before it."""
        update = self.work.update_world_model(self.phase.model_updates, 0).result()
        figures = {f"model/{name}": value for name, value in update.metrics.items()}
        yield Progress(self.member, self.progress.steps, figures)

    def learn_in_imagination(self) -> Generator[Record, bool | None, MemberWeights]:
        """Lines 8 to 15, in pieces for the progress bar: simulated self-play and cross-play with the strongest partner
        so far (9), objective (11-13), updates (14, 15)."""
        phase, progress = self.phase, self.progress
        first_round = progress.rounds == 0
        updates, new_share = (phase.first_updates, 0.0) if first_round else (phase.updates_per_round, phase.starts_new)
        done = 0 if first_round else phase.first_updates + (progress.rounds - 1) * phase.updates_per_round
        scores = progress.strength.scores()  # 9
        starts, model = self.work.cache_starts(), self.work.model_weights()  # 8, 10
        best = {} if progress.best is None else {"SP": round(progress.best.sp, 2), "XP": round(progress.best.xp, 2)}
        published: MemberWeights | None = None
        for first in range(0, updates, AGENT_PIECE):
            count = min(AGENT_PIECE, updates - first)
            task = AgentTask(count, model, starts, new_share, scores, progress.plays)
            update = self.work.update_agent(task).result()  # 11-15
            published = update.weights
            figures = {f"agent/{name}": value for name, value in update.metrics.items()} | {"updates": done + first}
            shown = {"steps": progress.steps, "entropy": round(update.metrics["entropy"], 2), **best}
            yield Progress(self.member, progress.steps, figures, done=done + first + count, shown=shown)
        assert published is not None
        return published

    def collect_real_episodes(self, published: MemberWeights) -> list[Sampled]:
        """Lines 17, 19 and 20: one episode in each environment; partners act with their own archived filters, and every
        pair is met in an order drawn for the round."""
        seed = self.seed * 100 + self.progress.rounds + 1
        matches = later_matches(self.member, self.pairs, self.phase.episodes_sp, self.episodes_xp, seed)
        acting = {**self.archive, self.member: published.acting}
        policies = {member: policy_snapshot(self.config, weights) for member, weights in acting.items()}
        self.work.start_episodes(matches, policies, seed)
        return self.work.collect(self.spec.horizon)

    def judge(self, published: MemberWeights, sampled: list[Sampled]) -> Round:
        """What the real episodes say: whether this is the best round, and each partner's cross-play return."""
        progress = self.progress
        progress.steps += sum(one.collected.steps for one in sampled)
        scored = rules.judge_round(progress, published, episodes_of(sampled), self.spec.horizon)
        progress.plays |= scored.sp >= self.config.agent.entropy_after * self.phase.target_score
        note = (
            f"member {self.member}, round {progress.rounds}: SP {scored.sp:.2f}, strongest XP {scored.xp:.2f} "
            f"{self.spec.score_name}, {progress.steps:,} steps"
        )
        number, goes_on = progress.rounds, rules.plays_on(progress, self.phase, self.most_rounds)
        figures = progress.figures
        return Round(self.member, progress.steps, figures, tuple(sampled), note=note, number=number, at_rest=goes_on)
