"""The contract between training loops, their workers and operations.

A training loop is a generator of records: what it does next (`Phase`), what happened (`Progress`, `Round`), what came
of it (`TrainedMember`). It writes no file, counts no step in a ledger and prints nothing. One driver for all methods
(`popgen.pipelines.training_driver`) iterates over it, hands each record to the recorder and the reporter, and makes a
checkpoint at a `Round` with `at_rest`. The driver answers a `Round` with True where it wants a checkpoint and the round
was not at rest: the loop then comes to rest soon and yields a `Round` that is.

    training = open_training(...)                 # workers of one attempt
    training.adopt(weights, left)                 # members that are trained already
    members = training.begin(first)               # fresh networks for the members that learn together from `first` on
    training.restore(checkpoint)                  # only where there is one of these members
    for record in training.train(): ...           # ends with a `TrainedMember` for each of `members`
    training.close()

A loop's workers are plain objects. A transport makes them, in this process (here) or as Ray actors
(`popgen.actors.ray_transport`), and hands on what they are asked; every answer is a handle. Handles may be arguments
and parts of answers: whoever needs the value calls `result`.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Concatenate, Generic, NamedTuple, ParamSpec, Protocol, TypeVar

import numpy as np

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.play.episodes import Episode
from popgen.play.policy import Policy
from popgen.types import Kind, Segment, Weights

State = dict[str, Any]
"""Nested dictionaries of arrays and plain values, as `popgen.durable_files` writes them. In a checkpoint a `Pending`
may stand in for a value: the process that writes the files resolves it, so that bulk data does not pass the driver."""

Figures = Mapping[str, float]


class UpdateFigures:
    """Figures of one task's updates, and the time since it began, in this process.

    Attributes:
        values: of each figure, an entry for each update that gave it.
    """

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = defaultdict(list)
        self._began, self._began_cpu = time.perf_counter(), time.process_time()

    def add(self, figures: Mapping[str, float]) -> None:
        """Take in the figures of one update."""
        for name, value in figures.items():
            self.values[name].append(value)

    def means(self) -> dict[str, float]:
        """Mean of each figure over the updates."""
        return {name: float(np.mean(values)) for name, values in self.values.items()}

    def seconds(self) -> float:
        """Seconds since the task began."""
        return time.perf_counter() - self._began

    def cpu_seconds(self) -> float:
        """Processor seconds since the task began."""
        return time.process_time() - self._began_cpu

    def times(self, updates: int) -> dict[str, float]:
        """Seconds and processor seconds of the task so far, and milliseconds of each of its `updates`."""
        seconds = self.seconds()
        return {"seconds": seconds, "cpu_seconds": self.cpu_seconds(), "update_ms": 1000.0 * seconds / max(1, updates)}


def named_figures(learner: str, metrics: Figures) -> dict[str, float]:
    """A learner's metrics as figures of the run: `LEARNER/NAME`."""
    return {f"{learner}/{name}": value for name, value in metrics.items()}


T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
W = TypeVar("W")
W_co = TypeVar("W_co", covariant=True)
P = ParamSpec("P")


class Pending(Protocol[T_co]):
    """A handle of work that may still be going on: in this process or elsewhere."""

    def result(self) -> T_co:
        """Wait for it; raises what the work raised."""
        ...


Segments = Mapping[Kind, Pending[list[Segment]]]
"""Handles of segments by kind: whoever passes them on need not look into them."""


@dataclass(frozen=True)
class PolicySnapshot:
    """A policy as it travels to a sampler: kind, configuration and a handle of its weights."""

    kind: str
    config: dict[str, Any]
    weights: Pending[Weights]


# ---- environment steps -----------------------------------------------------------------------------------------------


class SegmentCount(NamedTuple):
    """What the ledger needs of one segment: its match, running number and environment steps."""

    kind: Kind
    members: tuple[int, int]
    sequence: int
    steps: int


@dataclass(frozen=True)
class Collected:
    """What the ledger and the loop need of one call of a sampler, beside the segments themselves.

    Attributes:
        sampler: its name, unique to the run's attempt.
        counts: one entry per segment.
        episodes: those that ended.
        cpu_seconds: of the sampler.
    """

    sampler: str
    counts: list[SegmentCount]
    episodes: list[Episode]
    cpu_seconds: float = 0.0

    @property
    def steps(self) -> int:
        """Environment steps of the call."""
        return sum(count.steps for count in self.counts)


