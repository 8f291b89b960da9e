"""Targets, their tables as pure functions of a record, and the page of measured results."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from matplotlib.figure import Figure

from popgen.errors import UserError
from popgen.methods.registry import METHODS, list_objectives
from popgen.pipelines.reproduce import name_missing
from popgen.reports.charts import reproduction_charts
from popgen.reports.reproduction.results_page import (
    MOST_BYTES,
    name_record,
    read_record,
    read_records,
    to_page,
    to_record_text,
    to_report,
)
from popgen.reports.reproduction.run_tables import make_sheets, summarise_runs, take_interval, to_rows_csv
from popgen.reports.reproduction.target_registry import ALL, BUDGETS, TARGETS, find_targets

PUBLISHED = ROOT / "docs" / "results"


def run(row: str, seed: int, figures: dict[str, Any], environment: str = "rendezvous/mppmr") -> dict[str, Any]:
    told = {"method": row.partition(",")[0], "command": f"popgen run seed={seed}", "run": f"{row}-{seed}"}
    origin = {"commit": "0123456789", "changed": False, "versions": {}, "machine": "2 cores", "taken_over": seed == 3}
    return {"row": row, "environment": environment, "seed": seed, **told, **origin, "seconds": 60.0, "figures": figures}


def record(target: str, runs: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    head = {"format": "popgen-reproduction", "format_version": 1, "target": target, "budget": "laptop", "seeds": [1]}
    tail = {"settings": [], "episodes": 20, "command": f"popgen reproduce {target}", "written": "2026-01-01"}
    return {**head, **tail, "runs": runs, "missing": [], **more}


def sabotage(seed: int, exits: float, xp: float) -> dict[str, Any]:
    return run("LIPO, paper", seed, {"sabotage": {"any_exit": exits, "xp": xp}})


def test_an_interval_over_seeds_is_students() -> None:
    """1, 2, 3: mean 2, deviation 1, 4.3027 / sqrt(3) = 2.4841 either way."""
    found = take_interval([1.0, 2.0, 3.0])
    assert found is not None and found.mean == 2.0
    assert found.high == pytest.approx(4.4841, abs=1e-4) and found.low == pytest.approx(-0.4841, abs=1e-4)
    assert found.to_text(1) == "2.0 ± 2.5"
    one = take_interval([5.0])
    assert one is not None and one.to_text(2) == "5.00" and take_interval([]) is None


def test_runs_of_a_row_are_its_seeds() -> None:
    rows = summarise_runs(
        record("table1", [sabotage(2, 0.2, -10), sabotage(1, 0.0, -30), run("XPM-Sim, ours", 1, {})]),
        TARGETS["table1"].columns,
    )
    assert [(row.label, row.seeds) for row in rows] == [("LIPO, paper", (1, 2)), ("XPM-Sim, ours", (1,))]
    cells = rows[0].cells
    assert cells["any exit"] is not None and cells["any exit"].mean == pytest.approx(0.1)
    assert cells["SP"] is None and rows[1].cells["any exit"] is None


def test_the_papers_rows_stand_below_ours() -> None:
    sheet = make_sheets(record("table1", [sabotage(1, 0.067, -22.2)]), TARGETS["table1"])[0]
    table = sheet.frame.set_index("")
    assert table.loc["LIPO, paper", "any exit"] == "0.067" and table.loc["LIPO (paper)", "any exit"] == "0.59"
    assert table.loc["XPM-Sim (paper)", "XP"] == "-114.5" and sheet.dim == {1, 2, 3}
    assert "landmarks" not in table.columns  # nobody has that figure


def test_a_cell_that_some_seeds_lack_says_so_and_one_seed_has_no_interval() -> None:
    """Steps until all members pass are known of the seeds where they do: their mean is not that of all seeds."""
    runs = [sabotage(1, 0.5, -3), sabotage(2, 0.7, -5), run("LIPO, paper", 3, {"sabotage": {"any_exit": 0.9}})]
    told = record("table1", runs)
    table = make_sheets(told, TARGETS["table1"])[0].frame.set_index("")
    assert table.loc["LIPO, paper", "XP"].endswith(" (2 of 3)") and "of" not in table.loc["LIPO, paper", "any exit"]
    rows = list(csv.DictReader(to_rows_csv(record("table1", runs[:1]), TARGETS["table1"]).splitlines()))
    assert (rows[0]["XP"], rows[0]["XP low"], rows[0]["XP high"]) == ("-3.0", "", "")


def test_csv_has_ours_and_the_papers() -> None:
    lines = to_rows_csv(record("table1", [sabotage(1, 0.5, -3), sabotage(2, 0.7, -5)]), TARGETS["table1"]).splitlines()
    assert lines[0].startswith("source,row,environment,seeds,any exit,any exit low,any exit high,own exit")
    assert lines[1].startswith('popgen,"LIPO, paper",rendezvous/mppmr,1 2,0.6,') and lines[2].startswith("paper,LIPO")


@pytest.mark.parametrize("budget", BUDGETS.values(), ids=BUDGETS)
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_every_target_lists_runs_that_its_columns_can_be_filled_from(target: Any, budget: Any) -> None:
    runs = target.list_runs(budget, budget.seeds)
    measured = {name for one in runs for name in one.measures}
    assert runs and {column.figure.partition(".")[0] for column in target.columns} <= measured
    assert len(set(runs)) == len(runs)
    assert {one.seed for one in runs} == set(budget.seeds)
    titles = {column.title for column in target.columns}
    assert all(name in titles for name in target.charted) or all("." in name for name in target.charted)
    assert target.chart in reproduction_charts.CHARTS


def test_the_table_of_sabotage_has_every_objective_and_the_generators_every_method() -> None:
    budget = BUDGETS["laptop"]
    assert len(TARGETS["table1"].list_runs(budget, [1])) == len(list_objectives())
    rows = {one.row for one in TARGETS["generators"].list_runs(budget, [1])}
    assert rows == {method.title for method in METHODS.values() if not method.trains_ego}


def test_every_generator_has_an_ego_beside_the_same_holdouts_and_people() -> None:
    runs = TARGETS["generators"].list_runs(BUDGETS["laptop"], [1, 2])
    egos = [one for one in runs if one.teachers]
    assert len(egos) == len(runs) / 2 and all(set(one.measures) == {"holdout", "human"} for one in egos)
    for seed in (1, 2):
        for layout in BUDGETS["laptop"].layouts:
            holdouts = {one.holdouts for one in egos if one.seed == seed and f"env={layout}" in one.teachers[0].words}
            assert len(holdouts) == 1 and {other.seed for other in next(iter(holdouts))} == {3 - seed}
    figures = {column.figure for column in TARGETS["generators"].columns}
    wanted = ("scores.sp", "scores.xp", "scores.mixed", "scores.obstructed", "diversity.log_determinant")
    wanted += ("diversity.effective_rank", "conventions.nearest", "holdout.average", "human.score")
    wanted += ("diversity.members", "acting.share")
    assert {*wanted, "costs.real", "costs.simulated", "costs.minutes"} <= figures
    assert {name_missing(one, runs) for one in runs if one.row == "LIPO"} == {"LIPO", "LIPO's ego"}
    alone = TARGETS["ego"].list_runs(BUDGETS["laptop"], [1])
    assert {name_missing(one, alone) for one in alone} == {one.row for one in alone}


def test_an_ego_is_held_against_populations_that_it_never_met() -> None:
    for seeds in ((1, 2, 3), (1,)):
        for one in TARGETS["ego"].list_runs(BUDGETS["laptop"], seeds):
            taught, held = ({other.seed for other in runs} for runs in (one.teachers, one.holdouts))
            assert len(taught) == len(held) == 1 and taught != held and len(one.holdouts) == 4
            assert {other.words[1] for other in (*one.teachers, *one.holdouts)} == {one.teachers[0].words[1]}
    egos = TARGETS["ego"].list_runs(BUDGETS["laptop"], [1])
    assert {one.method for one in egos} == {"hipt", "fcp"} and {len(one.teachers) for one in egos} == {1, 4}
    assert len({one.row for one in egos}) == 10


def test_a_target_that_is_not_there() -> None:
    with pytest.raises(UserError, match="table1"):
        find_targets("table9")
    assert find_targets(ALL) == list(TARGETS.values())


@pytest.mark.parametrize("name", TARGETS)
def test_charts_and_reports_of_incomplete_records(name: str, tmp_path: Path) -> None:
    """One run without figures, and one with a curve: something is drawn, nothing fails."""
    figures = {
        "curves": {"later": [[0, 1.0], [10, 2.0]], "later_simulated": [[0, 1.0], [5, 3.0]]},
        "costs": {"by_members": [5, 9], "minutes_by_members": [1.0, 2.0], "real": 9},
        "scores": {"sp": 3.0, "xp": 1.0},
    }
    room = "overcooked/cramped_room"
    missing = [{"row": "LIPO", "environment": room, "seed": 2, "why": "not made yet"}]
    one = record(name, [run("XPM-WM", 1, figures, room), run("LIPO", 1, {}, room)], missing=missing)
    reproduction_charts.draw_target(one, TARGETS[name], [tmp_path / "chart.png"])
    assert (tmp_path / "chart.png").stat().st_size > 1000
    assert "Not run: LIPO in overcooked/cramped_room, seed 2." in to_report(one)


def test_panels_of_an_environment_name_their_rows_once() -> None:
    """At the left, ours and the paper's."""
    target = TARGETS["table1"]
    rows, names = summarise_runs(record("table1", [sabotage(1, 0.0, -30)]), target.columns), []
    for axes, title in zip(Figure().subplots(1, 2), target.charted, strict=True):
        reproduction_charts._draw_bar_panel(axes, rows, target, "rendezvous/mppmr", title)
        names.append([label.get_text() for label in axes.get_yticklabels()])
    assert names[0] == ["LIPO, paper", "LIPO (paper)", "CoMeDi (paper)", "XPM-Sim (paper)"] and names[1] == [""] * 4


