from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from support.finished import CRAMPED, finished_run

from popgen.errors import UserError
from popgen.evaluation.estimates import Estimate
from popgen.evaluation.held_members import HeldMember, HeldScores, hold_members
from popgen.reports import comparison_report
from popgen.reports import paper_figures as paper
from popgen.reports.charts.scaling_charts import choose_looks
from popgen.reports.comparison import (
    LINE,
    MEASURED,
    Band,
    Group,
    Thresholds,
    budgets,
    costs,
    default_thresholds,
    group_runs,
    judge_members,
    quality_costs,
    step_band,
    time_band,
)
from popgen.reports.comparison_report import Comparison, chosen_thresholds
from popgen.reports.method_titles import METHODS
from popgen.reports.run_record import RunRecord, read_run
from popgen.reports.training_curves import Point, read_curves

RING = "overcooked/coordination_ring"


@pytest.fixture(scope="module")
def model_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four members: 1,000 steps, then 100 of self-play and 10, 20, 30 of cross-play."""
    later = [{"SP": 100, "XP": 10 * partners} for partners in (1, 2, 3)]
    curves = {
        1: [(200, 3.0, None), (600, 9.0, None), (800, 8.0, None)],
        2: [(40, 9.0, 5.0), (80, 8.5, 1.0), (110, 9.5, 0.0)],
        3: [(60, 7.0, 0.0), (120, 8.0, 3.0)],
    }
    return finished_run(
        tmp_path_factory.mktemp("runs"),
        "model",
        [{"random": 600, "SP": 400}, *later],
        seconds=[500.0, 55.0, 60.0, 65.0],
        curves=curves,
        scores=(10.0, 1.0),
    )


@pytest.fixture(scope="module")
def model(model_run: Path) -> RunRecord:
    return read_run(model_run)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    steps = [{"SP": 80, "simulated": 5000}, {"SP": 40, "XP": 40, "simulated": 7000}]
    return read_run(finished_run(tmp_path_factory.mktemp("runs"), "exact", steps, method="xpm_sim"))


# --- reading


def test_a_run_is_read_from_its_own_books(model: RunRecord, exact: RunRecord) -> None:
    assert (model.method, model.label, model.seed, model.run_id) == ("xpm_wm", "xpm_wm", 0, "model")
    assert model.environment.name == CRAMPED and model.environment.cooking == "auto"
    assert [dict(m.steps) for m in model.members][:2] == [{"random": 600, "SP": 400}, {"SP": 100, "XP": 10}]
    assert [m.real for m in model.members] == [1000, 110, 120, 130] and model.evaluation_steps == 77
    assert model.members[1].curve == (Point(40, 9.0, 5.0), Point(80, 8.5, 1.0), Point(110, 9.5, 0.0))
    assert model.members[3].curve == () and not model.members[0].adopted
    assert exact.members[0].steps == {"SP": 80, "simulated": 5000} and exact.members[0].real == 80


def test_reading_changes_nothing(model_run: Path) -> None:
    before = {path: path.read_bytes() for path in model_run.rglob("*") if path.is_file()}
    read_run(model_run)
    assert before == {path: path.read_bytes() for path in model_run.rglob("*") if path.is_file()}


def test_an_unfinished_line_of_a_ledger_is_refused_and_kept(tmp_path: Path) -> None:
    folder = finished_run(tmp_path, "cut", [{"SP": 10}])
    ledger = folder / "ledger.jsonl"
    ledger.write_bytes(ledger.read_bytes()[:-9])
    with pytest.raises(UserError, match="no ledger entry"):
        read_run(folder)
    assert not ledger.read_bytes().endswith(b"\n")


def test_unfinished_runs_are_refused_with_the_reason(tmp_path: Path) -> None:
    folder = finished_run(tmp_path, "part", [{"SP": 10}, {"SP": 10}])
    config = json.loads((folder / "config.json").read_text())
    config["population"]["size"] = 3
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"part: is unfinished: it has 2 of 3 members; finish it .*run.id=part"):
        read_run(folder)
    config["population"]["size"] = 2
    (folder / "config.json").write_text(json.dumps(config))
    read_run(folder)
    (folder / "report" / "crossplay.json").unlink()
    with pytest.raises(UserError, match="its members were not evaluated"):
        read_run(folder)
    with pytest.raises(UserError, match=r"is no run: it has no config.json"):
        read_run(tmp_path)


def test_a_ledger_that_contradicts_its_members_is_refused(tmp_path: Path) -> None:
    folder = finished_run(tmp_path, "odd", [{"SP": 10}, {"SP": 10}])
    lines = (folder / "ledger.jsonl").read_text().splitlines()
    (folder / "ledger.jsonl").write_text("\n".join(lines[1:]) + "\n")
    with pytest.raises(UserError, match=r"counts 5 SP steps for member 1, member.json 10"):
        read_run(folder)


def test_members_of_another_run_bring_their_own_steps(tmp_path: Path) -> None:
    origin = finished_run(tmp_path, "origin", [{"SP": 10}, {"SP": 4}], curves={1: [(5, 9.0, None)], 2: [(4, 1.0, 1.0)]})
    folder = finished_run(tmp_path, "goes_on", [{"SP": 10}, {"SP": 6}], curves={2: [(6, 8.0, 0.0)]})
    config = json.loads((folder / "config.json").read_text())
    config["population"] |= {"init_from": str(origin), "init_members": 1}
    (folder / "config.json").write_text(json.dumps(config))
    lines = (folder / "ledger.jsonl").read_text().splitlines()
    (folder / "ledger.jsonl").write_text("\n".join(line for line in lines if '"member": 1,' not in line) + "\n")
    run = read_run(folder)
    assert [(m.real, m.adopted) for m in run.members] == [(10, True), (6, False)]
    assert run.members[0].curve == (Point(5, 9.0, None),) and run.members[1].curve == (Point(6, 8.0, 0.0),)


def test_points_of_a_resumed_run_count_once_and_cross_play_is_the_latest(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = [
        {"member": 2, "step": 10, "real_sp": 1.0, "real_xp_max": 4.0},
        {"member": 2, "step": 20, "real_sp": 2.0},
        {"member": 2, "step": 30, "real_sp": 3.0, "real_xp_max": 2.0},
        {"member": 2, "step": 20, "real_sp": 5.0, "real_xp": 1.0, "simulated_steps": 900.0},  # after an interruption
        {"member": 2, "step": 25, "agent/loss": 1.0},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = read_curves(path)
    assert found == {2: (Point(10, 1.0, 4.0), Point(20, 2.0, 4.0), Point(20, 5.0, 1.0, 900))}
    path.write_text("[1]\n")
    with pytest.raises(UserError, match="no point of metrics"):
        read_curves(path)


# --- costs


def test_costs_are_sums_and_go_on_in_a_line(model: RunRecord) -> None:
    found = costs(model, 6)
    assert [c.agents for c in found] == [1, 2, 3, 4, 5, 6]
    assert [c.real for c in found] == pytest.approx([1000, 1110, 1230, 1360, 1500, 1650])  # members 5, 6: 140 and 150
    assert found[5].steps == pytest.approx({"random": 600, "SP": 900, "XP": 150, "MP": 0, "simulated": 0})
    assert [c.rule for c in found] == [MEASURED] * 4 + [LINE] * 2 and not found[4].measured
    # Members 2 to 4 took 180 s for 360 steps; 5 and 6 take 140 and 150 steps.
    assert [c.seconds for c in found] == pytest.approx([500, 555, 615, 680, 750, 825])


def test_nothing_is_extrapolated_flat(exact: RunRecord, tmp_path: Path) -> None:
    """Fidelity review, minor findings: a flat line from members 2 and 3 told 358,400 steps where 396,800 were taken."""
    assert [(c.agents, c.real, c.simulated, c.seconds) for c in costs(exact, 4)] == [
        (1, 80, 5000, 60),
        (2, 160, 12_000, 120),
    ]
    few = read_run(finished_run(tmp_path, "few", [{"SP": 9}, {"SP": 100}, {"SP": 200}], seed=5))
    flat = read_run(finished_run(tmp_path, "flat", [{"SP": 100}, *[{"SP": 50, "XP": 10}] * 3], seed=6))
    falling = read_run(finished_run(tmp_path, "falling", [{"SP": 100}, {"SP": 100}, {"SP": 40}, {"SP": 20}], seed=7))
    assert [len(costs(run, 8)) for run in (few, flat, falling)] == [3, 4, 4]
    assert [c.rule for c in costs(flat, 8)] == [MEASURED] * 4


def test_bands_are_over_seeds_and_as_long_as_all_of_them(model: RunRecord, tmp_path: Path) -> None:
    other = read_run(finished_run(tmp_path, "seed1", [{"SP": 2000}, {"SP": 200}], seed=1, seconds=[10.0, None]))
    group = Group("xpm_wm", "xpm_wm", CRAMPED, (model, other))
    band = step_band(group, 3)
    assert band.agents.tolist() == [1, 2] and band.mean.tolist() == pytest.approx([1500, 1655])
    assert band.low.tolist() == pytest.approx([1000, 1110])
    assert band.high.tolist() == pytest.approx([2000, 2200])
    assert band.measured.tolist() == [True, True]
    assert step_band(group, 3, "SP").mean[0] == 1200
    assert len(time_band(group, 3).agents) == 0


# --- equal quality


def held(*figures: tuple[float, float | None], episodes: int = 20) -> HeldScores:
    """Held (SP, XP) of members 1, 2, ..."""
    members = [
        HeldMember(n, Estimate(sp, 0.1), None if xp is None else Estimate(xp, 0.1), None if xp is None else 1)
        for n, (sp, xp) in enumerate(figures, start=1)
    ]
    return HeldScores(episodes, 0, 5000, tuple(members))


LIMITS = Thresholds(8.0, 2.0)
GOOD = held((9.0, None), (8.5, 1.0), (8.0, 2.0), (9.0, 0.0))


def test_steps_to_quality_count_everything_that_a_member_is_built_on(model: RunRecord) -> None:
    """Fidelity review, finding 3: member 2 uses the model and buffers of all of member 1's 1,000 steps, not of the 600
    until its first passage."""
    found = quality_costs(model, LIMITS, GOOD)
    assert [(q.agents, q.steps, q.reached, q.bound) for q in found] == [
        (1, 1000, 1, False),
        (2, 1110, 2, False),
        (3, 1230, 3, False),
        (4, 1360, 4, False),
    ]


def test_a_window_of_training_passes_nobody(model: RunRecord) -> None:
    """Fidelity review, finding 3: first passages are of noisy windows over several policies."""
    poor = held((7.9, None), (8.5, 2.1), (9.0, 0.0), (1.0, 0.0))
    judged = judge_members(model, LIMITS, poor)
    assert [one.passed for one in judged] == [False, False, True, False]
    assert [one.window for one in judged] == [600, 1000 + 80, None, None]
    assert all(cost.bound for cost in quality_costs(model, LIMITS, poor))
    unheld = judge_members(model, LIMITS, None)
    assert [one.passed for one in unheld] == [None] * 4 and unheld[1].window == 1080
    assert all(cost.reached == 0 for cost in quality_costs(model, LIMITS, None))


def test_members_that_learn_together_build_on_each_other(tmp_path: Path) -> None:
    settings = {"diversity": {"order": "concurrent"}}
    run = read_run(finished_run(tmp_path, "both", [{"SP": 10}, {"SP": 10, "XP": 5}], method="lipo", settings=settings))
    assert [cost.steps for cost in quality_costs(run, LIMITS, held((9.0, None), (9.0, 0.0)))] == [25, 25]


def test_simulated_steps_of_predecessors_count_too(exact: RunRecord) -> None:
    found = quality_costs(exact, LIMITS, held((9.0, None), (9.0, 0.0)))
    assert [(cost.steps, cost.simulated) for cost in found] == [(80, 5000), (160, 12_000)]


def test_a_held_evaluation_plays_every_policy_itself(random_population: Path) -> None:
    from popgen.population import load_population

    population = load_population(random_population)
    scores = hold_members(population, 3, 1)
    assert [(one.member, one.partner) for one in scores.members] == [(1, None), (2, 1)]
    assert scores.members[0].xp is None and scores.members[1].xp is not None
    assert scores.steps == (2 + 2) * 3 * 20 and scores == hold_members(population, 3, 1)
    with pytest.raises(UserError, match="at least 1"):
        hold_members(population, 0, 1)


def test_the_strongest_partner_is_judged_over_both_seatings() -> None:
    from support.scripted import ONE, STAY, TWO, Cast, Script

    # A step of (2, 1) scores 1 + 0 in one seating and 10 in the other: mean 5.5; beside member 2 all is larger.
    cast = Cast(Script([STAY]), Script([TWO]), Script([ONE]))
    third = hold_members(cast, 2, 0).members[2]  # type: ignore[arg-type]
    assert third.partner == 2 and third.xp is not None and third.xp.mean == 6 * (21 + 12) / 2
    assert hold_members(cast, 2, 0).members[1].xp == Estimate(6 * (2 + 20) / 2, 0.0)  # type: ignore[arg-type]


def test_of_a_pair_play_with_the_mate_is_held_and_no_cross_play() -> None:
    """ONE beside TWO makes 21 a step in one seating and 12 in the other; STAY beside ONE 1 or 10."""
    from support.scripted import ONE, STAY, TWO, Cast, Script

    cast = Cast(Script([ONE]), Script([TWO]), Script([STAY]), Script([ONE]), pairs=(1, 1, 2, 2))
    first, second, third, fourth = hold_members(cast, 2, 0).members  # type: ignore[arg-type]
    assert first.sp.mean == second.sp.mean == 6 * (21 + 12) / 2 and third.sp.mean == fourth.sp.mean == 6 * (1 + 10) / 2
    assert first.xp is None and second.xp is None and second.partner is None
    assert (third.partner, fourth.partner) == (2, 2) and third.xp is not None and fourth.xp is not None
    assert third.xp.mean == 6 * (20 + 2) / 2 and fourth.xp.mean == 6 * (21 + 12) / 2


def test_thresholds_are_the_papers_or_the_users(model: RunRecord) -> None:
    assert default_thresholds(CRAMPED) == Thresholds(8.18, 2.05) and default_thresholds("rendezvous/mppmr") is None
    groups = group_runs([model])
    assert chosen_thresholds(groups, None, 1.0) == {CRAMPED: Thresholds(8.18, 1.0)}
    far = [Group("lipo", "lipo", "rendezvous/mppmr", ())]
    assert chosen_thresholds(far, None, None) == {}
    assert chosen_thresholds(far, 20.0, -50.0) == {"rendezvous/mppmr": Thresholds(20.0, -50.0)}
    with pytest.raises(UserError, match="--xp"):
        chosen_thresholds(far, 20.0, None)


# --- which runs can be compared


def test_environments_must_agree(tmp_path: Path, model: RunRecord) -> None:
    cooks = read_run(finished_run(tmp_path, "cooks", [{"SP": 1}], method="lipo", params={"cooking": "interact"}))
    with pytest.raises(UserError, match=r"cooks: cooking is interact, in .*model it is auto"):
        group_runs([model, cooks])
    longer = read_run(finished_run(tmp_path, "longer", [{"SP": 1}], method="lipo", params={"horizon": 30}))
    with pytest.raises(UserError, match=r"longer: overcooked/cramped_room is not that of .*model: horizon is 30"):
        group_runs([model, longer])
    ring = read_run(finished_run(tmp_path, "ring", [{"SP": 1}], method="lipo", env=RING))
    assert [group.environment for group in group_runs([ring, model])] == [RING, CRAMPED]


def test_runs_of_one_label_must_be_seeds_of_one_thing(tmp_path: Path, model: RunRecord) -> None:
    seed1 = finished_run(tmp_path, "seed1", [{"SP": 1}], seed=1, settings={"evaluation": {"episodes": 3}})
    assert len(group_runs([model, read_run(seed1)])[0].runs) == 2
    again = finished_run(tmp_path, "again", [{"SP": 1}])
    with pytest.raises(UserError, match="with seed 0, like"):
        group_runs([model, read_run(again)])
    assert len(group_runs([model, read_run(again, "other")])) == 2
    with pytest.raises(UserError, match="again: is .* with seed 0, like .*model"):  # neither is the first
        group_runs([read_run(seed1), model, read_run(again)])
    weak = finished_run(tmp_path, "weak", [{"SP": 1}], seed=2, settings={"agent": {"lambda_xp": 0.0}})
    with pytest.raises(UserError, match=r"agent.lambda_\w+ is .*; tell them apart with NAME=RUN"):
        group_runs([model, read_run(weak)])
    with pytest.raises(UserError, match="given twice"):
        group_runs([model, model])
    with pytest.raises(UserError, match="none to compare"):
        group_runs([])


# --- the paper's numbers


def test_budgets_of_the_baselines_under_both_readings() -> None:
    # Eight agents: 8 budgets of self-play; 28 pairs, or 7 agents that have a partner.
    assert paper.baseline_budget("LIPO", 8, paper.PER_PREDECESSOR, 10) == {"SP": 80, "XP": 280}
    assert paper.baseline_budget("CoMeDi", 8, paper.PER_PREDECESSOR, 10) == {"SP": 80, "XP": 280, "MP": 280}
    assert paper.baseline_budget("CoMeDi", 8, paper.PER_AGENT, 10) == {"SP": 80, "XP": 70, "MP": 70}
    assert paper.xpm_wm_budget(CRAMPED, 8) == 34_000_000 and paper.xpm_wm_budget("overcooked/mine", 8) is None
    ratios = {
        reading: [
            sum(paper.baseline_budget("CoMeDi", 8, reading).values()) / paper.xpm_wm_budget(layout, 8)  # type: ignore[operator]
            for layout in paper.XPM_WM_STEPS
        ]
        for reading in paper.READINGS
    }
    # "At least 3 times more sample efficient than CoMeDi in all layouts" is true of one reading only.
    assert min(ratios[paper.PER_PREDECESSOR]) > 3 > min(ratios[paper.PER_AGENT])


def test_budgets_are_printed_for_the_paper_and_for_our_own_runs(tmp_path: Path, model: RunRecord) -> None:
    steps = [{"SP": 90}, {"SP": 110, "XP": 40}]
    lipo = read_run(finished_run(tmp_path, "ours", steps, method="lipo"))
    found = {(b.source, b.method, b.reading): b for b in budgets(group_runs([model, lipo]), 4)}
    assert len(found) == 6
    assert found["paper", "lipo", paper.PER_AGENT].total == 6_000_000 * (4 + 3)
    assert found["paper", "comedi", paper.PER_PREDECESSOR].ratio == pytest.approx(6 * (4 + 6 + 6) / 26)
    assert found["ours", "lipo", paper.PER_PREDECESSOR].total == 100 * (4 + 6)


def test_the_papers_averages_are_those_of_its_agents() -> None:
    for row in paper.SABOTAGE:
        assert np.mean(row.ended_early) == pytest.approx(row.average, abs=0.006)
    own = [row for row in paper.REPORTED if row.method == paper.OWN_METHOD]
    mean = np.mean([row.sp for row in own if row.environment.startswith("overcooked")])
    assert mean == pytest.approx(12.36, abs=0.005)


# --- the report


@pytest.fixture(scope="module")
def comparison(model: RunRecord, exact: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    root = tmp_path_factory.mktemp("others")
    seed1 = finished_run(root, "seed1", [{"SP": 1200}, {"SP": 90, "XP": 30}], seed=1, scores=(9.0, 3.0))
    steps = [{"SP": 900}, {"SP": 900, "XP": 300, "MP": 300}, {"SP": 900, "XP": 600, "MP": 600}]
    comedi = finished_run(root, "comedi", steps, method="comedi", settings={"diversity": {"order": "sequential"}})
    ring = finished_run(root, "ring", [{"SP": 70}, {"SP": 7}], method="lipo", env=RING)
    runs = [model, read_run(seed1), exact, read_run(comedi), read_run(ring)]
    groups = group_runs(runs)
    scores = {str(run.path): held((9.0, None), *[(8.5, 1.0)] * (len(run.members) - 1)) for run in runs}
    scores[str(model.path)] = held((9.0, None), (8.5, 1.0), (5.0, 0.0), (9.0, 0.0))
    return Comparison(tuple(groups), 8, chosen_thresholds(groups, 8.0, 2.0), scores)


def test_json_holds_the_documented_keys(comparison: Comparison) -> None:
    told = comparison_report.to_dict(comparison)
    documented = re.findall(r"^    (\w[\w, ]*?)  +\S", comparison_report.__doc__ or "", re.M)
    assert set(told) == {key.strip() for line in documented for key in line.split(",")}
    json.dumps(told, allow_nan=False)
    scores = {(row["environment"], row["label"]): row for row in told["scores"]}
    assert scores[CRAMPED, "xpm_wm"]["sp"] == {"mean": 9.5, "low": 9.0, "high": 10.0}
    assert scores[CRAMPED, "xpm_wm"]["gap"] == pytest.approx(7.5)
    assert scores[CRAMPED, "xpm_wm"]["paper"] == {"sp": 10.23, "xp": 0.43}
    assert scores[CRAMPED, "xpm_sim"]["paper"] is None
    run = next(run for run in told["runs"] if run["label"] == "xpm_sim")
    assert (run["real_steps"], run["simulated_steps"], run["evaluation_steps"]) == (160, 12_000, 77)


def test_csv_marks_what_was_extrapolated(comparison: Comparison) -> None:
    told = comparison_report.to_dict(comparison)
    rows = list(csv.DictReader(io.StringIO(comparison_report.costs_csv(told))))
    assert tuple(rows[0]) == comparison_report.COST_FIELDS and len(rows) == 8 + 2 + 2 + 3 + 2
    found = {(row["environment"], row["run"], row["agents"]): row for row in rows}
    assert found[CRAMPED, "model", "4"]["measured"] == "1" and found[CRAMPED, "model", "5"]["measured"] == "0"
    assert found[CRAMPED, "model", "4"]["real_steps"] == "1360" and found[CRAMPED, "model", "5"]["rule"] == LINE
    assert found[CRAMPED, "exact", "2"]["simulated_steps"] == "12000"
    assert found[CRAMPED, "exact", "2"]["real_steps"] == "160"
    assert found[CRAMPED, "comedi", "3"]["MP"] == "900" and (CRAMPED, "comedi", "4") not in found
    good = list(csv.DictReader(io.StringIO(comparison_report.quality_csv(told))))
    assert tuple(good[0]) == comparison_report.QUALITY_FIELDS
    own = [row for row in good if row["run"] == "model"]
    assert [(row["passed"], row["taken"]) for row in own] == [
        ("1", "1000"),
        ("1", "1110"),
        ("0", "1230"),
        ("1", "1360"),
    ]
    assert [row["window"] for row in own] == ["600", "1080", "", ""] and {row["episodes"] for row in own} == {"20"}
    budget = list(csv.DictReader(io.StringIO(comparison_report.budgets_csv(told))))
    assert tuple(budget[0]) == comparison_report.BUDGET_FIELDS and len(budget) == 8 + 4


def test_markdown_names_every_method_the_papers_rows_and_the_marks(comparison: Comparison) -> None:
    text = re.sub(" +", " ", comparison_report.to_markdown(comparison_report.to_dict(comparison)))
    assert "| overcooked/cramped_room | XPM-WM | 2 | 9.50 (9.00 to 10.00) |" in text
    assert "| overcooked/cramped_room | LIPO | 0 | - | - | - | - | - | 8.99 | 2.40 |" in text
    assert "8* |" in text and "XPM-Sim" in text and "| no | 1,230 |" in text
    assert "Simulated steps" in text and "extrapolated" in text
    assert all(
        len(sheet.to_rich().columns) for sheet in comparison_report.to_sheets(comparison_report.to_dict(comparison))
    )


def test_the_headline_is_at_as_many_agents_as_all_have(comparison: Comparison) -> None:
    told = comparison_report.to_dict(comparison)
    rows = {row["label"]: row for row in told["headline"] if row["environment"] == CRAMPED}
    assert {row["agents"] for row in rows.values()} == {2}
    assert rows["xpm_wm"]["steps"] == {"mean": 1215.0, "low": 1110.0, "high": 1320.0} and rows["xpm_wm"]["passed"] == 2
    assert rows["xpm_sim"]["ratio"] == 1.0 and rows["comedi"]["ratio"] == pytest.approx(2400 / 160)
    sheet = next(iter(comparison_report.to_sheets(told)))
    assert "all that it builds on included" in sheet.title
    assert any("held evaluation of its own policy: 20 episodes" in note for note in told["notes"])
    run = next(run for run in told["runs"] if run["label"] == "xpm_sim")
    assert run["held_steps"] == 5000 and run["real_steps"] == 160


def test_the_options_of_every_method_are_told(tmp_path: Path) -> None:
    """Fidelity review, finding 7: unlike recipes behind one column."""
    from popgen.methods.registry import recipe

    usual = {name: part for name, part in recipe("comedi", CRAMPED).as_dict().items() if isinstance(part, dict)}
    settings = {name: part for name, part in usual.items() if name not in ("env", "population", "run")}
    changed = {**settings, "diversity": {**settings["diversity"], "lambda_xp": 0.125}}
    runs = [
        read_run(finished_run(tmp_path, name, [{"SP": 1}], method="comedi", settings=own), name)
        for name, own in (("usual", settings), ("changed", changed))
    ]
    groups = tuple(group_runs(runs))
    told = {row["label"]: row for row in comparison_report.to_dict(Comparison(groups, None, {}))["options"]}
    assert told["usual"]["given"] == {} and told["changed"]["given"] == {"diversity.lambda_xp": 0.125}
    assert told["usual"]["cross_play"]["diversity.lambda_xp"] == usual["diversity"]["lambda_xp"]


def test_charts_are_written_and_told_apart_without_colour(comparison: Comparison, tmp_path: Path) -> None:
    files = comparison_report.write_report(comparison, tmp_path)
    assert set(files) == {
        *("comparison.json", "comparison.md", "costs.csv", "quality.csv", "budgets.csv"),
        *(f"{name}.{suffix}" for name in ("steps", "steps_by_kind", "time", "quality") for suffix in ("png", "svg")),
    }
    assert all(path.stat().st_size for path in files.values())
    svg = files["steps.svg"].read_text()
    for text in ("number of agents M", "real environment steps", "range over seeds", "XPM-Sim"):
        assert text in svg
    assert "simulated steps" in svg
    assert "minutes of training" in files["time.svg"].read_text() and "extrapolated" not in svg
    assert "lower bound" not in files["quality.svg"].read_text()  # at two agents all have passed
    assert imread(files["steps.png"]).std() > 0.02
    again = tmp_path / "again"
    comparison_report.write_report(comparison, again)
    assert (again / "steps.svg").read_text() == svg


def test_looks_keep_a_methods_colour_and_give_others_what_is_left() -> None:
    looks = choose_looks(["xpm_wm", "mine", "lipo", "yours"])
    assert looks["xpm_wm"].colour == METHODS["xpm_wm"].colour
    assert len({look.colour for look in looks.values()}) == 4 == len({look.marker for look in looks.values()})
    assert len({method.colour for method in METHODS.values()}) == len(METHODS)
    assert {row.method for row in paper.REPORTED} <= {method.title for method in METHODS.values()}


def test_a_band_leaves_out_points_that_a_seed_does_not_have() -> None:
    band = Band.over([[(1, 2.0, True), (2, 4.0, False)], [(1, 4.0, True), (2, None, True)], [(1, 6.0, True)]])
    assert band.agents.tolist() == [1] and band.mean.tolist() == [4.0] and band.measured.tolist() == [True]
