"""What the outside sees of a run: log, gauges, the disk."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from popgen.errors import UserError
from popgen.progress import NullReporter
from popgen.runs import sinks
from popgen.runs.recorder import DiskWatch
from popgen.runs.sinks import GAUGES, LoggingReporter, RunLog, show_figures


@pytest.fixture
def gauges(monkeypatch: pytest.MonkeyPatch) -> dict[tuple[str, ...], float]:
    """Everything that was set: (name, tags in order) -> value."""
    seen: dict[tuple[str, ...], float] = {}

    class Fake:
        def __init__(self, name: str, description: str, tag_keys: tuple[str, ...]) -> None:
            assert description.endswith(".")
            self.name, self.keys = name, tag_keys

        def set(self, value: float, tags: dict[str, str]) -> None:
            assert set(tags) == set(self.keys)
            seen[self.name, *(tags[key] for key in self.keys)] = value

    monkeypatch.setattr(sinks, "_gauges", {})
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: True))
    monkeypatch.setitem(sys.modules, "ray.util.metrics", SimpleNamespace(Gauge=Fake))
    return seen


def test_figures_become_gauges(gauges: dict[tuple[str, ...], float]) -> None:
    figures = {
        "real_sp": 3.5,
        "model/update_ms": 40.0,
        "agent/update_ms": 90.0,
        "idle/agent": 0.1,
        "model/loss_kl": 1.0,
    }
    show_figures("r", 2, figures | {"staleness/sampler0": 1.0, "queue/model": 2.0, "real_xp_max": float("nan")})
    assert gauges == {
        ("popgen_score", "r", "2"): 3.5,
        ("popgen_update_milliseconds", "r", "model"): 40.0,
        ("popgen_update_milliseconds", "r", "agent"): 90.0,
        ("popgen_learner_idle_share", "r", "agent"): 0.1,
        ("popgen_staleness_rounds", "r", "sampler0"): 1.0,
        ("popgen_queue_rounds", "r", "model"): 2.0,
    }


def test_what_is_not_finite_and_what_has_no_ray_is_left_out(
    gauges: dict[tuple[str, ...], float], monkeypatch: pytest.MonkeyPatch
) -> None:
    show_figures("r", 1, {"real_sp": float("nan")})
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(is_initialized=lambda: False))
    show_figures("r", 1, {"real_sp": 1.0})
    monkeypatch.delitem(sys.modules, "ray")
    show_figures("r", 1, {"real_sp": 1.0})
    assert not gauges
    assert all(name.startswith("popgen_") and "run" in tags for name, (_, tags) in GAUGES.items())


def test_the_log_is_one_object_a_line(tmp_path: Path) -> None:
    log = RunLog(tmp_path, "r", 2)
    reporter = LoggingReporter(NullReporter(), log)
    reporter.phase("member 1: self-play", 10)
    reporter.update(3, steps=4)
    reporter.note("two\nlines")
    log.place = {"member": 1, "iteration": 7}
    log.write("checkpoint", steps=30)
    log.write("member", member=2)
    rows = [json.loads(line) for line in (tmp_path / "run.log").read_text().splitlines()]
    assert [row["event"] for row in rows] == ["note", "note", "checkpoint", "member"]
    assert all(row["run"] == "r" and row["attempt"] == 2 and row["level"] == "INFO" and row["time"] for row in rows)
    assert rows[1]["text"] == "two\nlines" and "member" not in rows[1]
    assert [(row["member"], row["iteration"]) for row in rows[2:]] == [(1, 7), (2, 7)] and rows[2]["steps"] == 30


def test_a_log_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    RunLog(tmp_path / "missing", "r", 1).write("note")


def test_a_disk_that_is_nearly_full_ends_the_run_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [200, 50]

    def usage(folder: Path) -> Any:
        return SimpleNamespace(free=free.pop(0) * 2**20)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    disk = DiskWatch(tmp_path, 100 * 2**20, every=3600.0)
    assert disk.look() == 200 * 2**20 and disk.look() is None and len(free) == 1
    with pytest.raises(UserError, match=r"run.root: .* has 50 MiB left, fewer than run.disk_reserve") as caught:
        DiskWatch(tmp_path, 100 * 2**20).look()
    assert "\n" not in str(caught.value)
