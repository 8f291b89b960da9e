from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.finished import finished_run

from popgen.reports.crossplay_report import leave_out
from popgen.reports.run_findings import Finding, explain_run, explain_scores, find_control
from popgen.reports.run_record import read_run
from popgen.reports.training_series import IMAGINED, SHARE, WORLD_MODEL, read_panels

PENALTY = "agent.lambda_xp"


def scores_of(sp: float | None, xp: float | None, *, own: tuple[float, ...] = (), **changes: Any) -> dict[str, Any]:
    """As much of an evaluation as its explanation needs."""
    pairs = [
        {"seat_0": str(m), "seat_1": str(m), "score": {"mean": score, "standard_error": 0.1}}
        for m, score in enumerate(own, start=1)
    ]
    values = {
        "environment": {"name": "overcooked/cramped_room"},
        "method": "xpm_wm",
        "members": [1, 2],
        "unit": "dishes",
        "sp": {"mean": sp, "standard_error": 0.1},
        "xp": {"mean": xp, "standard_error": 0.1},
        "episodes": 20,
        "obstruction": {"random": False, "idle": False, "pairs": []},
        "pairs": pairs,
    }
    return values | changes


def tell(**values: Any) -> dict[str, bool | None]:
    return {finding.text: finding.good for finding in explain_scores(scores_of(**values))}


def test_good_and_weak_populations_are_told_apart() -> None:
    good = tell(sp=10.0, xp=0.5, own=(10.0, 9.0))
    assert good == {
        "good for this layout: SP 10.00 dishes; the paper's XPM-WM has 10.23 with 8 members": True,
        "every member plays with itself; the weakest is 2 with 9.00": True,
        "diverse: XP 0.50 is 5% of SP": True,
        "no obstruction found: no pair is worse than play beside a random or idle partner": True,
    }
    weak = tell(sp=8.0, xp=1.7, own=(10.0, 4.9, 9.0))
    assert list(weak.values()) == [False, False, False, True]  # 8.0 < 0.8 * 10.23; 1.7 > 0.2 * 8
    assert "weak with itself: member 2 (4.90); the best has 10.00" in weak


def test_members_of_pairs_are_judged_by_play_with_their_mates() -> None:
    scores = {(1, 1): 0.0, (1, 2): 9.0, (2, 1): 11.0, (2, 2): 0.0, (3, 4): 2.0, (4, 3): 2.0}
    pairs = [
        {"seat_0": str(i), "seat_1": str(j), "score": {"mean": mean, "standard_error": 0.1}}
        for (i, j), mean in scores.items()
    ]
    told = tell(sp=6.0, xp=0.1, members=[1, 2, 3, 4], mates=[2, 1, 4, 3], pairs=pairs)
    assert told["weak with their mates: members 3 (2.00), 4 (2.00); the best has 10.00"] is False
    assert "one pair: there is no cross-play" in tell(sp=6.0, xp=None, mates=[2, 1])


@pytest.mark.parametrize(
    ("values", "text", "good"),
    [
        ({"sp": 1.0, "xp": None}, "one member: there is no cross-play", None),
        ({"sp": 0.0, "xp": None, "method": "hipt"}, "an ego agent: `popgen evaluate EGO --with POPULATION`", None),
        ({"sp": 0.0, "xp": 0.0}, "XP 0.00 says nothing while SP is 0.00", None),
        ({"sp": 9.0, "xp": 0.0, "episodes": 1}, "obstruction cannot be judged by one episode a pair", None),
        (
            {"sp": 9.0, "xp": 0.0, "obstruction": {"random": True, "idle": True, "pairs": [{"pair": [2, 1]}]}},
            "obstruction: XP is below play beside random and idle partners",
            False,
        ),
        ({"sp": 9.0, "xp": 0.0, "environment": {"name": "overcooked/x"}}, "the paper has no figure", None),
        (
            {"sp": -3.0, "xp": -9.0, "method": "xpm_sim", "environment": {"name": "rendezvous/mppmr"}},
            "weak for this layout",
            False,
        ),
    ],
)
def test_what_cannot_be_said_is_not(values: dict[str, Any], text: str, good: bool | None) -> None:
    found = [told for told in tell(**values).items() if text in told[0]]
    assert [told[1] for told in found] == [good]
    told_pairs = any("1 of 2 pairs are worse" in text and text.endswith(": 2-1") for text in tell(**values))
    assert told_pairs == ("2, 1" in str(values))


