"""The two schedules, with handles that are done in a given order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from popgen.methods.training import Work
from popgen.methods.xpm_wm.overlap import AHEAD, Overlap

KINDS = "abc"


@dataclass(frozen=True)
class Handle:
    """Of a kind's task; its result is the handle itself."""

    kind: str
    number: int
    log: list[tuple[str, Any]]

    def result(self) -> Handle:
        self.log.append(("result", self.kind))
        return self


class Rounds:
    """A loop over three kinds of work that writes down what happens; tasks of the `slow` kind are done last."""

    def __init__(self, schedule: str, slow: str = "", learners: str = "", overlap: int = 1) -> None:
        self.log: list[tuple[str, Any]] = []
        self.slow, self.rounds = slow, 0
        self.started = dict.fromkeys(KINDS, 0)
        self.overlap = Overlap(KINDS, learners, schedule=schedule, overlap=overlap, wait=self.wait)

    def wait(self, handles: Sequence[Any]) -> list[Any]:
        return [min(handles, key=lambda handle: (handle.kind == self.slow, handle.number, handle.kind))]

    def run(self, wanted: int, rests: bool = False) -> Iterator[str]:
        """As `FirstMember.play_rounds`: "round" where one ends, "rest" where all work has halted for it."""
        overlap, resting = self.overlap, False
        while True:
            if not resting and self.rounds < wanted:
                for kind in overlap.startable():
                    self.started[kind] += 1
                    self.log.append(("start", kind))
                    overlap.start(kind, Handle(kind, self.started[kind], self.log))
            if not overlap.running:
                if not resting:
                    return
                resting = False
                yield "rest"
                continue
            for kind, result in overlap.finish():
                assert result.kind == kind and result.number == overlap.work[kind].tasks + 1
                self.log.append(("finish", kind))
                overlap.record_finished(kind, Work(1, seconds=1.0, cpu_seconds=0.5))
            if overlap.round_ended():
                self.rounds += 1
                assert min(overlap.done.values()) >= self.rounds
                self.log.append(("round", self.rounds))
                yield "round"
                resting = rests and bool(overlap.running)


def test_sync_takes_no_result_in_before_all_tasks_are_done() -> None:
    rounds = Rounds("sync")
    assert list(rounds.run(2)) == ["round", "round"]
    one = [(what, kind) for what in ("start", "result", "finish") for kind in KINDS]
    assert rounds.log == [*one, ("round", 1), *one, ("round", 2)]
    assert rounds.overlap.done == {"a": 2, "b": 2, "c": 2}


@pytest.mark.parametrize("slow", ["a", "b", "c", ""])
def test_async_lets_nobody_run_far_ahead_and_finishes_what_it_started(slow: str) -> None:
    rounds = Rounds("async", slow)
    list(rounds.run(5))
    done = rounds.overlap.done
    assert done == rounds.started and rounds.rounds == min(done.values()) >= 5
    assert max(done.values()) - min(done.values()) <= AHEAD + 1
    finished, started, ahead = dict.fromkeys(KINDS, 0), dict.fromkeys(KINDS, 0), 0
    for what, kind in rounds.log:
        if what == "start":
            assert finished[kind] == started[kind], "one task of a kind at a time"
            assert finished[kind] <= min(finished.values()) + AHEAD
            started[kind] += 1
            ahead += any(finished[kind] > finished[other] for other in KINDS)
        elif what == "finish":
            finished[kind] += 1
    assert ahead > 0, "fast kinds continue while a slow one is at work"


@pytest.mark.parametrize("schedule", ["sync", "async"])
def test_nothing_starts_when_there_is_nothing_to_do(schedule: str) -> None:
    rounds = Rounds(schedule)
    assert list(rounds.run(0)) == [] and rounds.started == {"a": 0, "b": 0, "c": 0}


def test_async_comes_to_rest_where_a_checkpoint_is_wanted() -> None:
    rounds, rests = Rounds("async"), 0
    for event in rounds.run(6, rests=True):
        if event == "rest":
            rests += 1
            assert not rounds.overlap.running and rounds.overlap.done == rounds.started
    assert rests > 0 and rounds.rounds >= 6


def test_sync_is_at_rest_after_every_round() -> None:
    rounds = Rounds("sync")
    assert all(not rounds.overlap.running for _ in rounds.run(3))


def test_a_learner_need_not_wait_for_another_but_samplers_do() -> None:
    """`c` is the slowest: the learner `b` continues, up to three tasks for each of the samplers', `a` is held back."""
    rounds = Rounds("async", "c", learners="bc", overlap=3)
    list(rounds.run(4))
    finished, ahead = dict.fromkeys(KINDS, 0), {"a": 0, "b": 0}
    for what, kind in rounds.log:
        if what == "finish":
            finished[kind] += 1
            ahead = {name: max(most, finished[name] - finished["c"]) for name, most in ahead.items()}
    assert ahead["a"] == AHEAD + 1 and ahead["b"] > ahead["a"]
    assert finished["b"] <= 3 * (finished["a"] + 1)


def test_staleness_is_what_ended_meanwhile() -> None:
    overlap = Overlap(KINDS, "", schedule="async", overlap=1, wait=list)
    overlap.start("a", Handle("a", 1, []))
    for number in range(2):
        overlap.start("b", Handle("b", number, []))
        overlap.record_finished("b", Work(1))
    overlap.start("c", Handle("c", 1, []))
    overlap.record_finished("a", Work(1))
    overlap.record_finished("c", Work(1))
    assert overlap.staleness == {"a": 2, "b": 0, "c": 1}
    figures = overlap.figures()
    assert figures["staleness/a"] == 2.0 and figures["queue/b"] == 1.0 and figures["queue/a"] == 0.0


def test_the_time_of_tasks_is_added_up() -> None:
    rounds = Rounds("sync", learners="bc")
    list(rounds.run(3))
    work = rounds.overlap.work["b"]
    assert (work.tasks, work.seconds, work.cpu_seconds) == (3, 3.0, 1.5)
    assert rounds.overlap.figures()["idle/b"] == 0.0  # 3 s of work in no time
