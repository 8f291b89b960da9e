"""A run's folder after an accident."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from popgen.config.sections import RunSection, TrackingConfig
from popgen.envs import make_env
from popgen.errors import UserError
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.policies.simple_policies import RandomPolicy
from popgen.reports.training_curves import Point, read_curves
from popgen.runs.mlflow_tracker import Tracker
from popgen.runs.recorder import RunRecorder
from popgen.types import Kind

SPEC = make_env("overcooked/cramped_room").spec


def recorder(root: Path, **agent: Any) -> RunRecorder:
    config = XpmWmRun(run=RunSection(root=str(root), id="r"), tracking=TrackingConfig(enabled=False))
    return RunRecorder(config.model_copy(update={"agent": config.agent.model_copy(update=agent)}), SPEC)


@pytest.mark.parametrize("content", ["", "[]", '{"agent": {"lambda_warmup": 3}}', '{"seed"'])
def test_a_config_that_cannot_be_read_is_told_in_one_line(content: str, tmp_path: Path) -> None:
    recorder(tmp_path)
    (tmp_path / "r" / "config.json").write_text(content)
    with pytest.raises(UserError, match=r"run\.id: cannot go on with .*config\.json") as caught:
        recorder(tmp_path)
    assert "\n" not in str(caught.value)


def test_another_config_needs_another_id(tmp_path: Path) -> None:
    recorder(tmp_path)
    assert recorder(tmp_path).attempt == 2
    with pytest.raises(UserError, match="r exists with another config"):
        recorder(tmp_path, lambda_xp=0.123)


def test_lines_of_the_log_say_where_the_run_is(tmp_path: Path) -> None:
    """Member 1 after its fourth iteration, then member 2, and nobody once the population is complete."""
    kept = recorder(tmp_path)
    kept.config = kept.config.model_copy(update={"population": kept.config.population.model_copy(update={"size": 2})})
    kept.events.write("note")
    kept.record_checkpoint(1, 4)
    kept.events.write("note")
    for member in (1, 2):
        kept.add_member(RandomPolicy(SPEC.num_actions), None, seed=member, extra={})
        kept.events.write("note")
    kept.close("FINISHED")
    rows = [json.loads(line) for line in (tmp_path / "r" / "run.log").read_text().splitlines()]
    assert all(row["run"] == "r" and row["attempt"] == 1 for row in rows)
    assert [(row["event"], row.get("member"), row.get("iteration")) for row in rows] == [
        *(("start", 1, None), ("note", 1, None), ("checkpoint", 1, 4), ("note", 1, 4)),
        *(("member", 1, 4), ("note", 2, None), ("member", 2, None), ("note", None, None), ("end", None, None)),
    ]


def test_half_a_point_is_dropped_and_repeated_points_count_once(tmp_path: Path) -> None:
    first = recorder(tmp_path)
    for step, score in ((100, 1.0), (200, 2.0), (300, 3.0)):
        first.record_metrics(1, step, real_sp=score)
    path = tmp_path / "r" / "metrics.jsonl"
    path.write_text(path.read_text() + '{"member": 1, "st')
    first.state.release()  # as the system does when a process dies
    second = recorder(tmp_path)
    for step, score in ((200, 2.5), (350, 4.0)):  # it goes on after step 100
        second.record_metrics(1, step, real_sp=score)
    second.record_metrics(2, 50, real_sp=7.0, real_xp_max=0.5)
    assert all(json.loads(line) for line in path.read_text().splitlines())
    assert read_curves(path) == {
        1: (Point(100, 1.0, None), Point(200, 2.5, None), Point(350, 4.0, None)),
        2: (Point(50, 7.0, 0.5),),
    }


def test_artefacts_of_a_run_that_goes_on_are_there_once_and_the_latest(tmp_path: Path) -> None:
    config = XpmWmRun(run=RunSection(root=str(tmp_path), id="r"))
    report = tmp_path / "matrix.csv"
    state = None
    for attempt in (1, 2):
        tracker = Tracker(config.tracking, tmp_path / "store", "r", resume=state)
        kept = RunRecorder(config, SPEC, tracker)  # type: ignore[arg-type]
        kept.population.add_member(RandomPolicy(SPEC.num_actions), seed=attempt, steps={"SP": 7})
        kept.record_steps(attempt, Kind.SP, "sampler", 0, 7 * attempt, 0)
        report.write_text(f"{attempt}\n")
        kept.log_artefacts([report])
        kept.close("FINISHED")
        state = tracker.state()
    (copies,) = (tmp_path / "store" / "mlflow_artifacts").glob("*/artifacts")
    names = {path.relative_to(copies).as_posix() for path in copies.rglob("*") if path.is_file()}
    members = {f"population/member_00{n}/{name}" for n in (1, 2) for name in ("member.json", "policy.safetensors")}
    assert names == members | {
        *("config.json", "ledger.csv", "ledger.jsonl", "population/manifest.json", "report/matrix.csv"),
    }
    for name in names - {"report/matrix.csv"}:
        assert (copies / name).read_bytes() == (tmp_path / "r" / name).read_bytes()
    assert (copies / "report" / "matrix.csv").read_text() == "2\n"
    assert (copies / "ledger.csv").read_text().split() == [
        *("member,kind,steps,episodes,score", "1,SP,7,0,0.0", "2,SP,14,0,0.0")
    ]


def test_between_two_attempts_the_run_is_at_work(tmp_path: Path) -> None:
    """An attempt that a death ended is no end of the run: should the driver be ended now, another one is made."""
    first = recorder(tmp_path)
    first.hand_over(RuntimeError("an actor died"))
    state = json.loads((tmp_path / "r" / "state.json").read_text())
    assert (state["state"], state["error"], state["pid"]) == ("running", None, os.getpid())
    last = [json.loads(line) for line in (tmp_path / "r" / "run.log").read_text().splitlines()][-1]
    assert (last["event"], last["error"]) == ("end", "an actor died")
    second = recorder(tmp_path)
    assert second.attempt == 2
    second.close("FINISHED")
    assert json.loads((tmp_path / "r" / "state.json").read_text())["state"] == "finished"
