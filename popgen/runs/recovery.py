"""Recovery: which errors mean that a process or machine died, and how often a run starts again."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator

import ray
from ray import exceptions

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.runs.resources import check_room, demands

ACTOR_FAILURES = (
    exceptions.RayActorError,  # an actor died, or its node cannot be reached
    exceptions.WorkerCrashedError,
    exceptions.NodeDiedError,
    exceptions.LocalRayletDiedError,
    exceptions.ObjectLostError,  # with its owner or its node
    exceptions.OutOfMemoryError,  # Ray ended a process before the machine ran out
    exceptions.RpcError,
    exceptions.RaySystemError,
)
TELL_SECONDS = 60.0
"""Between two lines of a run that waits for nodes."""

FULL = {
    exceptions.ObjectStoreFullError: (
        "cluster.object_store_bytes",
        "Ray's object store is full",
        "raise it, or lower replay.capacity",
    ),
    exceptions.OutOfDiskError: ("disk", "Ray has no room to put objects aside", "make room in Ray's temporary folder"),
}


def iterate_causes(error: BaseException) -> Iterator[BaseException]:
    """The error and what caused it: an actor's error comes wrapped, at times more than once."""
    visited: set[int] = set()
    following: list[BaseException] = [error]
    while following:
        one = following.pop(0)
        if id(one) in visited:
            continue
        visited.add(id(one))
        yield one
        causes = (getattr(one, "cause", None), one.__cause__)
        following += [cause for cause in causes if isinstance(cause, BaseException)]


def actor_failure(error: BaseException) -> BaseException | None:
    """What died, if that is why `error` was raised; None for an error of the work itself."""
    failures = [
        one
        for one in iterate_causes(error)
        if isinstance(one, ACTOR_FAILURES) and not getattr(one, "_actor_init_failed", False)
    ]
    plain = [one for one in failures if not isinstance(one, exceptions.RayTaskError)]
    return next(iter(plain or failures), None)


def user_facing_error(error: BaseException) -> BaseException:
    """The error for a user: what an actor raised for one, and what is Ray's way to say that a limit is reached."""
    for one in iterate_causes(error):
        if type(one) is UserError:
            return one
        for kind, (field, problem, fix) in FULL.items():
            if isinstance(one, kind):
                return UserError(field, problem, fix)
    return error


class RetryBudget:
    """Counts deaths without progress between them.

    Args:
        retries: how many of them are borne.
    """

    def __init__(self, retries: int) -> None:
        self.retries, self.spent = retries, 0
        self._best: tuple[int, ...] = ()

    def spend(self, progress: tuple[int, ...], cause: BaseException) -> None:
        """A death, after having come as far as `progress`.

        Raises:
            UserError: too many since there was progress.
        """
        self.spent = 1 if progress > self._best else self.spent + 1
        self._best = max(self._best, progress)
        if self.spent > self.retries:
            problem = f"{self.spent} deaths in a row without progress, the last: {first_line(cause)}"
            raise UserError("cluster", problem, "see Ray's logs; the same run.id goes on from the last checkpoint")


def first_line(error: BaseException) -> str:
    """The error's type, whom it concerns if it says so, and what it says first."""
    text = str(error).strip()
    actor = re.search(r"class_name: (\w+)", text)
    whom = f" ({actor[1]})" if actor else ""
    return f"{type(error).__name__}{whom}: {text.partition(chr(10))[0]}"[:300]


def wait_for_room(config: RunConfig, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
    """Until there is room for the actors: after a node of a cluster died, another one may be on its way.

    Raises:
        UserError: there is none within `cluster.wait_seconds`.
    """
    began, pause, wanted, told = clock(), 0.1, demands(config), -math.inf
    while True:
        try:
            return check_room(wanted, [node["Resources"] for node in ray.nodes() if node["Alive"]])
        except UserError as error:
            now = clock()
            left = config.cluster.wait_seconds - (now - began)
            if left <= 0:
                raise
            if now - told >= TELL_SECONDS:
                told = now
                tell(f"waiting {left:.0f} s at most for nodes: {error.problem}; {error.fix}")
        time.sleep(pause)
        pause = min(5.0, 2 * pause)


def nodes_alive() -> bool:
    """Does the cluster answer, with all nodes it ever had? A local Ray without its node is of no use."""
    try:
        return all(node["Alive"] for node in ray.nodes())
    except Exception:  # whatever a dead cluster raises
        return False
