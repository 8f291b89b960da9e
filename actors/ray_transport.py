"""Workers as Ray actors: the same calls as in `popgen.methods.training`, sent to other processes and machines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from popgen.actors.actor_setup import options
from popgen.config.sections import ClusterConfig
from popgen.methods.training import Pending, Place, Worker

W = TypeVar("W")
T = TypeVar("T")
P = ParamSpec("P")


@dataclass(frozen=True)
class RayPending(Generic[T]):
    """A handle of an object in Ray's store, or of one that will be there; it may travel to other processes."""

    reference: Any

    def result(self) -> T:
        """Wait for the object and fetch it to this process."""
        return ray.get(self.reference)


@dataclass(frozen=True)
class RayWorker(Generic[W]):
    """The driver's end of an actor."""

    handle: Any

    def ask(self, method: Callable[Concatenate[W, P], T], *arguments: P.args, **named: P.kwargs) -> Pending[T]:
        """Send the call; the actor takes calls in the order in which they were sent."""
        return RayPending(getattr(self.handle, method.__name__).remote(*arguments, **named))

    def end(self) -> None:
        """End the actor's process."""
        ray.kill(self.handle)


@dataclass(frozen=True)
class RayTransport:
    """Actors by the resources of conf/cluster."""

    cluster: ClusterConfig

    def start(self, kind: Callable[P, W], place: Place, *arguments: P.args, **named: P.kwargs) -> Worker[W]:
        """A new actor; a worker with the driver reads and writes the driver's files."""
        if place.with_driver:
            here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
            chosen = {"num_cpus": place.cpus, "scheduling_strategy": here}
        else:
            chosen = options(self.cluster, place.cpus, place.gpus)
        actor: Any = ray.remote(kind)  # type: ignore[arg-type]
        return RayWorker(actor.options(**chosen).remote(*arguments, **named))

    def put(self, value: T) -> Pending[T]:
        """Into the object store."""
        return RayPending(ray.put(value))

    def wait(self, pending: Sequence[Pending[Any]], timeout: float | None = None) -> list[Pending[Any]]:
        """Those that are done first."""
        by_reference = {one.reference: one for one in pending if isinstance(one, RayPending)}
        ready, _ = ray.wait(list(by_reference), num_returns=1, timeout=timeout)
        return [by_reference[reference] for reference in ready]