@dataclass(frozen=True)
class Sampled:
    """Real steps of one call of a sampler.

    Attributes:
        collected: their counts.
        segments: the segments themselves by kind, for buffers and the checkpoint's log; empty where neither wants them.
    """

    collected: Collected
    segments: Segments = field(default_factory=dict)


@dataclass(frozen=True)
class StepCount:
    """Steps that no sampler of ours took: of an exact simulator, of RLlib's runners. One entry of the ledger."""

    member: int
    kind: Kind
    sampler: str
    sequence: int
    steps: int
    episodes: int
    score: float = 0.0


# ---- records of a loop -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Phase:
    """Something new begins.

    Attributes:
        name: the same for all members: "self-play".
        total: its amount of work in any unit, which `Progress.done` counts.
        member: whom it trains.
        last: the last of those it trains together; 0 where that is `member`.
        done: of the total, before it begins: a phase may go on where an earlier attempt was.
        ends_at: of the total, as in `Progress`.
    """

    name: str
    total: float
    member: int
    last: int = 0
    done: float = 0.0
    ends_at: float | None = None


@dataclass(frozen=True)
class PlannedPhase:
    """A phase that a run is expected to have, for the estimate of the time left.

    Attributes:
        name, member, last: as those of `Phase`.
        cost: seconds that its total takes on two laptop cores, roughly: what counts is the ratio of phases. By kind of
            work where it has several, or one that other phases have too (the kinds of `Round.work`).
        earliest: share of the total at which it may be over, where a target can end it.
        side_by_side: its kinds of work go on at the same time, so that the longest one counts.
        begins: shares of the total at which kinds of work begin, where that is not the first.
    """

    name: str
    member: int
    cost: float | Mapping[str, float]
    last: int = 0
    earliest: float = 1.0
    side_by_side: bool = False
    begins: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Progress:
    """What happened since the last record; everything but `member` and `steps` may be absent.

    Attributes:
        member: whose training it is.
        steps: this member's environment steps so far, the horizontal axis of its metrics.
        figures: one point of metrics, checked to be finite where `learners` names their first part (`model/loss`).
        sampled: real steps, for the ledger and the checkpoint's log.
        counted: other steps, for the ledger.
        done: of the phase's total.
        ends_at: of the phase's total, where the phase will end as things stand; None where that is open.
        shown: figures of the progress line.
        note: a line for the user.
    """

    member: int
    steps: int
    figures: Figures = field(default_factory=dict)
    sampled: tuple[Sampled, ...] = ()
    counted: tuple[StepCount, ...] = ()
    done: float | None = None
    ends_at: float | None = None
    shown: Mapping[str, float | int | str] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Work:
    """Finished tasks of one kind, and the time and processor time that they took."""

    tasks: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0

    def plus(self, more: Work) -> Work:
        """This work and more of the same kind."""
        return Work(self.tasks + more.tasks, self.seconds + more.seconds, self.cpu_seconds + more.cpu_seconds)


@dataclass(frozen=True)
class Round(Progress):
    """A round has ended.

    Attributes:
        number: rounds of this member that have ended.
        at_rest: nothing is at work, so that a checkpoint may be made.
        must_save: a checkpoint is made whatever the time since the last one.
        work: what each kind of work has done since these rounds began, where several go on side by side.
    """

    number: int = 0
    at_rest: bool = True
    must_save: bool = False
    work: Mapping[str, Work] = field(default_factory=dict)


@dataclass(frozen=True)
class TrainedMember:
    """A member is complete.

    Attributes:
        policy: as it is saved and acts.
        training: further weights that are kept beside it.
        seed: of its training.
        extra: figures for its record.
        left: what it leaves behind for the members after it, see `Training.adopt`.
        note: a line for the user.
    """

    member: int
    policy: Policy
    training: Weights | None
    seed: int
    extra: dict[str, Any]
    left: State = field(default_factory=dict)
    note: str = ""


Record = Phase | Progress | TrainedMember
Loop = Generator[Record, bool | None, None]


