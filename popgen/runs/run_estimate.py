"""The time that a whole run will still take: expected costs of its phases, corrected by what they took so far.

A phase of a name that was seen to end takes as long for the same cost as the one before: member 3 as member 2. Any
other takes as long for its cost as all work so far did. What an earlier attempt did counts as done and as no time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from popgen.methods.training import Phase, PlannedPhase

LEAST_SECONDS, LEAST_SHARE = 2.0, 0.01
"""The running phase is judged by its own speed once so much time and so much of its total has passed."""


@dataclass
class Spent:
    """Seconds that work took, for which cost of the plan."""

    seconds: float = 0.0
    cost: float = 0.0

    def add(self, seconds: float, cost: float) -> None:
        """More of it."""
        self.seconds += seconds
        self.cost += cost

    @property
    def rate(self) -> float | None:
        """Seconds for a cost of 1."""
        return self.seconds / self.cost if self.cost > 0.0 else None


class RunEstimate:
    """What is left of a run's plan.

    Args:
        plan: the phases in order.
        clock: seconds, monotonic.
    """

    def __init__(self, plan: Sequence[PlannedPhase], clock: Callable[[], float] = time.monotonic) -> None:
        self.plan, self.clock = list(plan), clock
        self._ended: dict[str, Spent] = {}  # by name, whole phases: cost of what an early end left out included
        self._work = Spent()
        self._running: PlannedPhase | None = None
        self._total, self._first, self._share, self._began = 1.0, 0.0, 0.0, 0.0

    def begin(self, phase: Phase) -> None:
        """A phase begins: those before it are over. One that the plan does not know takes no time in it."""
        self._end_running()
        places = [i for i, one in enumerate(self.plan) if (one.name, one.member) == (phase.name, phase.member)]
        if places:
            self._running, self.plan = self.plan[places[0]], self.plan[places[0] + 1 :]
            self._total, self._began = phase.total or 1.0, self.clock()
            self._first = self._share = min(1.0, phase.done / self._total)

    def update(self, done: float) -> None:
        """So much of the running phase's total is done."""
        self._share = min(1.0, done / self._total)

    def seconds_left(self) -> float | None:
        """Of the whole run, None as long as nothing was measured."""
        now, work = self._measure_running(), Spent(self._work.seconds, self._work.cost)
        work.add(now.seconds, now.cost)
        if work.rate is None:
            return None
        left = 0.0
        if (running := self._running) is not None:
            end = (max(self._share, running.earliest) + 1.0) / 2.0  # in the middle of where it still may end
            left += running.cost * (end - self._share) * (now.rate or work.rate)
        for phase in self.plan:
            ended = self._ended.get(phase.name, Spent()).rate
            left += phase.cost * (work.rate * (phase.earliest + 1.0) / 2.0 if ended is None else ended)
        return left

    def _measure_running(self) -> Spent:
        """What the running phase took so far; nothing as long as that says little."""
        seconds, share = self.clock() - self._began, self._share - self._first
        if self._running is None or seconds < LEAST_SECONDS or share < LEAST_SHARE:
            return Spent()
        return Spent(seconds, share * self._running.cost)

    def _end_running(self) -> None:
        running, self._running = self._running, None
        if running is not None and self._share > self._first:
            seconds = self.clock() - self._began
            self._work.add(seconds, running.cost * (self._share - self._first))
            self._ended.setdefault(running.name, Spent()).add(seconds, running.cost * (1.0 - self._first))
