from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from matplotlib.image import imread
from rich.console import Console
from support.scripted import HORIZON, ONE, STAY, TWO, Cast, Script

from popgen.errors import UserError
from popgen.evaluation.crossplay import CrossPlayResult, evaluate_population
from popgen.reports import crossplay_report as report
from popgen.reports.charts.curve_charts import learning_curves, score_limits, steps_by_members
from popgen.reports.frames import (
    Sheet,
    estimate_text,
    number_text,
    range_text,
    seeds_text,
    spread_of,
    steps_text,
    to_csv,
)
from popgen.reports.training_curves import Point


def squeezed(text: str) -> str:
    """Without the blanks that align a Markdown table."""
    return re.sub(" +", " ", text)


@pytest.fixture(scope="module")
def result() -> CrossPlayResult:
    return evaluate_population(Cast(Script([ONE], [STAY]), Script([TWO])), 3, 0)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def alone() -> CrossPlayResult:
    """One member, one episode: no cross-play, no standard errors."""
    return evaluate_population(Cast(Script([ONE])), 1, 0)  # type: ignore[arg-type]


def test_json_holds_the_documented_keys(result: CrossPlayResult) -> None:
    told = json.loads(report.to_json(result))
    documented = re.findall(r"^    (\w[\w, ]*?)  +\S", report.__doc__ or "", re.M) + ["event_names, event_weights"]
    assert set(told) == {key.strip() for line in documented for key in line.split(",")}
    assert told["matrix"]["mean"] == [[6, 126], [12, 132]] and told["matrix"]["standard_error"] == [[0, 0], [0, 0]]
    assert told["sp"] == {"mean": 69, "standard_error": 0} and told["xp"]["mean"] == 69
    assert told["steps"] == {"evaluation": (12 * 3 + 6 * 2) * HORIZON} and told["unit"] == "points"
    assert told["beside"]["idle"]["seat_1"]["mean"] == (6 + 12) / 2
    assert told["beside"]["idle"]["seat_0"]["mean"] == (0 + 120) / 2
    assert len(told["pairs"]) == 12 and len(told["pairs"][0]["scores"]) == 3
    one = next(pair for pair in told["pairs"] if (pair["seat_0"], pair["seat_1"]) == ("1", "2"))
    assert one["score"]["mean"] == 126 and one["reward"]["mean"] == 252 and one["shaped_return"]["mean"] == 36
    assert one["events"] == [[6, 0], [0, 6]]
    assert told["obstruction"]["random"] is False and isinstance(told["obstruction"]["pairs"], list)