ROOM = "overcooked/cramped_room"


def flatten(text: str) -> str:
    return " ".join(text.split())


def test_the_episodes_of_a_runs_own_evaluation_are_told_and_none_that_are_not_known() -> None:
    """Runs are taken over whatever their own evaluation was: one of two episodes is not called one of twenty."""
    two, twenty = (run("LIPO", n, {"scores": {"sp": 9.0, "episodes": n}}, ROOM) for n in (2, 20))
    old = run("LIPO", 3, {"scores": {"sp": 9.0}, "held": {"passed": 1}}, ROOM)
    own = "SP, XP, play beside random and idle partners and mixed play are of the runs' own evaluations"
    told = flatten(to_report(record("sp-xp", [two, twenty])))
    assert f"{own}, with 2 to 20 episodes for each pair." in told and "made for this table" not in told
    told = flatten(to_report(record("baselines", [old])))
    assert f"{own}. " in told and "Other figures of play are of evaluations made for this table, with 20" in told
    told = flatten(to_report(record("sp-xp", [old, twenty])))
    assert f"{own}, with 20 episodes for each pair, where that is known." in told
    told = flatten(to_report(record("wall-clock", [run("LIPO", 1, {"costs": {"real": 9}}, ROOM)])))
    assert "episodes" not in told