# ---- what the driver asks of a method --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint of running members, as it is read.

    Attributes:
        state: what `Training.checkpoint` gave.
        buffers: the last whole copy that `Training.buffers` gave, None if there is none: they start empty.
        log: segments (with the member they were played for) that came after that copy, in order.
    """

    state: State
    buffers: State | None = None
    log: Iterator[tuple[Segments, int]] = field(default_factory=lambda: iter(()))


class Training(Protocol):
    """The training of one run's members in one attempt: workers, and the loop that they work for.

    Attributes:
        learners: first parts of figures' names (`model/loss`) that must be finite: a learner does not recover.
        log_rows: rows in the log from which on a whole copy of the buffers is written; 1 where there is no log.
        begins_workers: `begin` starts workers: the cluster must have room for them then.
    """

    learners: tuple[str, ...]
    log_rows: int
    begins_workers: bool

    def adopt(self, weights: dict[int, Weights], left: State) -> None:
        """Take over finished members: their acting weights, and what the last of them left behind ({} if nothing)."""

    def first_of_group(self, member: int) -> int:
        """The first of the members that learn together with `member`: itself where they learn one after the other."""
        ...

    def plan(self) -> list[PlannedPhase]:
        """The phases of all of the run's members, in order."""
        ...

    def begin(self, first: int) -> tuple[int, ...]:
        """Begin with the members that learn together from `first` on; who they are."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continue where `checkpoint` was made; after `begin`.

        Raises:
            LookupError, TypeError, ValueError: a part is missing or does not fit.
        """

    def train(self) -> Loop:
        """The records from here to the last member that `begin` named.

        Raises:
            FloatingPointError: training diverged.
        """
        ...

    def checkpoint(self) -> State:
        """Everything that `restore` needs; asked for at rest."""
        ...

    def buffers(self) -> State:
        """Whole copies of the buffers, for a log that has become long; {} where a checkpoint needs no log."""
        ...

    def close(self) -> None:
        """End all workers."""


# ---- how workers are reached -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """Where a worker runs: processor cores and cards that it asks for; `with_driver` on the driver's node."""

    cpus: float = 0.0
    gpus: float = 0.0
    with_driver: bool = False


class Worker(Protocol[W_co]):
    """A worker of class W, wherever it is."""

    def ask(self, method: Callable[Concatenate[W_co, P], T], *arguments: P.args, **named: P.kwargs) -> Pending[T]:
        """Have it do `method`, one call after the other in the order of asking."""
        ...

    def end(self) -> None:
        """End it, whatever it is doing."""


class Transport(Protocol):
    """Makes workers and handles."""

    def start(self, kind: Callable[P, W], place: Place, *arguments: P.args, **named: P.kwargs) -> Worker[W]:
        """A worker of class `kind`."""
        ...

    def put(self, value: T) -> Pending[T]:
        """A handle of a value that is there."""
        ...

    def wait(self, pending: Sequence[Pending[Any]], timeout: float | None = None) -> list[Pending[Any]]:
        """Those whose results are there: at least one, or after `timeout` seconds perhaps none."""
        ...


class OpenTraining(Protocol):
    """What a method gives: the start of its workers.

    Args:
        config: of the run.
        spec: of its environment.
        attempt: unique to the run's attempt; part of the samplers' names in the ledger.
        transport: where the workers are.
    """

    def __call__(self, config: RunConfig, spec: EnvSpec, attempt: str, transport: Transport) -> Training: ...


# ---- in this process -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ready(Generic[T]):
    """A handle of a value that is there."""

    value: T

    def result(self) -> T:
        """The value."""
        return self.value


@dataclass(frozen=True)
class InlineWorker(Generic[W]):
    """An object of this process: asked, it works at once."""

    worker: W

    def ask(self, method: Callable[Concatenate[W, P], T], *arguments: P.args, **named: P.kwargs) -> Pending[T]:
        """Call the method."""
        return Ready(getattr(self.worker, method.__name__)(*arguments, **named))

    def end(self) -> None:
        """It ends with the last reference to it."""


@dataclass(frozen=True)
class InlineTransport:
    """Everything in this process, one task after the other: for a notebook, a debugger, a test."""

    def start(self, kind: Callable[P, W], place: Place, *arguments: P.args, **named: P.kwargs) -> Worker[W]:
        """A new object."""
        return InlineWorker(kind(*arguments, **named))

    def put(self, value: T) -> Pending[T]:
        """The value itself, behind a handle."""
        return Ready(value)

    def wait(self, pending: Sequence[Pending[Any]], timeout: float | None = None) -> list[Pending[Any]]:
        """All: nothing is ever waited for."""
        return list(pending)
