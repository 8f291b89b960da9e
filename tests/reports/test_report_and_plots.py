from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from support.scripted import HORIZON, ONE, STAY, TWO, Cast, Script

from popgen.errors import UserError
from popgen.evaluation.crossplay import CrossPlayResult, evaluate_population
from popgen.reports import crossplay_report as report
from popgen.reports import plots


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
    assert told["steps"] == {"evaluation": 12 * 3 * HORIZON} and told["unit"] == "points"
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
    rows = list(csv.DictReader(io.StringIO(report.to_csv(result))))
    assert tuple(rows[0]) == report.CSV_FIELDS and len(rows) == 12 * (3 + 2 * 2)
    found = {(row["seat_0"], row["seat_1"], row["figure"], row["seat"]): row for row in rows}
    assert len(found) == len(rows)
    score = found["1", "2", "score", ""]
    assert (score["mean"], score["standard_error"], score["episodes"], score["pairing"]) == ("126.0", "0.0", "3", "XP")
    assert found["2", "2", "score", ""]["pairing"] == "SP" and found["idle", "2", "score", ""]["pairing"] == "idle"
    assert found["1", "2", "event:two", "1"]["mean"] == "6.0" and found["1", "2", "event:two", "0"]["mean"] == "0.0"


def test_markdown_and_terminal_show_the_matrix(result: CrossPlayResult, alone: CrossPlayResult) -> None:
    text = report.to_markdown(result)
    assert "| 1 | 6.00 ± 0.00 | 126.00 ± 0.00 |" in text and "SP mean 69.00 ± 0.00 points" in text
    assert "XP mean -" in report.to_markdown(alone)
    out = io.StringIO()
    Console(file=out, width=80).print(report.to_rich(result))
    assert "126.00" in out.getvalue() and max(map(len, out.getvalue().splitlines())) <= 80


def test_table_and_summary_can_be_made_of_the_json_alone(result: CrossPlayResult, alone: CrossPlayResult) -> None:
    for each in (result, alone):
        told = json.loads(report.to_json(each))
        assert report.summary_lines(told) == report.summary(each)
        texts = []
        for table in (report.matrix_table(told), report.to_rich(each)):
            out = io.StringIO()
            Console(file=out, width=80).print(table)
            texts.append(out.getvalue())
        assert texts[0] == texts[1] and "idle" in texts[0]
    assert report.figure_text({"mean": 1.25, "standard_error": None}, digits=1) == "1.2"
    assert report.figure_text({"mean": None, "standard_error": None}) == "-"


def test_summary_names_obstruction() -> None:
    helpful, blocking = Script([TWO]), Script([STAY])
    got = evaluate_population(Cast(helpful, blocking), 20, 0)  # type: ignore[arg-type]
    lines = report.summary(got)
    # Seat 1 counts ten times: with `blocking` there, member 1 does worse than beside a random partner.
    assert "pairs (seat 0-seat 1) worse than a random or idle partner: 1-2" in lines, lines
    assert {(found.pair, found.partner, found.member) for found in got.obstructions} == {((1, 2), "random", 1)}


def test_report_files(result: CrossPlayResult, alone: CrossPlayResult, tmp_path: Path) -> None:
    paths = report.write_report(result, tmp_path / "new" / "folder")
    assert [path.name for path in paths.values()] == [f"crossplay.{s}" for s in ("json", "csv", "md", "png", "svg")]
    assert json.loads(paths["json"].read_text()) == report.to_dict(result)
    image = imread(paths["png"])
    assert image.shape[1] >= 900 and image.std() > 0.05
    drawn = paths["svg"].read_text()
    for part in ("126", "player in seat 0", "player in seat 1", "points", "random", "idle", "tally/hand"):
        assert part in drawn, part
    again = report.write_report(result, tmp_path / "again")
    for suffix, path in paths.items():
        assert path.read_bytes() == again[suffix].read_bytes(), suffix
    assert report.write_report(alone, tmp_path / "alone")["png"].stat().st_size > 0


def test_a_folder_that_cannot_be_written(result: CrossPlayResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        report.write_report(result, tmp_path / "file")


@pytest.mark.parametrize("count", [0, 1, 3, 9])
def test_line_charts(tmp_path: Path, count: int) -> None:
    x = np.linspace(0, 6e5, 5)
    plots.learning_curves(
        {f"member {n}": (x, n * x) for n in range(count)}, [tmp_path / "a.svg"], unit="points", title="T"
    )
    drawn = (tmp_path / "a.svg").read_text()
    assert "points" in drawn and "environment steps" in drawn and drawn.count("member ") == count
    totals = {f"run {n}": [(n + 1) * 1e5, (n + 1) * 3e5] for n in range(count)}
    plots.steps_by_members(totals, [tmp_path / "b.svg", tmp_path / "b.png"])
    assert "environment steps in all" in (tmp_path / "b.svg").read_text() and imread(tmp_path / "b.png").size
    plots.steps_by_members(totals, [tmp_path / "c.svg"], log=True)
    assert "members" in (tmp_path / "c.svg").read_text()


def test_steps_are_told_in_thousands_and_millions() -> None:
    assert [plots._thousands(value) for value in (0, 500, 25_000, 1.5e6, 2e9)] == ["0", "500", "25k", "1.5M", "2G"]