def generators() -> dict[str, Any]:
    """A run of HSP with four members that plays, and one of FCP with one final member of three."""
    meanings = {"definitions": {"diversity": "2, of 3", "acting": "2, of 3", "scores": "2"}}
    pairs = {"members": 4, "of": 3, "effective_rank": 2.5}
    acting = {"members": 4, "trajectories": 1.0397, "share": 0.75}
    hsp = run("HSP", 1, {"scores": {"sp": 9.99}, "diversity": pairs, "acting": acting}, ROOM) | meanings
    few = {"diversity": {"members": 3, "of": 3}, "acting": {"finals": 1, "needed": 3}, "costs": {"simulated": 5}}
    return record("generators", [hsp, run("FCP", 1, few, ROOM) | meanings])


def test_populations_of_different_size_are_compared_by_what_does_not_grow_with_it() -> None:
    told = generators()
    table = make_sheets(told, TARGETS["generators"])[0].frame.set_index("")
    assert table["members"].tolist()[:2] == ["4", "3"] and table.loc["HSP", "effective rank"] == "2.5"
    share = table["divergence of trajectories, of ln K"]
    assert share.tolist()[:2] == ["0.75", "-"] and table.loc["FCP", "simulated steps"] == "5"
    text = flatten(to_report(told))
    assert "BR-Div is of 3 members, as many as the smallest population here has" in text
    assert "left out where there are fewer than 3 of them: FCP (1)." in text


def test_figures_of_an_older_meaning_are_not_printed() -> None:
    """Of members of pairs SP was play with themselves; of the others it was what it is."""
    figures = {"scores": {"sp": 0.0}, "diversity": {"effective_rank": 3.3}, "costs": {"real": 7}}
    old = record("generators", [run("HSP", 1, figures, ROOM), run("MEP", 1, figures, ROOM)])
    table = make_sheets(old, TARGETS["generators"])[0].frame.set_index("")
    assert table.loc["HSP", "SP"] == "-" and table.loc["MEP", "SP"] == "0.00" and table.loc["HSP", "real steps"] == "7"
    assert "effective rank" not in table.columns


def test_a_page_of_records_is_the_same_twice(tmp_path: Path) -> None:
    for name in ("sp-xp", "table1"):
        (tmp_path / f"{name}.json").write_text(to_record_text(record(name, [sabotage(3, 0.1, -1.0)])))
    first, again = to_page(read_records(tmp_path)), to_page(read_records(tmp_path))
    assert first == again and first.index("Self-sabotage") < first.index("## Self-play and cross-play")
    assert "1 of 1 runs were not made by this command but taken" in first
    (tmp_path / "other.json").write_text(json.dumps({"format": "popgen-crossplay"}))
    with pytest.raises(UserError, match="no record of popgen reproduce"):
        read_records(tmp_path)


def test_records_of_one_target_stand_beside_each_other(tmp_path: Path) -> None:
    eight, three = (
        record("sp-xp", [sabotage(3, 0.1, -1.0)]) | {"settings": [f"population.size={size}"]} for size in (8, 3)
    )
    for one in (eight, three):
        (tmp_path / f"{name_record(one)}.json").write_text(to_record_text(one))
    assert name_record(eight) == "sp-xp-laptop-population.size=8"
    headings = [line for line in to_page(read_records(tmp_path)).splitlines() if line.startswith("## ")]
    assert [line.rpartition(", ")[2] for line in headings] == ["population.size=3", "population.size=8"]


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="nothing is published")
def test_the_published_page_is_that_of_the_published_records() -> None:
    """No number of docs/results.md is typed by hand, and each has a command and a machine."""
    assert to_page(read_records(PUBLISHED)) == (ROOT / "docs" / "results.md").read_text()
    for path in PUBLISHED.glob("*.json"):
        assert path.stat().st_size < MOST_BYTES
        for one in read_record(path)["runs"]:
            assert one["command"].startswith("popgen ") and {"commit", "machine", "taken_over"} <= set(one)
