"""Names that users give are text: no console, table or picture reads marks into them."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from popgen.progress import RichReporter
from popgen.reports.charts.chart_style import COLUMN, styled_figure
from popgen.reports.frames import Sheet

Run = Callable[..., tuple[int, str, str]]
ODD = ["run [x]", "[bold]v2[/bold]", "[/]", ":warning: up", "back\\", "a|b", "50 $ or $ 60", "[link=http://x]y[/link]"]


def printed(table: object) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ODD)
def test_tables_show_names_as_they_are(name: str) -> None:
    sheet = Sheet(f"titled {name}", pd.DataFrame({name: [name], "score": ["1"]}))
    text = printed(sheet.to_rich())
    assert f"titled {name}" in text and text.count(name) == 3
    rows = sheet.to_markdown().splitlines()
    assert name.replace("|", r"\|") in rows[-1]


@pytest.mark.parametrize("name", ODD)
def test_notes_show_names_as_they_are(name: str) -> None:
    stream = io.StringIO()
    reporter = RichReporter(stream)
    reporter.note(f"run {name}")
    reporter.close()
    assert f"run {name}" in stream.getvalue()


@pytest.mark.parametrize("name", ["[x]", ":x: [b]y[/b]"])
def test_commands_show_paths_as_they_are(name: str, run: Run, random_population: Path) -> None:
    shutil.copytree(random_population, Path(name) / "population")
    code, out, _ = run("show", f"{name}/population")
    assert code == 0 and out.splitlines()[0].split() == ["population", *f"{name}/population".split()]


def test_the_list_of_runs_is_whole_and_plain(run: Run) -> None:
    """Ids of any length are all there; the last error has a line of its own."""
    name = "xpm_wm-counter_circuit_o_1order-s1-20261126-151500-3f9a2c"
    folder = Path("[runs]") / name
    folder.mkdir(parents=True)
    values = {"method": "xpm_wm", "scale": "smoke", "env": {"name": "overcooked/a [v2]"}, "population": {"size": 2}}
    (folder / "config.json").write_text(json.dumps(values))
    error = "training: [nan] " + "loss " * 60
    (folder / "state.json").write_text(json.dumps({"state": "failed", "attempt": 1, "error": error.strip()}))
    code, out, _ = run("runs", "[runs]")
    assert code == 0 and name in out and "runs in [runs]" in out and "overcooked/a [v2]" in out
    assert out.splitlines()[-1] == f"{name}: {error.strip()}"


def test_a_title_with_dollars_is_no_formula(tmp_path: Path) -> None:
    """An unfinished formula would end in an error, a whole one would lose its signs."""
    path = tmp_path / "titled.svg"
    with styled_figure([path], COLUMN, 2.0) as drawn:
        drawn.suptitle("$x and $5")
    assert "$x and $5" in path.read_text()
