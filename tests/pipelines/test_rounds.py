"""The two schedules, with a Ray that finishes tasks in a given order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from popgen.pipelines import rounds


@dataclass(frozen=True)
class Reference:
    """To the result of a kind's task; the result is the reference itself."""

    kind: str
    number: int


class Scripted:
    """Stands in for Ray: tasks of the `slow` kind finish after all others."""

    def __init__(self, slow: str = "") -> None:
        self.slow = slow
        self.events: list[tuple[str, Any]] = []

    def get(self, reference: Reference) -> Reference:
        self.events.append(("get", reference.kind))
        return reference

    def wait(self, references: Sequence[Reference], num_returns: int) -> tuple[list[Reference], list[Reference]]:
        first = min(references, key=lambda reference: (reference.kind == self.slow, reference.number, reference.kind))
        return [first], [reference for reference in references if reference != first]


class Log:
    """Three kinds of work that write down what happens."""

    def __init__(self, rounds_wanted: int, scripted: Scripted) -> None:
        self.events = scripted.events
        self.started = dict.fromkeys("abc", 0)
        self.finished = dict.fromkeys("abc", 0)
        self.rounds, self.wanted = 0, rounds_wanted

    def start(self, kind: str) -> Callable[[], Any]:
        def call() -> Any:
            self.started[kind] += 1
            self.events.append(("start", kind))
            reference = Reference(kind, self.started[kind])
            return ["kept in the store", reference] if kind == "b" else reference

        return call

    def finish(self, kind: str) -> Callable[[Any], None]:
        def call(result: Any) -> None:
            self.finished[kind] += 1
            wanted = Reference(kind, self.finished[kind])
            assert result == (("kept in the store", wanted) if kind == "b" else wanted)
            self.events.append(("finish", kind))

        return call

    def after(self) -> None:
        self.rounds += 1
        self.events.append(("after", self.rounds))
        assert min(self.finished.values()) >= self.rounds

    def work(self) -> dict[str, tuple[Any, Any]]:
        return {kind: (self.start(kind), self.finish(kind)) for kind in "abc"}

    def run(self, schedule: str) -> dict[str, int]:
        return rounds.run_rounds(
            self.work(), stop=lambda: self.rounds >= self.wanted, after=self.after, schedule=schedule
        )


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    stand_in = Scripted()
    monkeypatch.setattr(rounds, "ray", stand_in)
    return stand_in


def test_sync_takes_no_result_in_before_all_tasks_are_done(scripted: Scripted) -> None:
    log = Log(2, scripted)
    assert log.run("sync") == {"a": 2, "b": 2, "c": 2}
    one = [(what, kind) for what in ("start", "get", "finish") for kind in "abc"]
    assert log.events == [*one, ("after", 1), *one, ("after", 2)]


@pytest.mark.parametrize("slow", ["a", "b", "c", ""])
def test_async_lets_nobody_run_far_ahead_and_finishes_what_it_started(scripted: Scripted, slow: str) -> None:
    scripted.slow = slow
    log = Log(5, scripted)
    done = log.run("async")
    assert done == log.finished == log.started and log.rounds == min(done.values()) >= 5
    assert max(done.values()) - min(done.values()) <= rounds.AHEAD + 1
    finished = dict.fromkeys("abc", 0)
    started = dict.fromkeys("abc", 0)
    overlap = 0
    for what, kind in log.events:
        if what == "start":
            assert finished[kind] == started[kind], "one task of a kind at a time"
            assert finished[kind] <= min(finished.values()) + rounds.AHEAD
            started[kind] += 1
            overlap += any(finished[kind] > finished[other] for other in "abc")
        elif what == "finish":
            finished[kind] += 1
    assert overlap > 0, "fast kinds go on while a slow one is at work"


@pytest.mark.parametrize("schedule", ["sync", "async"])
def test_nothing_starts_when_there_is_nothing_to_do(scripted: Scripted, schedule: str) -> None:
    assert Log(0, scripted).run(schedule) == {"a": 0, "b": 0, "c": 0}


@pytest.mark.parametrize("schedule", ["sync", "async"])
def test_nothing_is_at_work_while_saving(scripted: Scripted, schedule: str) -> None:
    scripted.slow = "b"
    log, saved = Log(6, scripted), []

    def save() -> None:
        assert log.started == log.finished
        saved.append(log.rounds)
        log.events.append(("save", log.rounds))

    done = rounds.run_rounds(
        log.work(),
        stop=lambda: log.rounds >= 6,
        after=log.after,
        schedule=schedule,
        due=lambda: log.rounds % 2 == 0,
        save=save,
    )
    assert done == log.finished == log.started and len(saved) == 3
    assert saved == [2, 4, 6] if schedule == "sync" else saved[0] >= 2


def test_a_learner_need_not_wait_for_another_but_samplers_do(scripted: Scripted) -> None:
    """`c` is the slowest: the learner `b` goes on, up to three rounds for each of the samplers', `a` is held back."""
    scripted.slow = "c"
    log = Log(4, scripted)
    pace = rounds.Pace(log.work(), learners=("b", "c"), overlap=3)
    ahead, may_start = {"a": 0, "b": 0}, pace.may_start

    def watched(name: str) -> bool:
        for kind in ahead:
            ahead[kind] = max(ahead[kind], pace.done[kind] - pace.done["c"])
        return may_start(name)

    pace.may_start = watched  # type: ignore[method-assign]
    done = rounds.run_rounds(log.work(), stop=lambda: log.rounds >= 4, after=log.after, schedule="async", pace=pace)
    assert done == log.finished == log.started
    assert ahead["a"] == rounds.AHEAD + 1 and ahead["b"] > ahead["a"]
    assert done["b"] <= 3 * (done["a"] + 1)


def test_staleness_is_what_ended_meanwhile() -> None:
    pace = rounds.Pace("abc")
    pace.started("a")
    for _ in range(2):
        pace.started("b")
        pace.ended("b")
    pace.started("c")
    pace.ended("a")
    pace.ended("c")
    assert pace.staleness == {"a": 2, "b": 0, "c": 1}
    figures = pace.figures()
    assert figures["staleness/a"] == 2.0 and figures["queue/b"] == 1.0 and figures["queue/a"] == 0.0
