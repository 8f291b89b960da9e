"""`popgen experiment shared-encoder` over finished runs: figures, JSON, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.finished import finished_run

from popgen.cli import main

pytestmark = pytest.mark.usefixtures("quick_pictures")


def finished(root: Path, kind: str, final: float) -> Path:
    """Two members; the second's self-play rises evenly to `final` within 600 simulated steps."""
    steps = [{"SP": 40, "simulated": 600}, {"SP": 40, "XP": 40, "simulated": 600}]
    settings = {"xpm_sim": {"encoder": kind, "unroll": 100}}
    folder = finished_run(root, kind, steps, method="xpm_sim", env="rendezvous/mppmr", settings=settings)
    rows = [
        {"member": member, "step": 10 * i, "seconds": 1.0, "real_sp": final * i / 4, "simulated_steps": 150.0 * i}
        for member in (1, 2)
        for i in range(5)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_over_finished_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    separate, shared = finished(tmp_path, "none", 30.0), finished(tmp_path, "shared", 12.0)
    given = ["experiment", "shared-encoder", "--run", str(separate), "--run", str(shared), "--out", str(tmp_path / "o")]
    assert main([*given, "--json", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [curve["mean"][-1] for curve in report["curves"]] == [30.0, 12.0]
    assert report["curves"][0]["steps"][-1] == 600.0
    assert all(Path(path).stat().st_size for path in report["files"].values())
    assert main([*given, "--quiet"]) == 0
    assert "shared encoder: final SP" in capsys.readouterr().out


def test_what_it_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    separate = str(finished(tmp_path, "none", 30.0))
    command = ["experiment", "shared-encoder", "--out", str(tmp_path / "o")]
    assert main([*command, "--run", separate]) == 2
    assert "xpm_sim.encoder=shared" in capsys.readouterr().err
    assert main([*command, "--run", separate, "seed=3"]) == 2
    assert "leave out --run" in capsys.readouterr().err
    (tmp_path / "none" / "metrics.jsonl").write_text("")
    assert main([*command, "--run", separate, "--run", str(finished(tmp_path, "shared", 1.0))]) == 2
    assert "no learning curves" in capsys.readouterr().err
