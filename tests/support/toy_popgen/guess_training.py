"""The training loop of the method `guess`: habits are drawn and played, the best one becomes the member."""

from __future__ import annotations

import numpy as np
from toy_popgen.guess_config import GuessRun
from toy_popgen.habit_policy import HabitPolicy

from popgen.actors.samplers import SamplerPool, start_samplers
from popgen.envs import EnvSpec
from popgen.methods.training import (
    Checkpoint,
    Loop,
    Phase,
    PlannedPhase,
    PolicySnapshot,
    Round,
    Sampled,
    State,
    TrainedMember,
    Transport,
)
from popgen.play.rollout import Match
from popgen.types import Kind, Weights


class GuessTraining:
    """See `popgen.methods.training.Training`."""

    learners = ()
    log_rows = 1  # no log: there are no buffers
    begins_workers = False

    def __init__(self, config: GuessRun, spec: EnvSpec, transport: Transport, samplers: SamplerPool) -> None:
        self.config, self.seed, self.spec, self.size = config.guess, config.run.seed, spec, config.population.size
        self.transport, self.samplers = transport, samplers
        self.archive: dict[int, Weights] = {}
        self._start_fresh(0)

    def _start_fresh(self, member: int) -> None:
        self.member, self.rounds, self.steps = member, 0, 0
        self.best, self.best_score = np.full(self.spec.num_actions, 1 / self.spec.num_actions), -np.inf

    def adopt(self, weights: dict[int, Weights], left: State) -> None:
        """Partners of the members to come."""
        self.archive = dict(weights)

    def first_of_group(self, member: int) -> int:
        """Members are found one after the other."""
        return member

    def plan(self) -> list[PlannedPhase]:
        """See `Training`: one phase a member, all alike."""
        return [PlannedPhase("guessing", member, 1.0) for member in range(1, self.size + 1)]

    def begin(self, first: int) -> tuple[int, ...]:
        """Forget the member before."""
        self._start_fresh(first)
        return (first,)

    def train(self) -> Loop:
        """Rounds, then the member."""
        yield Phase("guessing", self.config.rounds, self.member)
        while self.rounds < self.config.rounds:
            yield self.try_habit()
        policy = HabitPolicy(self.spec.num_actions, self.best.tolist())
        self.archive[self.member] = policy.weights()
        note = f"member {self.member}: score {self.best_score:.2f} in training"
        yield TrainedMember(self.member, policy, None, self.seed, {"score": self.best_score}, note=note)

    def try_habit(self) -> Round:
        """Draw a habit, play it, keep it if it is the best. A round draws by its own number: no generator to keep."""
        seed = [self.seed, self.member, self.rounds]
        habit = np.random.default_rng(seed).dirichlet(np.ones(self.spec.num_actions))
        sampled = self.play_episodes(habit)
        score, figures = self.judge_episodes(sampled)
        if score > self.best_score:
            self.best, self.best_score = habit, score
        self.rounds, self.steps = self.rounds + 1, self.steps + sum(one.collected.steps for one in sampled)
        counted = tuple(Sampled(one.collected) for one in sampled)
        shown = {self.spec.score_name: round(figures["real_sp"], 2)}
        return Round(self.member, self.steps, figures, counted, done=self.rounds, shown=shown, number=self.rounds)

    def play_episodes(self, habit: np.ndarray) -> list[Sampled]:
        """Whole episodes with itself and with every partner in both seatings."""
        episodes, own = self.config.episodes, self.member
        pairs = [pair for partner in sorted(self.archive) for pair in ((own, partner), (partner, own))]
        matches = [Match(Kind.SP, (own, own), episodes), *(Match(Kind.XP, pair, episodes) for pair in pairs)]
        weights = {**self.archive, own: {"probabilities": habit}}
        policies = {k: PolicySnapshot(HabitPolicy.kind, {}, self.transport.put(w)) for k, w in weights.items()}
        self.samplers.open(matches, policies, seed=1000 * own + self.rounds)
        return self.samplers.collect(self.spec.horizon)

    def judge_episodes(self, sampled: list[Sampled]) -> tuple[float, dict[str, float]]:
        """Self-play less the strongest partner's cross-play."""
        episodes = [episode for one in sampled for episode in one.collected.episodes]
        own = float(np.mean([episode.score for episode in episodes if episode.kind is Kind.SP]))
        met = {k: [e.score for e in episodes if e.kind is Kind.XP and k in e.members] for k in self.archive}
        strongest = max((float(np.mean(scores)) for scores in met.values()), default=0.0)
        return own - self.config.lambda_xp * strongest, {"real_sp": own, "real_xp": strongest}

    def checkpoint(self) -> State:
        """All that a round leaves."""
        counts = {"rounds": self.rounds, "steps": self.steps}
        return {"best": self.best, "best_score": float(self.best_score), **counts, "samplers": self.samplers.state()}

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue after the checkpoint's round."""
        state = checkpoint.state
        self.best, self.best_score = np.asarray(state["best"]), float(state["best_score"])
        self.rounds, self.steps = int(state["rounds"]), int(state["steps"])
        self.samplers.load_state(state["samplers"])

    def buffers(self) -> State:
        """None."""
        return {}

    def close(self) -> None:
        """End the samplers."""
        self.samplers.end()


def open_training(config: GuessRun, spec: EnvSpec, attempt: str, transport: Transport) -> GuessTraining:
    """See `popgen.methods.training.OpenTraining`."""
    return GuessTraining(config, spec, transport, start_samplers(config, attempt, transport))
