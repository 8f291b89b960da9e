"""Three kinds of work side by side: sampling, world-model learning and agent learning.

`sync` starts one task of each, waits for all, and takes the results in a fixed order: whatever the timing, the next
round sees the same. `async` starts a task of a kind as soon as its last one is done. Samplers are held back as soon as
they are `AHEAD` rounds before the slowest kind, so that no work piles up before a slow learner; a learner need not
wait for another learner, and may do up to `overlap` rounds for each of the samplers'.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import ray

AHEAD = 1

Start = Callable[[], Any]
Finish = Callable[[Any], None]


class Pace:
    """How the kinds of work keep up with each other.

    Attributes:
        done: finished tasks of each kind.
        staleness: of each kind's last task, the tasks of other kinds that ended while it ran: by so many rounds at
            most were its inputs out of date at its end (0 with `sync`, where results are taken in together).
    """

    def __init__(self, kinds: Collection[str], learners: Collection[str] = (), overlap: int = 1) -> None:
        self.done = dict.fromkeys(kinds, 0)
        self.staleness = dict.fromkeys(kinds, 0)
        self.learners, self.overlap = [name for name in kinds if name in learners], overlap
        self._seen: dict[str, dict[str, int]] = {}

    def may_start(self, name: str) -> bool:
        """With `async`: is a kind not too far ahead?"""
        samplers = [done for kind, done in self.done.items() if kind not in self.learners]
        if name in self.learners and samplers:
            return self.done[name] < self.overlap * (min(samplers) + 1)
        return self.done[name] <= min(self.done.values()) + AHEAD

    def started(self, name: str) -> None:
        """A task of a kind has begun."""
        self._seen[name] = dict(self.done)

    def ended(self, name: str) -> None:
        """It is done."""
        seen = self._seen.pop(name)
        self.staleness[name] = max((self.done[o] - seen[o] for o in self.done if o != name), default=0)
        self.done[name] += 1

    def figures(self) -> dict[str, float]:
        """For the log: staleness/KIND, and queue/KIND, the rounds that a kind is ahead of the slowest."""
        slowest = min(self.done.values())
        queue = {f"queue/{name}": float(done - slowest) for name, done in self.done.items()}
        return {f"staleness/{name}": float(value) for name, value in self.staleness.items()} | queue


def run_rounds(
    work: dict[str, tuple[Start, Finish]],
    *,
    stop: Callable[[], bool],
    after: Callable[[], None],
    schedule: str,
    due: Callable[[], bool] = lambda: False,
    save: Callable[[], None] = lambda: None,
    pace: Pace | None = None,
) -> dict[str, int]:
    """Work until `stop()`; every task that was started is also finished.

    Args:
        work: kind -> (start, returning an object reference or several; finish, given the result).
        stop: asked before a round (sync) or a task (async) is started.
        after: called after each round, that is, whenever the slowest kind has advanced.
        schedule: "sync" or "async".
        due, save: whether to save, asked after each round, and how; nothing is at work when `save` is called, which
            in `async` means that all kinds come to a halt first.
        pace: of the same kinds; without one, no kind is a learner's.

    Returns:
        Finished tasks per kind.
    """
    pace = pace or Pace(work)
    if schedule == "sync":
        while not stop():
            pending = {name: start() for name, (start, _) in work.items()}
            # All first: a result taken in earlier, such as new rows in a replay, would reach the tasks still at work.
            results = {name: _get(reference) for name, reference in pending.items()}
            for name, (_, finish) in work.items():
                finish(results[name])
                pace.done[name] += 1
            after()
            if due():
                save()
        return pace.done
    return _overlapping(work, pace, stop, after, due, save)


def _overlapping(
    work: dict[str, tuple[Start, Finish]],
    pace: Pace,
    stop: Callable[[], bool],
    after: Callable[[], None],
    due: Callable[[], bool],
    save: Callable[[], None],
) -> dict[str, int]:
    running: dict[str, Any] = {}
    saving, done = False, pace.done
    while True:
        if saving and not running:
            save()
            saving = False
        if not saving and not stop():
            for name, (start, _) in work.items():
                if name not in running and pace.may_start(name):
                    pace.started(name)
                    running[name] = start()
        if not running:
            return done
        ready, _ = ray.wait([_last(reference) for reference in running.values()], num_returns=1)
        rounds = min(done.values())
        for name in [name for name, reference in running.items() if _last(reference) in ready]:
            work[name][1](_get(running.pop(name)))
            pace.ended(name)
        if min(done.values()) > rounds:
            after()
            saving = saving or due()


def _last(reference: Any) -> Any:
    return reference[-1] if isinstance(reference, (list, tuple)) else reference


def _get(reference: Any) -> Any:
    """Results of a task; of one with several results, all but the last stay in the object store."""
    if isinstance(reference, (list, tuple)):
        return (*reference[:-1], ray.get(reference[-1]))
    return ray.get(reference)
