"""How a training loop's workers are reached: in this process (here) or as Ray actors (`popgen.actors.ray_transport`).

A worker is a plain object. Its transport makes it, and hands on what it is asked; every answer is a handle. Handles may
be arguments and parts of answers: whoever needs the value calls `result`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Concatenate, Generic, ParamSpec, Protocol, TypeVar

from popgen.config.run_config import RunConfig
from popgen.envs.contract import EnvSpec
from popgen.methods.training import Pending, Training

W = TypeVar("W")
W_co = TypeVar("W_co", covariant=True)
T = TypeVar("T")
P = ParamSpec("P")


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
