"""Several kinds of work side by side: sampling, world-model learning and agent learning.

`sync` starts one task of each kind, waits for all, and gives the results in a fixed order: whatever the timing, the
next round sees the same. `async` starts a task of a kind as soon as its last one is done. Samplers may be one task
ahead of the slowest kind, so that no work piles up before a slow learner. A learner need not wait for another learner,
and may do up to `overlap` tasks for each of the samplers'.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from typing import Any

from popgen.config.sections import RunSection
from popgen.methods.training import Pending, Work

AHEAD = 1

Wait = Callable[[Sequence[Pending[Any]]], list[Pending[Any]]]


class Overlap:
    """Which kinds may start, which have results.

    Args:
        kinds: in the order in which a round gives their results.
        learners: those that need not wait for each other.
        schedule: "sync" or "async".
        overlap: tasks that a learner may do for each of the samplers'.
        wait: gives the handles whose results are there, at least one.

    Attributes:
        running: handles of the tasks at work, by kind.
        done: finished tasks of each kind.
        staleness: of each kind's last task, the tasks of other kinds that ended while it ran: by so many rounds at
            most were its inputs out of date at its end (0 with `sync`, where results are taken in together).
        work: finished tasks of each kind, with the time that they took.
    """

    def __init__(
        self, kinds: Sequence[str], learners: Collection[str], *, schedule: str, overlap: int, wait: Wait
    ) -> None:
        self.kinds, self.learners = list(kinds), list(learners)
        self.schedule, self.overlap, self.wait = schedule, overlap, wait
        self.running: dict[str, Pending[Any]] = {}
        self.done = dict.fromkeys(kinds, 0)
        self.staleness = dict.fromkeys(kinds, 0)
        self.work = dict.fromkeys(kinds, Work())
        self.began = time.perf_counter()
        self._done_at_start: dict[str, dict[str, int]] = {}
        self._rounds = 0

    @staticmethod
    def of_run(run: RunSection, samplers: Sequence[str], learners: Sequence[str], wait: Wait) -> Overlap:
        """Of samplers, whose results come first, and learners, as the run's section says."""
        kinds = [*samplers, *learners]
        return Overlap(kinds, learners, schedule=run.schedule, overlap=run.overlap, wait=wait)

    def startable(self) -> list[str]:
        """Kinds that may start a task now."""
        if self.schedule == "sync":
            return [] if self.running else self.kinds
        return [kind for kind in self.kinds if kind not in self.running and self._may_start(kind)]

    def _may_start(self, kind: str) -> bool:
        """With `async`: is a kind not too far ahead?"""
        samplers = [done for other, done in self.done.items() if other not in self.learners]
        if kind in self.learners and samplers:
            return self.done[kind] < self.overlap * (min(samplers) + 1)
        return self.done[kind] <= min(self.done.values()) + AHEAD

    def start(self, kind: str, pending: Pending[Any]) -> None:
        """A task of a kind is at work."""
        self._done_at_start[kind] = dict(self.done)
        self.running[kind] = pending

    def finish(self) -> list[tuple[str, Any]]:
        """Wait for results: (kind, result) of all tasks (sync) or of those that are done (async).

        With `sync` all results are there before the first is given: what is taken in, such as new rows in a buffer,
        would else reach the tasks still at work.
        """
        handles = list(self.running.values())
        ready = handles if self.schedule == "sync" else self.wait(handles)
        kinds = [kind for kind in self.kinds if any(self.running.get(kind) is handle for handle in ready)]
        results = [(kind, self.running.pop(kind).result()) for kind in kinds]
        if self.schedule == "sync":
            for kind in kinds:
                self.done[kind] += 1
        return results

    def record_finished(self, kind: str, finished: Work) -> None:
        """Count a task of a kind whose result has been applied, and the time that it took."""
        if self.schedule != "sync":
            before = self._done_at_start[kind]
            others = [self.done[other] - before[other] for other in self.done if other != kind]
            self.staleness[kind] = max(others, default=0)
            self.done[kind] += 1
        self.work[kind] = self.work[kind].plus(finished)

    def round_ended(self) -> bool:
        """Whether the slowest kind has advanced since the last call that said so."""
        ended = min(self.done.values()) > self._rounds
        self._rounds = min(self.done.values())
        return ended

    def figures(self) -> dict[str, float]:
        """staleness/KIND; queue/KIND, the tasks that a kind is ahead of the slowest; idle/LEARNER, the share of the
        time since the rounds began in which it was not at work."""
        slowest, passed = min(self.done.values()), max(1e-9, time.perf_counter() - self.began)
        figures = {f"staleness/{kind}": float(value) for kind, value in self.staleness.items()}
        figures |= {f"queue/{kind}": float(done - slowest) for kind, done in self.done.items()}
        idle = {f"idle/{kind}": max(0.0, 1.0 - self.work[kind].seconds / passed) for kind in self.learners}
        return figures | idle
