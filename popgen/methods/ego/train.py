"""The training loop of ego agents: rollouts beside partners and PPO on them, to the end of the steps.

    for every ego (`population.size`, one by default; they differ by their seeds):
        fresh networks
        until `ego.steps`: play `unroll` steps in all environments, each beside its partner in its seat; update
        add the ego to the population

Where the learner is: `popgen.actors.ego_workers`. What a record leads to: `popgen.pipelines.training_driver`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from popgen.methods.ego.config import EgoRun
from popgen.methods.ego.ego_policy import EgoPolicy
from popgen.methods.ego.ego_rollout import EndedEpisode
from popgen.methods.ego.partner_source import PartnerSource, name_partners
from popgen.methods.ego.workers import Iterations, Workers
from popgen.methods.training import (
    Checkpoint,
    Loop,
    Phase,
    PlannedPhase,
    Progress,
    Round,
    State,
    StepCount,
    TrainedMember,
)
from popgen.nets.weights import prefixed
from popgen.types import Kind, Weights

ROUND = 50_000
"""Environment steps between two records, at least."""

FORGETS = 0.1
"""Share of a partner's running mean score that an episode replaces."""


@dataclass
class EgoProgress:
    """How far an ego's training has come.

    Attributes:
        rounds: records of the loop. steps: of the environment.
        scores: running mean score beside each partner, by its name; `itself` in self-play.
        seconds: of work, over all attempts.
    """

    rounds: int = 0
    steps: int = 0
    scores: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    @staticmethod
    def from_state(state: State) -> EgoProgress:
        """Of a checkpoint."""
        scores = {str(name): float(value) for name, value in state["scores"].items()}
        return EgoProgress(int(state["rounds"]), int(state["steps"]), scores, float(state["seconds"]))

    def note_episodes(self, episodes: Sequence[EndedEpisode], names: Sequence[str]) -> None:
        """Take the scores of whole episodes into the running means."""
        for episode in episodes:
            name = "itself" if episode.partner < 0 else names[episode.partner]
            before = self.scores.get(name, episode.score)
            self.scores[name] = before + FORGETS * (episode.score - before)


STEP_SECONDS = 1e-4  # of an environment step and what is learned from it, on a laptop's core


class EgoTraining:
    """The training of one run's egos in one attempt (`popgen.methods.training.Training`)."""

    learners = ("learner",)
    log_rows = 1  # no log: the learner's state holds its running episodes
    begins_workers = False

    def __init__(
        self,
        config: EgoRun,
        policy: EgoPolicy,
        unit: str,
        attempt: str,
        workers: Workers,
        sources: Sequence[PartnerSource],
    ) -> None:
        self.run, self.config, self.policy, self.unit = config, config.ego, policy, unit
        self.attempt, self.workers, self.sources = attempt.rpartition(".")[2], workers, list(sources)
        self.names = name_partners(self.sources)
        self.kind = Kind.SP if config.plays_itself else Kind.XP
        self.member, self.seed, self.progress = 0, 0, EgoProgress()
        self.size = config.population.size

    def train(self) -> Loop:
        """Iterations until the steps are done."""
        config, now = self.config, self.progress
        yield Phase(self._name_phase(), config.steps, self.member, done=now.steps)
        if now.rounds:
            yield Progress(self.member, now.steps, note=f"continuing after {now.steps:,} steps of ego {self.member}")
        size = config.envs * config.unroll
        while now.steps < config.steps:
            count = min(-(-ROUND // size), -(-(config.steps - now.steps) // size))
            began = time.perf_counter()
            done = self.workers.iterate(count).result()
            now.seconds += time.perf_counter() - began
            yield self._end_round(done)
        yield self._finish_ego()

    def _end_round(self, done: Iterations) -> Round:
        now = self.progress
        now.note_episodes(done.episodes, self.names)
        score = float(sum(episode.score for episode in done.episodes))
        name = f"ego.{self.attempt}"
        counted = [StepCount(self.member, self.kind, name, now.rounds, done.steps, len(done.episodes), score)]
        if done.simulated:
            counted.append(StepCount(self.member, Kind.SIMULATED, name, now.rounds, done.simulated, 0))
        now.rounds, now.steps = now.rounds + 1, now.steps + done.steps
        figures = {f"learner/{name}": value for name, value in done.figures.items()}
        figures |= {f"score/{name}": value for name, value in now.scores.items()}
        shown: dict[str, float] = {"steps": now.steps}
        if now.scores:
            mean, least = float(np.mean(list(now.scores.values()))), min(now.scores.values())
            figures |= {"score": mean, "score_least": least}
            shown |= {self.unit: round(mean, 2), "least": round(least, 2)}
        return Round(
            self.member,
            now.steps,
            figures,
            counted=tuple(counted),
            done=min(now.steps, self.config.steps),
            shown=shown,
            number=now.rounds,
        )

    def _finish_ego(self) -> TrainedMember:
        now, scores = self.progress, self.progress.scores
        self.policy.load(self.workers.acting().result())
        extra = {
            "trained_with": [source.as_dict() for source in self.sources],
            "scores_in_training": scores,
            "seconds": round(now.seconds, 1),
        }
        reached = f", {np.mean(list(scores.values())):.2f} {self.unit} in training" if scores else ""
        note = f"ego {self.member}: {now.steps:,} steps in {now.seconds / 60:.1f} min{reached}"
        critics = prefixed("critics", self.workers.critics().result())
        return TrainedMember(self.member, self.policy, critics, self.seed, extra, note=note)

    # ---- egos and checkpoints ------------------------------------------------------------------------------------

    def adopt(self, weights: dict[int, Weights], left: State) -> None:
        """An ego takes nothing over from those before it; see `Training`."""

    def first_of_group(self, member: int) -> int:
        """Egos learn one after the other."""
        return member

    def _name_phase(self) -> str:
        beside = f"{len(self.names)} partner{'s' * (len(self.names) > 1)}" if self.names else "itself"
        return f"play beside {beside}"

    def plan(self) -> list[PlannedPhase]:
        """See `Training`."""
        name, cost = self._name_phase(), self.config.steps * STEP_SECONDS
        return [PlannedPhase(name, member, cost) for member in range(1, self.size + 1)]

    def begin(self, first: int) -> tuple[int, ...]:
        """See `Training`."""
        self.member, self.seed, self.progress = first, self.run.run.seed * 1000 + first, EgoProgress()
        self.workers.begin_member(self.seed).result()
        return (first,)

    def checkpoint(self) -> State:
        """See `Training`."""
        return {"learner": self.workers.state(), "progress": asdict(self.progress)}

    def restore(self, checkpoint: Checkpoint) -> None:
        """See `Training`."""
        self.workers.load_state(checkpoint.state["learner"])
        self.progress = EgoProgress.from_state(checkpoint.state["progress"])

    def buffers(self) -> State:
        """There are none."""
        return {}

    def close(self) -> None:
        """See `Training`."""
        self.workers.end()
