"""Tables that are wider than the terminal."""

from __future__ import annotations

import pandas as pd
import pytest

from popgen.cli.printing import print_sheet
from popgen.reports.frames import Sheet

FRAME = pd.DataFrame(
    [["HiPT", "4.79", "2.27 ± 0.1", "12"], ["FCP", "10.00", "-", "7"]],
    columns=["ego", "mean dishes", "spread", "worst"],
)


def test_a_table_that_fits_stays_one() -> None:
    """Widths: `| HiPT ` 7, `| dishes ` 9, `| 2.27 ± 0.1 ` 13, `| worst ` 8, and the last line: 38."""
    sheet = Sheet("scores", FRAME)
    assert sheet.split(38) == [sheet]
    parts = sheet.split(37)
    assert [list(part.frame.columns) for part in parts] == [["ego", "mean dishes", "spread"], ["ego", "worst"]]
    assert [part.title for part in parts] == ["scores", "scores (continued)"]


def test_each_part_has_a_figure_however_narrow_and_marks_stay_with_their_cells() -> None:
    sheet = Sheet("scores", FRAME, dim=frozenset({1}), bold=frozenset({(0, 3), (1, 1), (1, 0)}))
    parts = sheet.split(5)
    assert [list(part.frame.columns[1:]) for part in parts] == [["mean dishes"], ["spread"], ["worst"]]
    assert [part.bold for part in parts] == [{(1, 1), (1, 0)}, {(1, 0)}, {(0, 1), (1, 0)}]
    assert all(part.dim == {1} and list(part.frame["ego"]) == ["HiPT", "FCP"] for part in parts)


def test_sentences_break_at_words() -> None:
    """Widths: `| HiPT ` 7, `| advantage ` 12, and the last line: 20."""
    sheet = Sheet(
        "given", pd.DataFrame([["HiPT", "advantage bounded by 1.5 from the start"]], columns=["ego", "given"])
    )
    assert sheet.split(20) == [sheet]


@pytest.mark.parametrize("width", [24, 30, 37, 38, 80])
def test_no_figure_is_cut(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    print_sheet(Sheet("scores", FRAME), width)
    shown = capsys.readouterr().out
    assert "…" not in shown and all(cell in shown for cell in FRAME.iloc[:, 1:].to_numpy().ravel())
    assert max(map(len, shown.splitlines())) <= width


def test_a_table_that_just_fits_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    """Widths 9, 14, 7, 13, 6 and three of 10, and the last line: 80. Rich alone cuts it at its last column."""
    cells = ["1", "world_model", "1001", "433,414", "3.3", "400,000", "473,600", "873,600"]
    columns = ["member", "policy", "seed", "parameters", "MiB", "random steps", "SP steps", "all steps"]
    print_sheet(Sheet("members", pd.DataFrame([cells], columns=columns), labels=2), 80)
    lines = capsys.readouterr().out.splitlines()
    assert {len(line.rstrip()) for line in lines[1:]} == {80} and all(cell in lines[-2] for cell in cells)
