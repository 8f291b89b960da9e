"""TensorBoard's event files are read back; Weights & Biases is a stand-in that keeps what it is told."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from popgen.cli.compose import compose
from popgen.config.run_config import RunConfig
from popgen.config.sections import TrackingConfig
from popgen.errors import UserError
from popgen.runs.chart_trackers import TensorboardTracker, WandbTracker, check_writer


def read_events(folder: Path) -> list[Any]:
    """All events of a folder's files in the order of their names: records of (length, crc, bytes, crc)."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted(folder.glob("events.*")):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            found.append(Event.FromString(data[12 : 12 + length]))
            data = data[16 + length :]
    return found


def read_scalars(folder: Path) -> list[tuple[str, int, float]]:
    events = read_events(folder)
    return [(value.tag, event.step, value.simple_value) for event in events for value in event.summary.value]


def test_tensorboard_has_a_series_for_the_population_and_for_each_member(tmp_path: Path) -> None:
    tracker = TensorboardTracker(tmp_path)
    tracker.log({"score": 9.0}, step=1)  # not started: nothing is written
    tracker.start(None)
    tracker.log({"score": 0.5, "loss": float("nan")}, step=400, member=1)
    tracker.log({"score": 1.5}, step=800, member=1)
    tracker.log_scaling(1, 800, {"SP": 500, "random": 300, "MP": 0})
    assert tracker.flush() == {}
    tracker.finish("FINISHED")
    tracker.log({"score": 9.0}, step=900, member=1)
    assert read_scalars(tmp_path / "tensorboard" / "member_001") == [("score", 400, 0.5), ("score", 800, 1.5)]
    assert read_scalars(tmp_path / "tensorboard" / "population") == [
        ("environment_steps", 1, 800.0),
        ("environment_steps/SP", 1, 500.0),
        ("environment_steps/random", 1, 300.0),
    ]


def test_what_is_done_again_is_left_out_by_tensorboard(tmp_path: Path) -> None:
    first = TensorboardTracker(tmp_path)
    first.start(None)
    for step in (400, 800, 1200):
        first.log({"score": 1.0}, step=step, member=1)
    first.finish("KILLED")
    second = TensorboardTracker(tmp_path)
    second.start({})
    second.log({"score": 2.0}, step=800, member=1)
    second.finish("FINISHED")
    starts = [e for e in read_events(tmp_path / "tensorboard" / "member_001") if e.HasField("session_log")]
    assert [(event.session_log.status, event.step) for event in starts] == [(1, 800)]  # START: later points are void


class StandIn:
    """`wandb` as far as it is used."""

    class Error(Exception):
        """Its errors."""

    def __init__(self, fault: str = "") -> None:
        self.fault, self.calls, self.id, self.notes = fault, [], "abc", ""

    def init(self, **settings: Any) -> StandIn:
        if self.fault == "init":
            raise self.Error("no such entity\nmore")
        self.calls.append(("init", settings["project"], settings["name"], settings["id"], settings["resume"]))
        return self

    def Settings(self, **settings: Any) -> SimpleNamespace:  # noqa: N802
        return SimpleNamespace(**settings)

    def define_metric(self, name: str, **how: Any) -> None:
        self.calls.append(("define", name, how))

    def log(self, figures: dict[str, float]) -> None:
        if self.fault == "log":
            raise self.Error("gone")
        self.calls.append(("log", figures))

    def finish(self, exit_code: int) -> None:
        self.calls.append(("finish", exit_code))


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> StandIn:
    stand_in = StandIn(getattr(request, "param", ""))
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    return stand_in


def test_wandb_gets_a_group_of_charts_with_steps_of_its_own(wandb: StandIn, tmp_path: Path) -> None:
    tracker = WandbTracker(TrackingConfig(writer="wandb"), tmp_path, "run-1", {"agent": {"lambda_xp": 0.1}})
    tracker.log({"score": 9.0}, step=1)
    assert tracker.flush() == {} and wandb.calls == []
    tracker.start(None)
    tracker.log({"score": 0.5}, step=400, member=1)
    tracker.log({"score": 1.5}, step=800, member=1)
    tracker.log_scaling(1, 800, {"SP": 800})
    tracker.describe("what it means")
    assert tracker.flush() == {"runs": {"wandb": "abc"}} and wandb.notes == "what it means"
    tracker.finish("KILLED")
    assert wandb.calls == [
        ("init", "popgen", "run-1", None, "allow"),
        ("define", "member_001/step", {"hidden": True}),
        ("define", "member_001/*", {"step_metric": "member_001/step"}),
        ("log", {"member_001/step": 400, "member_001/score": 0.5}),
        ("log", {"member_001/step": 800, "member_001/score": 1.5}),
        ("define", "population/step", {"hidden": True}),
        ("define", "population/*", {"step_metric": "population/step"}),
        (
            "log",
            {"population/step": 1, "population/environment_steps": 800.0, "population/environment_steps/SP": 800.0},
        ),
        ("finish", 1),
    ]


def test_wandb_goes_on_in_the_run_of_an_earlier_attempt(wandb: StandIn, tmp_path: Path) -> None:
    tracker = WandbTracker(TrackingConfig(writer="wandb"), tmp_path, "run-1", {})
    tracker.start({"runs": {"wandb": "old"}})
    tracker.finish("FINISHED")
    assert wandb.calls == [("init", "popgen", "run-1", "old", "allow"), ("finish", 0)]


@pytest.mark.parametrize("wandb", ["log"], indirect=True)
def test_wandb_that_takes_no_points_does_not_stop_training(wandb: StandIn, tmp_path: Path) -> None:
    tracker = WandbTracker(TrackingConfig(writer="wandb"), tmp_path, "run-1", {})
    tracker.start(None)
    tracker.log({"score": 0.5}, step=400, member=1)
    tracker.finish("FINISHED")
    assert wandb.calls[-1] == ("finish", 0)


@pytest.mark.parametrize("wandb", ["init"], indirect=True)
def test_wandb_that_begins_no_run_is_one_line(wandb: StandIn, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^tracking: wandb begins no run \(no such entity\); "):
        WandbTracker(TrackingConfig(writer="wandb"), tmp_path, "run-1", {}).start(None)


def test_what_is_missing_is_one_line_before_anything_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import importlib.util

    for name in ("WANDB_API_KEY", "WANDB_MODE", "WANDB_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    wanted = TrackingConfig(writer="wandb")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="tracking: wandb needs the package wandb; pip install wandb"):
        check_writer(wanted)
    with pytest.raises(UserError, match="tensorboard needs the package tensorboardX"):
        check_writer(TrackingConfig(writer="tensorboard"))
    check_writer(TrackingConfig())
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    with pytest.raises(UserError, match="wandb has no key; run `wandb login`, or set WANDB_MODE=offline"):
        check_writer(wanted)
    (tmp_path / "netrc").write_text("machine api.wandb.ai login user password x")
    check_writer(wanted)
    monkeypatch.setenv("NETRC", "/nowhere")
    monkeypatch.setenv("WANDB_MODE", "offline")
    check_writer(wanted)


def test_an_address_of_mlflow_goes_with_mlflow_alone() -> None:
    words = ["tracking=tensorboard", "tracking.uri='sqlite:///x.db'"]
    with pytest.raises(UserError, match="tracking.uri: is an address of MLflow"):
        RunConfig.parse(compose(words))
    assert RunConfig.parse(compose(words[:1])).tracking == TrackingConfig(writer="tensorboard")
