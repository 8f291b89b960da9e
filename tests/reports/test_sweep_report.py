from __future__ import annotations

from pathlib import Path

import pytest
from support.finished import finished_run

from popgen.reports.run_record import read_run
from popgen.reports.sweep_report import SweptRun, build_report, interval_of, runs_csv, summary, to_sheets, write_report


def test_an_interval_is_students_and_one_seed_has_none() -> None:
    interval = interval_of([1.0, 2.0, 6.0])
    assert interval["mean"] == pytest.approx(3.0)
    half = 4.3026527 * (14 / 2 / 3) ** 0.5  # t of two degrees; squared deviations 4 + 1 + 9
    assert interval["low"] == pytest.approx(3.0 - half) and interval["high"] == pytest.approx(3.0 + half)
    assert interval_of([2.0]) == {"mean": 2.0, "low": None, "high": None}
    assert interval_of([None, None]) == {"mean": None, "low": None, "high": None}
    assert interval_of([4.0, 4.0]) == {"mean": 4.0, "low": 4.0, "high": 4.0}


def swept(root: Path) -> list[SweptRun]:
    """Two weights with two seeds, and another method with one."""
    runs = []
    for name, method, seed, weight, scores in (
        ("a1", "xpm_sim", 1, 0.1, (10.0, 4.0)),
        ("a2", "xpm_sim", 2, 0.1, (12.0, 4.0)),
        ("b1", "xpm_sim", 1, 0.5, (9.0, 1.0)),
        ("b2", "xpm_sim", 2, 0.5, (11.0, 2.0)),
        ("c1", "mappo", 1, None, (8.0, 7.0)),
    ):
        settings = {} if weight is None else {"xpm_sim.lambda_xp": weight}
        steps = [{"SP": 1000, "simulated": 500}, {"SP": 200, "XP": 300}]
        folder = finished_run(root, name, steps, method=method, seed=seed, scores=scores)
        runs.append(SweptRun(read_run(folder), settings))
    return runs


def test_groups_are_settings_over_their_seeds_and_the_largest_gap_is_the_best(tmp_path: Path) -> None:
    report = build_report(swept(tmp_path), ["xpm_sim.lambda_xp"], {"d1": "the disk is full"})
    first, second, third = report["groups"]
    assert [group["label"] for group in report["groups"]] == [
        "XPM-Sim xpm_sim.lambda_xp=0.1",
        "XPM-Sim xpm_sim.lambda_xp=0.5",
        "MAPPO",
    ]
    assert (first["seeds"], first["sp"]["mean"], first["gap"]["mean"]) == ([1, 2], 11.0, 7.0)
    assert second["gap"]["mean"] == 8.5 and second["gap"]["high"] == pytest.approx(8.5 + 12.7062 * 0.5)
    assert (first["real_steps"], first["simulated_steps"], third["gap"]["low"]) == (1500, 500, None)
    assert report["best"] == {"overcooked/cramped_room": "XPM-Sim xpm_sim.lambda_xp=0.5"}
    still = "member 2 does not play: self-play 0.00 dishes is no better than with a random partner, 0.00"
    assert summary(report)[-2:] == [f"c1: {still}", "missing: d1 (the disk is full)"]  # the members act by chance
    (sheet,) = to_sheets(report)
    assert sheet.frame["SP - XP"].tolist() == ["7.00 (-5.71 to 19.71)", "8.50 (2.15 to 14.85)", "1.00"]
    assert sheet.frame["steps"].tolist() == ["1.5k"] * 3 and sheet.frame["simulated"].tolist() == ["500"] * 3
    (plain,) = to_sheets({**report, "groups": [group | {"simulated_steps": 0} for group in report["groups"]]})
    assert "simulated" not in plain.frame
    lines = runs_csv(report).splitlines()
    assert lines[0].endswith("seconds,xpm_sim.lambda_xp") and lines[3].startswith("b1,xpm_sim,")
    assert lines[5].endswith(",")  # no such setting
    files = write_report(report, tmp_path / "out")
    assert set(files) == {"sweep.json", "sweep.csv", "sweep.md", "sweep.png", "sweep.svg"}
    assert all(path.stat().st_size for path in files.values())
