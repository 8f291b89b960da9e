"""The driver's end of the tracker, whose actor may die at any time."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from ray.exceptions import ActorDiedError, RayTaskError

from popgen.actors import tracker_actor as module
from popgen.actors.tracker_actor import MARKED, REVIVALS, RemoteTracker
from popgen.config.sections import TrackingConfig
from popgen.errors import UserError


class Store:
    """What MLflow would hold, and the actors that write to it: each buffers until it is flushed."""

    def __init__(self) -> None:
        self.written: list[tuple[Any, ...]] = []
        self.opened: list[Any] = []
        self.alive = 0
        self.deadly = False
        self.refuses = False
        self.status: list[str] = []


class Call:
    """`actor.method`, whose result is there at once."""

    def __init__(self, actor: FakeActor, act: Any) -> None:
        self.actor, self.act = actor, act

    def remote(self, *arguments: Any) -> Any:
        return self.act(*arguments) if self.actor.alive else ActorDiedError()


class FakeActor:
    def __init__(self, store: Store) -> None:
        self.store, self.alive, self.buffer = store, True, []
        self.open, self.call, self.flush = Call(self, self._open), Call(self, self._call), Call(self, self._flush)
        store.alive += 1

    def _open(self, *arguments: Any) -> Any:
        if self.store.deadly:
            self.alive = False
            return ActorDiedError()
        if self.store.refuses:
            cause = UserError("tracking.uri", "cannot open it")
            return RayTaskError("open", "traceback", cause).as_instanceof_cause()
        self.store.opened.append(arguments[4])  # what to go on from; the folder of the store is last

    def _call(self, method: str, *arguments: Any) -> None:
        if method == "finish":
            self.store.status.append(arguments[0])
        else:
            self.buffer.append((method, *arguments))

    def _flush(self) -> dict[str, Any]:
        self.store.written += [point for point in self.buffer if point not in self.store.written]
        self.buffer.clear()
        return {"runs": {"parent": "1"}}

    def die(self) -> None:
        self.alive = False
        self.buffer.clear()


@pytest.fixture
def actors(monkeypatch: pytest.MonkeyPatch) -> list[FakeActor]:
    hired: list[FakeActor] = []
    store = Store()

    def get(value: Any) -> Any:
        if isinstance(value, Exception):
            raise value
        return value

    def remote(cls: Any) -> Any:
        def hire() -> FakeActor:
            hired.append(FakeActor(store))
            return hired[-1]

        return SimpleNamespace(options=lambda **options: SimpleNamespace(remote=hire))

    fake = SimpleNamespace(remote=remote, get=get, wait=lambda refs, timeout: (refs, []), kill=lambda actor: None)
    fake.get_runtime_context = lambda: SimpleNamespace(get_node_id=lambda: "0" * 56)
    monkeypatch.setattr(module, "ray", fake)
    return hired


def make(root: Path) -> RemoteTracker:
    tracker = RemoteTracker(TrackingConfig(), root, "r", {}, None)
    tracker.start()
    return tracker


def steps(store: Store) -> list[int]:
    return [call[2] for call in store.written if call[0] == "log"]


def test_every_point_is_written_once_whenever_the_actor_dies(actors: list[FakeActor], tmp_path: Path) -> None:
    tracker = make(tmp_path)
    for step in range(5 * MARKED):
        tracker.log({"x": 1.0}, step=step)
        if step % 37 == 36:
            actors[-1].die()
    tracker.log_artifact("report.html", "report")
    tracker.flush()
    store = actors[0].store
    assert steps(store) == list(range(5 * MARKED)) and store.written[-1][0] == "log_artifact"
    assert len(actors) > 3
    assert store.opened[0] is None and None not in store.opened[1:]  # later ones look for the runs that are there
    tracker.finish("FINISHED")
    assert store.status == ["FINISHED"]


def test_the_time_of_a_point_is_that_at_which_the_driver_gave_it(actors: list[FakeActor], tmp_path: Path) -> None:
    tracker = make(tmp_path)
    tracker.log({"x": 1.0}, step=1)
    first = list(tracker._unwritten)
    actors[-1].die()
    tracker.flush()
    assert actors[0].store.written == first and first[0][4] > 1.6e12


def test_a_tracker_that_always_dies_does_not_stop_the_run(actors: list[FakeActor], tmp_path: Path) -> None:
    tracker = make(tmp_path)
    actors[0].store.deadly = True
    actors[0].die()
    tracker.log({"x": 1.0}, step=1)
    assert tracker.flush() == {} and len(actors) == REVIVALS
    tracker.log({"x": 1.0}, step=2)
    tracker.finish("FINISHED")
    assert len(actors) == REVIVALS


def test_after_another_ray_it_gets_what_was_not_written(actors: list[FakeActor], tmp_path: Path) -> None:
    tracker = make(tmp_path)
    tracker.log({"x": 1.0}, step=1)
    actors[-1].die()
    tracker.forget()
    tracker.log({"x": 1.0}, step=2)
    tracker.start()
    tracker.flush()
    assert steps(actors[0].store) == [1, 2] and len(actors) == 2


def test_a_store_that_cannot_be_opened_is_the_users_error(actors: list[FakeActor], tmp_path: Path) -> None:
    tracker = make(tmp_path)
    actors[0].store.refuses = True
    tracker.forget()
    with pytest.raises(UserError):
        tracker.start()