def test_unfinished_members_are_not_judged_and_those_that_do_not_play_are_named(tmp_path: Path) -> None:
    """Of three players by chance the first is kept for its low skill."""
    skills = [{"skill": "initial"}, {"skill": "final"}, {"skill": "final"}]
    run = read_run(finished_run(tmp_path, "skilled", [{"SP": 10}] * 3, method="fcp", extras=skills, scores=(9.0, 9.0)))
    own = {(one["seat_0"], one["seat_1"]): one["score"]["mean"] for one in run.scores["pairs"]}
    assert run.unfinished == (1,) and own["2", "2"] == own["3", "3"] == 0.0
    told = [finding.text for finding in explain_run(run) if not finding.good]
    assert told[0].startswith("weak for this layout: SP 0.00 dishes")  # of members 2 and 3; the report's SP is 9
    named = [f"member {m} does not play: self-play 0.00 dishes is no better than with a random partner" for m in (2, 3)]
    assert [text.rpartition(",")[0] for text in told[1:3]] == named == [t.rpartition(",")[0] for t in run.weak_members]


def test_a_report_without_some_members_is_that_of_the_others() -> None:
    table = {(1, 1): 1.0, (1, 2): 2.0, (2, 1): 4.0, (2, 2): 8.0, (1, 3): 0.5, (3, 1): 0.5, (2, 3): 6.0, (3, 2): 3.0}
    table |= {(3, 3): 10.0}
    seats = [(str(i), str(j), score) for (i, j), score in table.items()]
    seats += [s for m in "123" for s in ((m, "random", 0.1), ("random", m, 0.1), (m, "idle", 0.0), ("idle", m, 0.0))]
    figures = ("score", "reward", "shaped_return")
    pairs = [
        {"seat_0": i, "seat_1": j, "events": [[], []]}
        | {name: {"mean": score, "standard_error": 0.1} for name in figures}
        for i, j, score in seats
    ]
    case = {"member": 2, "partner": 1}
    report = scores_of(4.0, 2.0) | {
        "environment": {
            "name": "line/short", "params": {}, "fingerprint": "0" * 64, "cooking": None, "horizon": 20,
            "score_name": "dishes",
        },
        "members": [1, 2, 3], "pairs": pairs, "event_names": [], "event_weights": [], "seed": 0, "training_seed": 0,
        "steps": {"evaluation": 1}, "mixed_play": {"members": [{"member": 1}, {"member": 2}], "cases": [case]},
    }  # fmt: skip
    rest = leave_out(report, [1])
    assert (rest["sp"]["mean"], rest["xp"]["mean"], rest["members"]) == (9.0, 4.5, [2, 3])
    assert rest["mixed_play"] == {"members": [{"member": 2}], "cases": []}
    assert not any("1" in (one["seat_0"], one["seat_1"]) for one in rest["pairs"])
    assert leave_out(report, []) == report


def test_a_control_is_a_run_with_all_else_equal(tmp_path: Path) -> None:
    steps = [{"SP": 10}, {"SP": 5, "XP": 5}]
    run = read_run(finished_run(tmp_path, "run", steps, seed=1))
    assert find_control(run, PENALTY) is None
    assert Finding(f"not known: XP without the penalty; a run with {PENALTY}=0 beside this one would tell") in (
        explain_run(run)
    )
    without = {"agent": {"lambda_xp": 0.0}}
    finished_run(tmp_path, "other_method", steps, method="mappo", scores=(9.0, 9.0))
    finished_run(tmp_path, "other_units", steps, settings={"agent": {"lambda_xp": 0.0, "units": 32}})
    finished_run(tmp_path, "other_rules", steps, params={"horizon": 21}, settings=without)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.json").write_text("{")
    assert find_control(run, PENALTY) is None
    finished_run(tmp_path, "control_a", steps, seed=3, settings=without, scores=(10.0, 8.0))
    control = finished_run(tmp_path, "control_b", steps, seed=1, settings=without, scores=(10.0, 6.0))
    found = find_control(run, PENALTY)
    assert found is not None and found.path.resolve() == control.resolve()
    assert Finding(f"with {PENALTY}=0 (control_b) XP is 6.00, here 0.50", True) in explain_run(run)
    assert "without a penalty" in explain_run(read_run(control))[-1].text


def test_series_are_read_by_member_and_time(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"member": 1, "step": 0, "seconds": 60.0, "report/exact_step1": 0.5, "real_shaped_sp": 0.1},
        {"member": 2, "step": 0, "seconds": 120.0, "exact_step1": 0.7, "agent/imagined_shaped_sp": None},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    (panel,) = read_panels(path, WORLD_MODEL)
    assert panel.lines == {"1 step ahead": {1: [(1.0, 0.5)], 2: [(2.0, 0.7)]}} and panel.unit == SHARE
    (other,) = read_panels(path, IMAGINED)
    assert other.lines == {"real": {1: [(1.0, 0.1)]}} and other.unit != SHARE and other.members == [1]
    assert read_panels(tmp_path / "none.jsonl", WORLD_MODEL) == []
