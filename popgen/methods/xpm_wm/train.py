"""Algorithm 1 of the paper, XPM-WM training of the m-th agent; numbers in comments are its lines.

Member 1 learns together with the world model (phase 1), every later one mostly in imagination (phase 2). The loops ask
`Workers` and yield what happened; where workers run, and what is kept of their work, is not seen from here.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

from popgen.methods.training import Pending, Phase, Progress, Record, Round, Sampled, Work, named_figures
from popgen.methods.xpm_wm import phase1, phase2
from popgen.methods.xpm_wm import real_play as real
from popgen.methods.xpm_wm.config import PREFILL_CHUNK
from popgen.methods.xpm_wm.overlap import Overlap
from popgen.methods.xpm_wm.real_play import Candidate, MemberWeights
from popgen.methods.xpm_wm.workers import AgentTask, AgentUpdate, ModelReports, ModelTask, ModelUpdate, Setup
from popgen.play.episodes import Episode
from popgen.types import RANDOM_MEMBER

MemberLoop = Generator[Record, bool | None, Candidate]
Records = Generator[Record, bool | None, None]
Result = Sampled | ModelUpdate | AgentUpdate
FIRST = 1
LEARNERS = ("model", "agent")
MODEL_PIECE, AGENT_PIECE = 100, 50  # updates between two signs of progress


class FirstMember:
    """Phase 1: random play, world-model updates alone, then rounds of sampling, model and agent learning."""

    def __init__(self, setup: Setup, progress: phase1.FirstMemberProgress) -> None:
        self.work, self.config, self.spec, self.seed = setup.work, setup.config, setup.spec, setup.seed
        self.phase, self.progress = self.config.phase1, progress
        self.reports = ModelReports(self.work, self.phase.check_every, waits=self.config.run.schedule == "sync")

    def train(self, resumed: bool) -> MemberLoop:
        """Until the budget, the target or the patience ends; line 1 is done."""
        if not resumed:
            yield from self.collect_random_episodes()
            yield from self.pretrain()
        yield phase1.describe_self_play(self.progress, self.phase)
        if not resumed:
            self.start_self_play()
            yield Round(FIRST, self.progress.steps, number=0, must_save=True)
        overlap = Overlap.of_run(self.config.run, self.work.samplers(), LEARNERS, self.work.wait)
        while True:
            yield from self.play_rounds(overlap)
            if not phase1.is_done(self.progress, self.phase) or (yield from self.confirm()):
                return phase1.choose_first(self.progress)
            self.start_self_play()

    def collect_random_episodes(self) -> Records:
        """Lines 2 and 3: B_SP is populated with K random episodes."""
        phase, progress = self.phase, self.progress
        yield Phase(phase1.RANDOM_PLAY, phase.prefill_steps, FIRST)
        snapshot = real.random_snapshot(self.spec, phase.prefill_interact, self.work.put)
        self.work.start_episodes([real.random_match(phase.envs)], {RANDOM_MEMBER: snapshot}, self.seed)
        while progress.steps < phase.prefill_steps:
            missing = (phase.prefill_steps - progress.steps) // phase.envs
            self.add_to_buffers(sampled := self.work.collect(max(1, min(PREFILL_CHUNK, missing))))
            yield phase1.describe_random_play(progress, tuple(sampled))

    def pretrain(self) -> Records:
        """World-model updates alone, in pieces for the progress bar; then the agent's first ones."""
        total = self.phase.pretrain_updates
        yield Phase(phase1.MODEL_ALONE, total, FIRST)
        for done in range(0, total, MODEL_PIECE):
            count = min(MODEL_PIECE, total - done)
            update = self.update_world_model(count).result()
            self.progress.model, self.progress.starts = update.weights, update.starts
            yield phase1.describe_pretraining(self.progress, named_figures("model", update.metrics), done + count)
        self.progress.published = self.update_agent().result().weights

    def start_self_play(self, stagger: bool = True) -> None:
        """Fresh episodes of the published policy."""
        seed = self.seed + 10_000 * (2 * self.progress.confirmations - (not stagger))
        policies = real.policy_snapshots(self.config, {FIRST: self.progress.latest.acting})
        self.work.start_episodes([real.self_play_match(FIRST, self.phase.envs)], policies, seed, stagger)

    def play_rounds(self, overlap: Overlap) -> Records:
        """Line 4, with lines 5-7, 8-15 and 17-18 side by side; a round ends when the slowest of them has advanced."""
        progress, resting = self.progress, False
        while True:
            if not resting and not phase1.should_stop(progress, self.phase):
                for kind in overlap.startable():
                    overlap.start(kind, self.start_task(kind))
            if not overlap.running:
                if not resting:
                    return
                resting = False
                yield Round(FIRST, progress.steps, number=progress.rounds, must_save=True)
                continue
            for kind, result in (finished := overlap.finish()):
                overlap.record_finished(kind, self.apply_result(kind, result))
            sampled = tuple(result for _, result in finished if isinstance(result, Sampled))
            if overlap.round_ended():
                wants_rest = yield self.end_round(overlap, sampled)
                resting = bool(overlap.running) and bool(wants_rest or resting)
            elif sampled:
                yield Progress(FIRST, progress.steps, sampled=sampled)

    def start_task(self, kind: str) -> Pending[Sampled] | Pending[ModelUpdate] | Pending[AgentUpdate]:
        """One task of a kind, on what the others published last."""
        if kind in LEARNERS:
            return self.update_agent() if kind == "agent" else self.update_world_model(self.phase.model_updates)
        self.progress.playing_weights = self.progress.latest
        return self.work.start_sampling(kind, self.phase.steps_per_iteration, FIRST, self.progress.latest.acting)

    def update_world_model(self, updates: int) -> Pending[ModelUpdate]:
        """Lines 6 and 7. Starts from chosen windows once self-play has begun: nothing corrects imagination before."""
        progress, discovery = self.progress, self.config.discovery
        chosen = progress.self_play_has_begun or self.phase.event_starts == "always"
        rare = real.rare_events(real.read_tally(self.work, FIRST, discovery), discovery)
        recent = self.phase.envs * self.phase.steps_per_iteration if discovery.trust else 0
        return self.work.update_world_model(ModelTask(updates, self.config.agent.starts_sp, chosen, rare, recent))

    def update_agent(self) -> Pending[AgentUpdate]:
        """Lines 8 and 12 to 15, without partners."""
        tally = real.read_tally(self.work, FIRST, self.config.discovery)
        return self.work.update_agent(phase1.make_agent_task(self.progress, self.phase, tally))

    def apply_result(self, kind: str, result: Result) -> Work:
        """Episodes into B_SP, or what a learner published as the newest; the time that the task took."""
        progress = self.progress
        if isinstance(result, Sampled):
            progress.add_episodes(self.add_to_buffers([result]))  # 18
            return Work(1, cpu_seconds=result.collected.cpu_seconds)
        if isinstance(result, ModelUpdate):
            progress.model, progress.starts, progress.recent_starts = result.weights, result.starts, result.recent
        else:
            progress.published = result.weights
        progress.figures |= named_figures(kind, result.metrics)
        return Work(1, result.metrics["seconds"], result.metrics["cpu_seconds"])

    def add_to_buffers(self, sampled: list[Sampled]) -> list[Episode]:
        """Lines 3 and 18: into B_SP; the episodes that ended."""
        self.work.add_to_buffers(sampled, FIRST)
        self.progress.steps += real.steps_of(sampled)
        return real.episodes_of(sampled)

    def end_round(self, overlap: Overlap, sampled: tuple[Sampled, ...]) -> Round:
        """Judge the round; start actor and critics again if that is due."""
        progress, watch = self.progress, self.config.watch
        progress.rounds += 1
        report = self.reports.after_round(progress.rounds)
        progress.figures |= phase1.window_figures(progress, self.spec.horizon) | report | overlap.figures()
        phase1.keep_best(progress, self.phase, self.config.agent.entropy_after)
        trouble = progress.watch.look(progress.figures, report, watch, watch.first_rounds)
        note = self.restart_if_due() or (trouble and f"member 1: {trouble}")
        ended = phase1.describe_first_round(progress, self.phase, self.spec.score_name)
        return replace(ended, sampled=sampled, at_rest=not overlap.running, note=note, work=dict(overlap.work))

    def restart_if_due(self) -> str:
        """Line 1 again on the world model learned so far; a note about it."""
        if not phase1.restart_is_due(self.progress, self.phase):
            return ""
        self.progress.restarted = True
        self.work.restart_agent(self.seed + 500)
        for _ in range(0, self.phase.restart_updates, self.phase.agent_updates):
            self.progress.published = self.update_agent().result().weights
        return f"member 1: actor and critics start again on the world model of {self.progress.steps:,} steps"

    def confirm(self) -> Generator[Record, bool | None, bool]:
        """Whether a whole episode of the last policy in each environment is good; so where the budget has no room."""
        progress = self.progress
        if not phase1.may_confirm(progress, self.phase, self.spec.horizon):
            return True
        progress.confirmations += 1
        self.start_self_play(stagger=False)
        episodes = self.add_to_buffers(sampled := self.work.collect(self.spec.horizon))
        score = phase1.confirm_policy(progress, episodes, self.phase)
        note = phase1.describe_confirmation(progress, score, len(episodes), self.spec.score_name)
        yield Progress(FIRST, progress.steps, sampled=tuple(sampled), note=note)
        return progress.confirmed


