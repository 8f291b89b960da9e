from __future__ import annotations

import json
import math
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import pytest

from popgen.config.sections import TrackingConfig
from popgen.errors import UserError
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.runs import mlflow_tracker
from popgen.runs.mlflow_tracker import SCALING_METRIC, STORE, LocalTracker, Tracker, choose_store, view_address
from popgen.runs.tracking_address import sqlite_uri


def history(tracker: Tracker, run: str, metric: str) -> list[tuple[int, float]]:
    return [
        (point.step, point.value) for point in client(tracker).get_metric_history(tracker.state()["runs"][run], metric)
    ]


def client(tracker: Tracker) -> Any:
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=tracker.uri)


@pytest.fixture(scope="module")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store's file with MLflow's tables, which take seconds to make."""
    tracker = Tracker(TrackingConfig(), tmp_path_factory.mktemp("empty"), "first")
    path = tracker.store / STORE
    with sqlite3.connect(path) as store:
        for table in ("params", "tags", "experiment_tags", "runs", "experiments"):
            store.execute(f"delete from {table} where true" + (" and experiment_id != 0" * (table == "experiments")))
    return path


@pytest.fixture(autouse=True)
def ready_tables(empty_store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """New stores of this process begin with the tables of `empty_store`."""
    lock_store = mlflow_tracker._lock_store

    def copy_tables(store: Path, uri: str | None) -> Any:
        if uri is None and not (store / STORE).exists():
            shutil.copy(empty_store, store / STORE)
        return lock_store(store, uri)

    monkeypatch.setattr(mlflow_tracker, "_lock_store", copy_tables)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    """A finished run in two sittings: a population of two members, 2,500 points for the first."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "report").mkdir()
    (folder / "report" / "matrix.json").write_text("{}")
    first = Tracker(TrackingConfig(), folder, "run-1", XpmWmRun().model_dump(mode="json"))
    for step in range(1250):
        first.log({"loss": step / 2, "score": 1.0}, step=step, member=1)
    first.log_scaling(1, 600_000, {"SP": 500_000, "random": 100_000, "MP": 0})
    first.log_artifact(folder / "report", "report")
    first.log_artifact(folder / "report" / "matrix.json", member=1)
    first.flush()
    state = json.loads(json.dumps(first.state()))
    second = Tracker(TrackingConfig(), folder, "run-1", XpmWmRun().model_dump(mode="json"), resume=state)
    second.log({"loss": 9.0}, step=1250, member=1)
    second.log({"loss": math.nan}, step=0, member=2)
    second.log_scaling(2, 660_000, {"SP": 550_000, "random": 100_000, "XP": 10_000})
    second.finish()
    return second


def test_everything_lies_in_the_run_folder(tracked: Tracker) -> None:
    assert {".mlflow.db.lock", "mlflow.db", "mlflow_artifacts", "report"} == {
        path.name for path in tracked.run_dir.iterdir()
    }
    assert [file.path for file in client(tracked).list_artifacts(tracked.state()["runs"]["parent"])] == ["report"]
    assert len(list(tracked.run_dir.rglob("mlflow_artifacts/**/matrix.json"))) == 2


def test_members_are_nested_in_the_parent(tracked: Tracker) -> None:
    runs = {name: client(tracked).get_run(run) for name, run in tracked.state()["runs"].items()}
    assert set(runs) == {"parent", "member_001", "member_002"}
    parent = runs.pop("parent")
    assert parent.info.run_name == "run-1" and parent.info.status == "FINISHED"
    assert all(run.data.tags["mlflow.parentRunId"] == parent.info.run_id for run in runs.values())
    assert all(run.info.status == "FINISHED" for run in runs.values())
    assert (
        parent.data.params["agent.lambda_xp"] == str(XpmWmRun().agent.lambda_xp)
        and parent.data.params["env.name"] == XpmWmRun().env.name
    )


def test_metrics_of_both_sittings_are_there(tracked: Tracker) -> None:
    assert history(tracked, "member_001", "loss") == [*((step, step / 2) for step in range(1250)), (1250, 9.0)]
    assert len(history(tracked, "member_001", "score")) == 1250
    assert math.isnan(history(tracked, "member_002", "loss")[0][1])


def test_scaling_has_the_number_of_members_as_step(tracked: Tracker) -> None:
    assert history(tracked, "parent", SCALING_METRIC) == [(0, 0.0), (1, 600_000.0), (2, 660_000.0)]
    assert history(tracked, "parent", "environment_steps/SP") == [(0, 0.0), (1, 500_000.0), (2, 550_000.0)]
    assert history(tracked, "parent", "environment_steps/XP") == [(0, 0.0), (2, 10_000.0)]
    assert history(tracked, "parent", "environment_steps/MP") == []  # a kind that nobody used is no chart


