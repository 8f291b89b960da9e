"""The shared-encoder ablation's report: averaged curves by hand, what cannot be compared, the files."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from popgen.envs import make_env
from popgen.errors import UserError
from popgen.population.manifest import EnvironmentInfo
from popgen.reports.run_record import MemberRecord, Point, RunRecord
from popgen.reports.shared_encoder_report import build_report, summary, write_report


def record(kind: str, seed: int, ends: list[float], **settings: Any) -> RunRecord:
    """Member m's self-play rises evenly from 0 to ends[m - 1] within 1,000 simulated steps."""
    curves = [tuple(Point(10 * i, end * i / 4, None, 250 * i) for i in range(5)) for end in ends]
    members = tuple(MemberRecord(m, {"SP": 40}, 1.0, False, curve) for m, curve in enumerate(curves, start=1))
    table = [[end if i == j else -1.0 for j in range(len(ends))] for i, end in enumerate(ends)]
    return RunRecord(
        path=Path(f"{kind}-{seed}"),
        run_id="r",
        label="xpm_sim",
        method="xpm_sim",
        seed=seed,
        scale="smoke",
        environment=EnvironmentInfo.of(make_env("rendezvous/mppmr", 1).spec),
        settings={"xpm_sim.encoder": kind, "xpm_sim.updates": 4, **settings},
        members=members,
        evaluation_steps=0,
        lost_steps=0,
        attempts=1,
        scores={"matrix": {"mean": table}},
    )


RECORDS = [
    record("none", 1, [99.0, 10.0, 30.0]),
    record("none", 2, [99.0, 20.0, 20.0]),
    record("shared", 1, [9.0, 8.0]),
]


def test_curves_average_later_members_of_all_seeds() -> None:
    separate, shared = build_report(RECORDS)["curves"]
    assert (separate["name"], separate["members"], separate["seeds"]) == ("separate agents", 4, (1, 2))
    assert (shared["name"], shared["members"], shared["final"]) == ("shared encoder", 1, 8.0)
    assert separate["final"] == 20.0
    assert separate["steps"][0] == 0.0 and separate["steps"][-1] == 1000.0
    half = separate["steps"].index(500.0)
    assert separate["mean"][half] == pytest.approx(10.0)
    assert separate["deviation"][half] == pytest.approx((2 * 5.0**2 / 4) ** 0.5)
    assert separate["reached"] == {"50%": 500.0, "80%": 800.0, "90%": 900.0}
    assert shared["reached"] == {"50%": None, "80%": None, "90%": None}


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (replace(RECORDS[2], method="xpm_wm"), "of xpm_wm"),
        (record("shared", 1, [1.0]), "no later members"),
        (record("shared", 1, [1.0, 2.0], **{"xpm_sim.updates": 9}), "xpm_sim.updates"),
        (record("none", 3, [1.0, 2.0]), "encoder=shared"),
    ],
)
def test_what_cannot_be_compared_is_refused(other: RunRecord, said: str) -> None:
    with pytest.raises(UserError, match=said):
        build_report([RECORDS[0], other])


def test_files_and_lines(tmp_path: Path) -> None:
    report = build_report(RECORDS)
    files = write_report(report, tmp_path / "out")
    assert json.loads(files["shared_encoder.json"].read_text())["format"] == "popgen-shared-encoder"
    rows = list(csv.DictReader(files["shared_encoder.csv"].open()))
    assert len(rows) == 2 * 41 and rows[-1]["curve"] == "shared encoder" and float(rows[-1]["mean"]) == 8.0
    assert all(files[f"shared_encoder.{kind}"].stat().st_size > 5000 for kind in ("png", "svg"))
    lines = summary(report)
    assert "final SP 20.00 return" in lines[0] and "90% at 900" in lines[0] and "never" in lines[1]
