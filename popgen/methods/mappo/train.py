"""The baselines' training loop on RLlib (paper, section 2.2): MAPPO self-play, LIPO and CoMeDi.

    for every group of members that learn together (LIPO: all; MAPPO and CoMeDi: one after the other):
        until the budget is used up or the targets are reached:
            choose each member's partner, sample, update     (one `train()` of `popgen.methods.mappo.algorithm.Mappo`)
        add them to the archive

What is sampled, and how it enters the objective: `lipo.py`, `comedi.py`. RLlib holds the runners and the learner, and
gives no more than this loop over its iterations.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import torch

from popgen.config.sections import ClusterConfig
from popgen.envs.contract import EnvSpec
from popgen.errors import UserError
from popgen.methods.mappo.algorithm import Mappo, build_algorithm
from popgen.methods.mappo.config import BaselineRun, DiversityConfig, PartnerRun
from popgen.methods.mappo.needs import refuse_inline
from popgen.methods.mappo.objective import SELF_PLAY, Objective
from popgen.methods.mappo.play_record import Counted
from popgen.methods.mappo.training_job import Job, policy_config
from popgen.methods.training import (
    Checkpoint,
    InlineTransport,
    Loop,
    Phase,
    PlannedPhase,
    Progress,
    Record,
    Round,
    State,
    StepCount,
    TrainedMember,
    Transport,
)
from popgen.nets.weights import prefixed
from popgen.policies.feed_forward_policy import FeedForwardPolicy
from popgen.types import Kind, Weights

SCORES = ("sp", "sp_noisy", "xp")
"""Figures of whole episodes, `real_...` in the metrics; an iteration lacks them until some have ended. `sp_noisy` is
beside a member's own policy with random actions (E3T)."""


def name_figure(name: str) -> str:
    """A figure's name in the metrics: `real_NAME` for scores, `ppo/NAME` for a learner's; `OF/NAME` has its own."""
    return f"real_{name}" if name in SCORES else name if "/" in name else f"ppo/{name}"


def title_score(name: str) -> str:
    """A score's name in a line: SP, SP NOISY, XP."""
    return name.upper().replace("_", " ")


@dataclass
class GroupProgress:
    """How far the training of the members that learn together has come.

    Attributes:
        sequence: number of the next step count, over all members of the run.
        seconds: that the training took before this attempt.
        steps: member -> its environment steps.
    """

    sequence: int = 0
    seconds: float = 0.0
    steps: dict[int, int] = field(default_factory=dict)

    @staticmethod
    def from_state(state: State) -> GroupProgress:
        """Of a checkpoint."""
        steps = {int(member): int(count) for member, count in state["steps"].items()}
        return GroupProgress(int(state["sequence"]), float(state["seconds"]), steps)


def partner_settings(objective: Objective, config: BaselineRun) -> DiversityConfig | None:
    """Those of a run that meets partners; None for self-play alone."""
    return config.diversity if objective.meets_partners and isinstance(config, PartnerRun) else None


def learning_members(objective: Objective, config: BaselineRun, first: int) -> tuple[int, ...]:
    """The members that learn together with `first`."""
    diversity = partner_settings(objective, config)
    together = objective.together or diversity is not None and diversity.order == "concurrent"
    return tuple(range(1, config.population.size + 1)) if together else (first,)


def training_job(
    objective: Objective, config: BaselineRun, learning: tuple[int, ...], archive: Mapping[int, Weights]
) -> Job:
    """What RLlib is to train; `archive` holds the weights of the members that are finished."""
    diversity, first = partner_settings(objective, config), learning[0]
    return Job(
        env=config.env,
        ppo=config.ppo,
        diversity=diversity,
        learning=learning,
        seed=config.run.seed * 1000 + first,
        frozen={member: archive[member] for member in range(1, first)} if diversity else {},
        mixed=diversity is not None and objective.samples(Kind.MP, diversity),
        fresh=objective.fresh_episodes,
        bonus=objective.bonus,
        bonus_score=objective.bonus_score,
        pairs={member: -member for member in learning} if objective.noise > 0.0 else {},
        noise=objective.noise,
    )


def check_card(cluster: ClusterConfig) -> None:
    """A learner that asks for a GPU finds one in this process.

    Raises:
        UserError: there is none.
    """
    if cluster.agent_gpus > 0.0 and not torch.cuda.is_available():
        problem = f"{cluster.agent_gpus:g}, but the driver, in whose process the baselines learn, sees no GPU"
        raise UserError("cluster.agent_gpus", problem, "set it to 0, or start the driver where there is one")