def test_members_have_parameters_and_tags_too(tracked: Tracker) -> None:
    for run in tracked.state()["runs"].values():
        data = client(tracked).get_run(run).data
        assert data.params["agent.lambda_xp"] == str(XpmWmRun().agent.lambda_xp)
        tags = {name: data.tags[f"popgen.{name}"] for name in ("method", "layout", "seed", "scale")}
        assert tags == {"method": "xpm_wm", "layout": XpmWmRun().env.name, "seed": "0", "scale": "laptop"}


def test_single_events_are_folded_into_one_section(tmp_path: Path) -> None:
    tracker = Tracker(TrackingConfig(), tmp_path, "r")
    figures = ["report/precision_takes_dish_step1", "recall_takes_dish_step4", "report/event_recall_step1", "recall"]
    tracker.log(dict.fromkeys(figures, 1.0), step=1, member=1)
    tracker.finish()
    folded = {f"single_events/{name}" for name in ("precision_takes_dish_step1", "recall_takes_dish_step4")}
    metrics = client(tracker).get_run(tracker.state()["runs"]["member_001"]).data.metrics
    assert set(metrics) == {*folded, *figures[2:]}


def test_runs_of_one_root_have_one_store_and_descriptions(tmp_path: Path) -> None:
    assert choose_store(tmp_path / "a") == tmp_path and choose_store(tmp_path / "a", "s3://b/c") == tmp_path / "a"
    trackers = [Tracker(TrackingConfig(), tmp_path / name, name, store=tmp_path) for name in ("a", "b")]
    assert len({tracker.uri for tracker in trackers}) == 1 and not (tmp_path / "a").exists()
    for tracker in trackers:
        tracker.describe(f"![SP](artefact:report/x.png) {tracker.run_name}" + "." * 9000, "| all |")
        tracker.finish()
    found = client(trackers[0]).search_runs([trackers[0].state()["experiment"]])
    notes = {run.info.run_name: run.data.tags["mlflow.note.content"] for run in found}
    for tracker in trackers:
        address = f"get-artifact?run_uuid={tracker.run_id}&path=report/x.png"
        assert notes[tracker.run_name].startswith(f"![SP]({address}) {tracker.run_name}")
        assert len(notes[tracker.run_name]) == 5000
        place = f"experiments/{tracker.state()['experiment']}/runs/{tracker.run_id}"
        assert view_address(tracker.state(), "x") == f"x/#/{place}?workflowType=machine_learning"
    assert (
        client(trackers[0]).get_experiment(trackers[0].state()["experiment"]).tags["mlflow.note.content"] == "| all |"
    )
    assert view_address({}) == "http://127.0.0.1:5000/#/experiments?workflowType=machine_learning"
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mlflow.db").touch()
    assert choose_store(tmp_path / "a") == tmp_path / "a"  # of a version that kept it there


def test_points_go_out_in_batches(tmp_path: Path) -> None:
    tracker = Tracker(TrackingConfig(uri=f"sqlite:///{tmp_path / 'other.db'}"), tmp_path / "run", "r")
    assert (tmp_path / "other.db").exists() and not (tmp_path / "run").exists()
    calls: list[int] = []
    real = tracker._client.log_batch

    def counting(run: str, metrics: Any = (), **more: Any) -> None:
        calls.append(len(metrics))
        real(run, metrics=metrics, **more)

    tracker._client.log_batch = counting
    for step in range(1100):
        tracker.log({"a": 1.0, "b": 2.0}, step=step)
    assert calls == [1000, 1000]
    tracker.flush()
    assert calls == [1000, 1000, 200]

    def broken(*_: Any, **__: Any) -> None:
        raise ConnectionError("the store went away")

    tracker._client.log_batch = broken
    tracker.log({"a": 3.0}, step=2000)
    tracker.flush()  # training goes on
    tracker._client.log_batch = counting
    tracker.flush()
    assert calls[-1] == 1 and history(tracker, "parent", "a")[-1] == (2000, 3.0)