class LaterMember:
    """Phase 2: imagination first, then few rounds of real episodes, world-model updates and imagination."""

    def __init__(self, setup: Setup, progress: phase2.LaterMemberProgress) -> None:
        self.work, self.config, self.spec, self.seed = setup.work, setup.config, setup.spec, setup.seed
        self.member, self.archive = setup.member, setup.archive
        self.phase, self.progress = self.config.phase2, progress
        self.episodes_xp = self.phase.cross_play_episodes(len(self.archive))
        self.pairs = real.seatings(self.member, sorted(self.archive)) if self.episodes_xp else []
        self.most_rounds = phase2.most_rounds(self.phase, self.episodes_xp, self.spec.horizon)
        self.imagined: dict[str, float] = {}

    def train(self) -> MemberLoop:
        """All rounds; line 1 is done."""
        phase, progress = self.phase, self.progress
        yield phase2.describe_imagination(progress, phase, self.member, self.most_rounds)
        while phase2.wants_another_round(progress, phase, self.most_rounds):  # 4
            if phase.model_lag:  # the agent imagines in the model of the round before, which learns meanwhile
                task = self.prepare_imagination()
                update = self.update_world_model()  # 5-7, beside 8-16
            else:  # the paper's order: the agent imagines in the model that has learned from all episodes
                update = self.update_world_model()  # 5-7
                task = self.prepare_imagination()
            published = yield from self.learn_in_imagination(task)  # 8-16
            if update is not None:
                yield Progress(self.member, progress.steps, named_figures("model", update.result().metrics))
            sampled = self.collect_real_episodes(published)  # 17, 19, 20
            self.work.add_to_buffers(sampled, self.member)  # 18, 21
            yield self.judge(published, sampled)
        return phase2.choose_later(progress)

    def update_world_model(self) -> Pending[ModelUpdate] | None:
        """Lines 5 to 7; there is nothing new before the first real episodes."""
        return self.work.update_world_model(ModelTask(self.phase.model_updates)) if self.progress.rounds else None

    def prepare_imagination(self) -> AgentTask:
        """What lines 8 to 10 need: the world model as it is, states to start from, partners and their strength (9)."""
        starts, model, partners = self.work.cache_starts(), self.work.model_weights(), self.work.fit_partners()
        most_paid = self.work.most_paid().result() if self.phase.pay_limit else None
        return phase2.make_agent_task(self.progress, self.phase, model, starts, partners, most_paid)

    def learn_in_imagination(self, task: AgentTask) -> Generator[Record, bool | None, MemberWeights]:
        """Lines 8 to 15, in pieces for the progress bar: simulation (8, 10), objective (11-13), updates (14, 15)."""
        progress, plan = self.progress, phase2.plan_imagination(self.progress.rounds, self.phase)
        tally, done = real.read_tally(self.work, self.member, self.config.discovery), plan.done
        while True:
            task = replace(task, updates=min(AGENT_PIECE, plan.done + plan.updates - done), tally=tally)
            update = self.work.update_agent(task).result()
            self.imagined, done = named_figures("agent", update.metrics) | {"updates": done}, done + task.updates
            yield phase2.describe_updates(progress, self.member, self.imagined, done, self.phase, self.most_rounds)
            if done == plan.done + plan.updates:
                return update.weights

    def collect_real_episodes(self, published: MemberWeights) -> list[Sampled]:
        """Lines 17, 19, 20: one episode in each environment, pairs in a drawn order; partners have their filters."""
        seed = real.seed_of_round(self.seed, self.progress.rounds + 1)
        matches = real.later_matches(self.member, self.pairs, self.phase.episodes_sp, self.episodes_xp, seed)
        policies = real.policy_snapshots(self.config, {**self.archive, self.member: published.acting})
        self.work.start_episodes(matches, policies, seed)
        return self.work.collect(self.spec.horizon)

    def judge(self, published: MemberWeights, sampled: list[Sampled]) -> Round:
        """What the real episodes say: whether this is the best round, and each partner's cross-play return."""
        progress, watch = self.progress, self.config.watch
        progress.steps += real.steps_of(sampled)
        scored = phase2.judge_round(progress, published, real.episodes_of(sampled), self.spec.horizon)
        progress.self_play_has_begun |= scored.sp >= self.config.agent.entropy_after * self.phase.target_score
        trouble = progress.watch.look(self.imagined | progress.figures, {}, watch, watch.later_rounds)
        plan = phase2.describe_imagination(progress, self.phase, self.member, self.most_rounds)
        ended = phase2.describe_later_round(progress, plan, scored, self.spec.score_name, trouble)
        goes_on, keeps = phase2.wants_another_round(progress, self.phase, self.most_rounds), progress.skills is not None
        return replace(ended, sampled=tuple(sampled), at_rest=goes_on or keeps, must_save=keeps and not goes_on)