STEP_SECONDS = 1.2e-4  # of an environment step and what is learned from it, on a laptop's core


class RllibTraining:
    """The training of one run's members in one attempt (`popgen.methods.training.Training`)."""

    learners = ("ppo", *(f"real_{name}" for name in SCORES))
    log_rows = 1  # no log: there are no buffers
    begins_workers = True  # RLlib starts its runners with every group of members

    def __init__(self, config: BaselineRun, spec: EnvSpec, attempt: str, objective: Objective) -> None:
        self.config, self.spec, self.attempt, self.objective = config, spec, attempt, objective
        self.archive: dict[int, Weights] = {}
        self.learning: tuple[int, ...] = ()
        self.progress = GroupProgress()
        self.began = time.time()
        self._algorithm: Mappo | None = None

    @property
    def algorithm(self) -> Mappo:
        """Of the members that learn.

        Raises:
            RuntimeError: none have begun.
        """
        if self._algorithm is None:
            raise RuntimeError("begin comes first")
        return self._algorithm

    def train(self) -> Loop:
        """Iterations, to the end of all members that learn together."""
        first, last, algorithm = self.learning[0], self.learning[-1], self.algorithm
        names = f"member {first}" + (f" to {last}" if last > first else "")
        yield Phase(self.config.method, 1.0, first, last, done=min(1.0, algorithm.progress))
        if algorithm.rounds:
            steps = self.progress.steps[first]
            yield Progress(first, steps, note=f"continuing after {algorithm.rounds} iterations of {names}")
        while not algorithm.finished:
            algorithm.train()
            yield from self.report_iteration()
            yield self._end_round()
        yield from self.finish_members()
        self.close()

    def report_iteration(self) -> Loop:
        """An iteration's step counts, then each member's figures."""
        report, ppo, now = self.algorithm.report, self.config.ppo, self.progress
        counts: list[StepCount] = []
        for number, one in enumerate(self.assign_counts(report.counted), now.sequence):
            name = f"runner{one.runner}.{self.attempt}"
            counts.append(StepCount(one.owner, one.kind, name, number, one.steps, one.episodes, one.score))
            now.steps[one.owner] += one.steps
        now.sequence += len(counts)
        first = self.learning[0]
        yield Progress(first, now.steps[first], counted=tuple(counts))
        for runner in report.lost:
            text = f"runner {runner} was lost: its environments are missing until Ray has restarted it"
            yield Progress(first, now.steps[first], note=text)
        update_ms = 1000.0 * report.seconds["learning"] / (ppo.epochs * ppo.minibatches)
        for member, figures in self.figures_by_member().items():
            shown = {name_figure(name): value for name, value in figures.items()}
            shown |= {"ppo/update_ms": update_ms, "iteration": self.algorithm.rounds}
            yield Progress(member, now.steps[member], shown)

    def assign_counts(self, counted: Sequence[Counted]) -> list[Counted]:
        """An iteration's counts, each for the member as whose it goes to the ledger."""
        return [replace(one, owner=self.member_of(one.owner)) for one in counted]

    def member_of(self, trained: int) -> int:
        """For which member the steps of one of RLlib's policies count."""
        return trained

    def figures_by_member(self) -> dict[int, dict[str, float]]:
        """The last iteration's, of the members that learn."""
        return {member: self.algorithm.report.figures[member] for member in self.learning}

    def _end_round(self) -> Round:
        """The last iteration is kept in any case: members are added one after the other, which may be interrupted."""
        algorithm, steps = self.algorithm, self.progress.steps
        scores = [algorithm.scores(member) for member in algorithm.job.owners]
        by_name = {title_score(name): [score[name] for score in scores if name in score] for name in SCORES}
        means = {name: round(sum(values) / len(values), 2) for name, values in by_name.items() if values}
        return Round(
            self.learning[-1],
            steps[self.learning[-1]],
            done=min(1.0, algorithm.progress),
            shown={"steps": sum(steps.values()), **means},
            number=algorithm.rounds,
            must_save=algorithm.finished,
        )

    def finish_members(self) -> Iterator[Record]:
        """All that this training gives, and what is to be said of it."""
        for member in self.learning:
            yield self.finish_member(member)

    def finish_member(self, member: int, trained: int | None = None) -> TrainedMember:
        """The actor as it is saved, its critics beside it; `trained` is its number in RLlib, where that is another."""
        algorithm, seconds = self.algorithm, self._count_seconds()
        number = member if trained is None else trained
        policy = FeedForwardPolicy.from_parts(policy_config(self.config.ppo), algorithm.actors()[number], self.spec)
        self.archive[member] = policy.weights()
        scores = algorithm.scores(number)
        extra = {**scores, "iterations": algorithm.rounds, "seconds": round(seconds / len(self.learning), 1)}
        extra["target"] = self.config.ppo.target_score
        parts = ", ".join(f"{title_score(name)} {value:.2f}" for name, value in scores.items())
        parts = f"{parts} {self.spec.score_name}" if parts else "no whole episode"
        steps = f"{self.progress.steps[member]:,} environment steps"
        return TrainedMember(
            member,
            policy,
            prefixed("critics", algorithm.critics(number)),
            seed=self.config.run.seed * 1000 + member,
            extra=extra,
            left={"sequence": self.progress.sequence},
            note=f"member {member}: {parts} in training, {steps}, {seconds / 60:.1f} min",
        )

    def _count_seconds(self) -> float:
        return self.progress.seconds + time.time() - self.began

    # ---- members and checkpoints ---------------------------------------------------------------------------------

    def adopt(self, weights: dict[int, Weights], left: State) -> None:
        """See `Training`."""
        self.archive = dict(weights)
        self.progress.sequence = int(left.get("sequence", 0))

    def first_of_group(self, member: int) -> int:
        """See `Training`."""
        return learning_members(self.objective, self.config, member)[0]

    def plan(self) -> list[PlannedPhase]:
        """See `Training`."""
        diversity, steps = partner_settings(self.objective, self.config), self.config.ppo.max_steps
        met = diversity.xp_envs / self.config.ppo.envs if diversity is not None else 0.0
        phases, first = list[PlannedPhase](), 1
        while first <= self.config.population.size:
            last = learning_members(self.objective, self.config, first)[-1]
            cost = (last - first + 1) * (1.0 + met * (last - 1)) * steps * STEP_SECONDS
            phases.append(PlannedPhase(self.config.method, first, cost, last, earliest=0.0))
            first = last + 1
        return phases

    def begin(self, first: int) -> tuple[int, ...]:
        """Start RLlib's learner and runners.

        Raises:
            UserError: the card that the recipe asks for is not there.
        """
        check_card(self.config.cluster)
        self.learning = learning_members(self.objective, self.config, first)
        self.progress = GroupProgress(self.progress.sequence, steps=dict.fromkeys(self.learning, 0))
        self._algorithm = build_algorithm(self.make_job(), self.spec, self.config.cluster)
        self.began = time.time()
        return self.learning

    def make_job(self) -> Job:
        """What RLlib is to train for the members that learn."""
        return training_job(self.objective, self.config, self.learning, self.archive)

    def checkpoint(self) -> State:
        """See `Training`."""
        progress = asdict(self.progress) | {"seconds": self._count_seconds()}
        progress["steps"] = {str(member): steps for member, steps in self.progress.steps.items()}
        return {"algorithm": self.algorithm.snapshot(), "progress": progress}

    def restore(self, checkpoint: Checkpoint) -> None:
        """See `Training`."""
        self.algorithm.resume(checkpoint.state["algorithm"])
        self.progress = GroupProgress.from_state(checkpoint.state["progress"])

    def buffers(self) -> State:
        """There are none."""
        return {}

    def close(self) -> None:
        """End RLlib's workers."""
        if self._algorithm is not None:
            self._algorithm.stop()
            self._algorithm = None


def open_rllib(
    config: BaselineRun, spec: EnvSpec, attempt: str, transport: Transport, objective: Objective
) -> RllibTraining:
    """The training of an objective; RLlib starts its own workers.

    Raises:
        UserError: everything is to be in this process, which RLlib cannot do without Ray.
    """
    check_transport(transport)
    return RllibTraining(config, spec, attempt, objective)


def check_transport(transport: Transport) -> None:
    """RLlib starts its own workers.

    Raises:
        UserError: everything is to be in this process.
    """
    if isinstance(transport, InlineTransport):
        refuse_inline()


def open_training(config: BaselineRun, spec: EnvSpec, attempt: str, transport: Transport) -> RllibTraining:
    """MAPPO alone: members differ by their seeds. See `popgen.methods.training.OpenTraining`."""
    return open_rllib(config, spec, attempt, transport, SELF_PLAY)