def test_a_store_that_is_away_when_a_member_begins_gets_its_points_later(tmp_path: Path) -> None:
    tracker = Tracker(TrackingConfig(), tmp_path, "r")
    create = tracker._client.create_run

    def away(*_: Any, **__: Any) -> None:
        raise ConnectionError("the store went away")

    tracker._client.create_run = away
    tracker.log({"a": 1.0}, step=3, member=1)
    tracker.flush()
    assert tracker.state()["runs"].keys() == {"parent"}
    tracker._client.create_run = create
    tracker.flush()
    assert history(tracker, "member_001", "a") == [(3, 1.0)]


def test_an_artefact_that_is_not_taken_stops_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class OfAnotherLibrary(Exception):
        pass

    def refuse(*_: Any) -> None:
        raise OfAnotherLibrary("no such bucket")

    tracker = Tracker(TrackingConfig(), tmp_path / "run", "r")
    tracker.log_artifact(tmp_path / "gone.csv")
    tracker._client.log_artifacts = refuse
    tracker.log_artifact(tmp_path / "run")
    assert len(caplog.records) == 2 and "no such bucket" in caplog.text
    tracker.finish()


def test_the_machines_load_is_kept_with_the_run(tmp_path: Path) -> None:
    """One sample, taken here and not after ten seconds; an attempt that goes on goes on with it."""
    config, state = TrackingConfig(system_metrics=True), None
    for attempt in (0, 1):
        tracker = Tracker(config, tmp_path, "r", resume=state)
        monitor = tracker._monitor
        assert monitor.sampling_interval == 10 and monitor._process.is_alive()
        monitor.collect_metrics()
        monitor.publish_metrics(monitor.aggregate_metrics())
        tracker.finish()
        assert monitor._process is None  # joined
        state = tracker.state()
        assert [step for step, _ in history(tracker, "parent", "system/cpu_utilization_percentage")] == [
            *range(attempt + 1)
        ]
    found = client(tracker).get_run(state["runs"]["parent"]).data.metrics
    assert {"system/system_memory_usage_megabytes", "system/disk_usage_percentage"} <= found.keys()


def test_off_touches_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)  # an import would fail
    tracker = Tracker(TrackingConfig(enabled=False), tmp_path / "run", "r", {"a": 1})
    tracker.log({"a": 1.0}, step=1)
    tracker.log_scaling(1, 10)
    tracker.log_artifact(tmp_path)
    tracker.finish()
    assert (
        not tracker.enabled
        and tracker.state()["runs"] == {}
        and tracker.run_id is None
        and list(tmp_path.iterdir()) == []
    )


def test_a_store_that_cannot_be_opened_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot open") as caught:
        Tracker(TrackingConfig(uri=f"sqlite:///{tmp_path}/file/x.db"), tmp_path, "r")
    assert "\n" not in str(caught.value)


def test_a_local_tracker_opens_late_and_goes_on_in_the_same_runs(tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient

    arguments = (TrackingConfig(), tmp_path, "run-1", XpmWmRun().model_dump(mode="json"))
    first = LocalTracker(*arguments)
    first.log({"loss": 1.0}, step=1, member=1)
    first.log_scaling(1, 10)
    first.finish("FAILED")
    assert first.flush() == {} and not list(tmp_path.iterdir())  # before `start` nothing happens
    first.start()
    first.start()  # once more changes nothing
    first.log({"loss": 2.0}, step=2, member=1)
    state = json.loads(json.dumps(first.flush()))
    first.forget()  # there is no process to forget
    second = LocalTracker(*arguments)
    second.start(state)
    second.log({"loss": 3.0}, step=3, member=1)
    second.log_scaling(1, 600)
    second.describe("*text*")
    second.log_artifact(tmp_path / "mlflow.db", "copy")
    assert second.flush()["runs"] == state["runs"]
    second.finish("KILLED")
    assert second.flush() == {}
    store = MlflowClient(tracking_uri=sqlite_uri(tmp_path / STORE))
    losses = store.get_metric_history(state["runs"]["member_001"], "loss")
    assert [(point.step, point.value) for point in losses] == [(2, 2.0), (3, 3.0)]
    parent = store.get_run(state["runs"]["parent"])
    assert parent.data.metrics[SCALING_METRIC] == 600.0 and parent.info.status == "KILLED"
    assert "*text*" in parent.data.tags["mlflow.note.content"]


def test_a_local_tracker_names_a_store_that_cannot_be_opened_once_it_starts(tmp_path: Path) -> None:
    tracker = LocalTracker(TrackingConfig(uri="sqlite:////proc/nothing/mlflow.db"), tmp_path, "run-1", {})
    with pytest.raises(UserError, match="tracking.uri: cannot open"):
        tracker.start()