def test_json_has_null_where_nothing_is_known(alone: CrossPlayResult) -> None:
    told = json.loads(report.to_json(alone), parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
    assert told["xp"] == {"mean": None, "standard_error": None}
    assert told["sp"] == {"mean": 66, "standard_error": None} and told["matrix"]["standard_error"] == [[None]]


def test_csv_is_one_figure_a_row(result: CrossPlayResult) -> None:
    rows = list(csv.DictReader(io.StringIO(report.figures_csv(result))))
    assert tuple(rows[0]) == report.CSV_FIELDS and len(rows) == 12 * (3 + 2 * 2)
    found = {(row["seat_0"], row["seat_1"], row["figure"], row["seat"]): row for row in rows}
    assert len(found) == len(rows)
    score = found["1", "2", "score", ""]
    assert (score["mean"], score["standard_error"], score["episodes"], score["pairing"]) == ("126.0", "0.0", "3", "XP")
    assert found["2", "2", "score", ""]["pairing"] == "SP" and found["idle", "2", "score", ""]["pairing"] == "idle"
    assert found["1", "2", "event:two", "1"]["mean"] == "6.0" and found["1", "2", "event:two", "0"]["mean"] == "0.0"


def test_markdown_and_terminal_show_the_matrix(result: CrossPlayResult, alone: CrossPlayResult) -> None:
    text = report.to_markdown(report.to_dict(result))
    assert "| 1 | 6.00 ± 0.00 | 126.00 ± 0.00 |" in squeezed(text) and "SP mean 69.00 ± 0.00 points" in text
    assert "XP mean -" in report.to_markdown(report.to_dict(alone))
    out = io.StringIO()
    Console(file=out, width=80).print(report.matrix_sheet(report.to_dict(result), narrow=True).to_rich())
    assert "126.00" in out.getvalue() and max(map(len, out.getvalue().splitlines())) <= 80


def test_table_and_summary_can_be_made_of_the_json_alone(result: CrossPlayResult, alone: CrossPlayResult) -> None:
    for each in (result, alone):
        text = json.loads(report.to_json(each))
        assert report.summary(text) == report.summary(report.to_dict(each))
        tables = []
        for table in (report.matrix_sheet(text).to_rich(), report.matrix_sheet(report.to_dict(each)).to_rich()):
            out = io.StringIO()
            Console(file=out, width=80).print(table)
            tables.append(out.getvalue())
        assert tables[0] == tables[1] and "idle" in tables[0]


@pytest.fixture(scope="module")
def pairs() -> CrossPlayResult:
    """ONE beside TWO makes 126 or 72 of 6 steps, STAY beside STAY nothing."""
    cast = Cast(Script([ONE]), Script([TWO]), Script([STAY]), Script([STAY]), pairs=(3, 3, 12, 12))
    return evaluate_population(cast, 3, 0)  # type: ignore[arg-type]


def test_a_report_of_pairs_says_so(pairs: CrossPlayResult) -> None:
    told = report.to_dict(pairs)
    assert told["mates"] == [2, 1, 4, 3] and report.list_own_scores(told) == {1: 99.0, 2: 99.0, 3: 0.0, 4: 0.0}
    assert told["sp"]["mean"] == 49.5 and told["mixed_play"]["members"] == [] and report.has_pairs(told)
    assert report.summary(told)[0] == report.PAIRS_LINE and "SP mean 49.50 ± 0.00 points" in report.summary(told)
    assert report.mixed_play_sheet(told) is None
    assert report.matrix_sheet(told).bold == {(0, 2), (1, 1), (2, 4), (3, 3)}
    rows = csv.DictReader(io.StringIO(report.figures_csv(pairs)))
    kinds = {(row["seat_0"], row["seat_1"]): row["pairing"] for row in rows}
    assert (kinds["1", "2"], kinds["4", "3"], kinds["1", "1"], kinds["1", "3"]) == ("SP", "SP", "itself", "XP")
    assert kinds["random", "2"] == "random"


def test_a_report_of_an_older_version_is_put_right(pairs: CrossPlayResult, result: CrossPlayResult) -> None:
    """Members of pairs stood there as strangers: SP was the diagonal, XP held play with the mate."""
    right = report.to_dict(pairs)
    old = report.to_dict(replace(pairs, mates={}))
    del old["mates"]
    assert old["obstruction"]["comparisons"] == 12 * 4 != right["obstruction"]["comparisons"]
    old |= {"sp": {"mean": 0.0, "standard_error": 0.0}, "xp": {"mean": 4.0, "standard_error": 0.1}}
    old["mixed_play"] = {"episodes": 2, "members": [{"member": 1}], "cases": []}
    assert report.restate_pairs(old, (2, 1, 4, 3)) == right
    assert report.restate_pairs(right, (2, 1, 4, 3)) == right
    alone = report.to_dict(result)
    del alone["mates"]
    assert report.restate_pairs(alone, (1, 2)) == alone and report.list_own_scores(alone) == {1: 6.0, 2: 132.0}


def test_obstruction_counts_the_pairs_that_could_meet(pairs: CrossPlayResult) -> None:
    told = report.to_dict(pairs)
    told["obstruction"]["pairs"] = [{"pair": [1, 3]}]
    assert any("1 of 8 pairs are worse" in line for line in report.list_warnings(told))


def test_figures_as_text() -> None:
    assert estimate_text({"mean": 1.25, "standard_error": None}, digits=1) == "1.2"
    assert estimate_text({"mean": None, "standard_error": None}) == "-" == number_text(None)
    assert estimate_text({"mean": 1.0, "standard_error": 0.5}) == "1.00 ± 0.50"
    assert spread_of([1.0, None, 4.0]) == {"mean": 2.5, "low": 1.0, "high": 4.0}
    assert spread_of([None]) == {"mean": None, "low": None, "high": None}
    assert range_text(spread_of([1.0, None, 4.0])) == "2.50 (1.00 to 4.00)"
    assert range_text(spread_of([2.0, 2.0]), 3) == "2.000" and range_text(spread_of([])) == "-"
    assert seeds_text([3]) == "seed 3" and seeds_text([1, 2]) == "seeds 1, 2"


def test_tables_keep_types_and_take_labels_as_they_are() -> None:
    text = to_csv([{"a": 1, "b": None, "c": 0.1}, {"a": 2, "b": 3}], ("b", "a", "c"))
    assert text == "b,a,c\n,1,0.1\n3,2,\n"
    sheet = Sheet("[bold]title", pd.DataFrame([{"name": "[red]x", "score": "1.50"}]))
    assert sheet.to_markdown().splitlines() == ["| name | score |", "| :-- | --: |", "| [red]x | 1.50 |"]
    out = io.StringIO()
    Console(file=out, width=80).print(sheet.to_rich())
    assert "[red]x" in out.getvalue() and "[bold]title" in out.getvalue()


def test_summary_names_obstruction() -> None:
    helpful, blocking = Script([TWO]), Script([STAY])
    got = evaluate_population(Cast(helpful, blocking), 20, 0)  # type: ignore[arg-type]
    lines = report.summary(report.to_dict(got))
    # Seat 1 counts ten times: with `blocking` there, member 1 does worse than beside a random partner.
    told = "obstruction: 1 of 2 pairs are worse than a random or idle partner (p <= 0.05): 1-2"
    assert told in lines and told in report.list_warnings(report.to_dict(got)), lines
    assert {(found.pair, found.partner, found.member) for found in got.obstructions} == {((1, 2), "random", 1)}


def test_report_files(result: CrossPlayResult, alone: CrossPlayResult, tmp_path: Path) -> None:
    paths = report.write_report(result, tmp_path / "new" / "folder")
    assert [path.name for path in paths.values()] == [f"crossplay.{s}" for s in ("json", "csv", "md", "png", "svg")]
    assert json.loads(paths["json"].read_text()) == report.to_dict(result)
    image = imread(paths["png"])
    assert image.shape[1] >= 900 and image.std() > 0.05
    drawn = paths["svg"].read_text()
    for part in (
        "126",
        "player in seat 0",
        "player in seat 1",
        "points",
        "random",
        "idle",
        "tally/hand, by_hand, seed 0",
    ):
        assert part in drawn, part
    again = report.write_report(result, tmp_path / "again")
    for suffix, path in paths.items():
        assert path.read_bytes() == again[suffix].read_bytes(), suffix
    assert report.write_report(alone, tmp_path / "alone")["png"].stat().st_size > 0


def test_a_folder_that_cannot_be_written(result: CrossPlayResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        report.write_report(result, tmp_path / "file")


@pytest.mark.parametrize("count", [0, 1, 3, 8, 9])
def test_learning_curves_have_a_colour_a_member_and_a_dash_a_score(tmp_path: Path, count: int) -> None:
    curves = {
        member: [Point(100_000 * n, float(member * n), None if member == 1 else n / 2) for n in range(5)]
        for member in range(1, count + 1)
    }
    files = [tmp_path / "a.svg", tmp_path / "a.png"]
    learning_curves(curves, files, unit="points", title="T", limits=score_limits(curves))
    drawn = files[0].read_text()
    assert "points" in drawn and "real environment steps of the member" in drawn and drawn.count(">member ") == count
    assert ("strongest XP" in drawn) == (count > 1) and imread(files[1]).size
    texts = re.findall(r"translate\(([\d.]+) [\d.]+\)[^>]*>member", drawn)
    assert all(float(x) < 3.4 * 72 - 25 for x in texts)  # no entry of the legend is cut at the right


def test_scores_of_several_figures_have_one_scale() -> None:
    curves = {1: [Point(0, 4.0, None)], 2: [Point(0, 1.0, -2.0)]}
    assert score_limits(curves) == (-2.3, 4.3) and score_limits({}) is None
    assert score_limits({1: [Point(0, 10.0, None)]}) == (0.0, 10.5)


@pytest.mark.parametrize("count", [0, 1, 8])
def test_steps_by_members(tmp_path: Path, count: int) -> None:
    steps_by_members([(n + 1) * 1e5 for n in range(count)], [tmp_path / "b.svg", tmp_path / "b.png"], title="T")
    assert "real environment steps in all" in (tmp_path / "b.svg").read_text() and imread(tmp_path / "b.png").size


def test_steps_are_told_in_thousands_and_millions() -> None:
    assert [steps_text(value) for value in (0, 500, 25_000, 1.5e6, 2e9)] == ["0", "500", "25k", "1.5M", "2G"]
