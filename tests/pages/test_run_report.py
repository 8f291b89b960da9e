from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import pytest
from support.finished import finished_run

from popgen.cli import main
from popgen.errors import UserError
from popgen.pages.report_charts import colour_matrix
from popgen.pages.report_source import read_source
from popgen.pages.run_report import CARD, choose_games, report_page, write_run_report
from popgen.population import load_population

pytestmark = pytest.mark.usefixtures("quick_pictures")

MEGABYTES = 2**20


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two members with curves, mixed play and figures of a world model."""
    steps = [{"SP": 4000, "random": 1000}, {"SP": 500, "XP": 400, "MP": 300, "simulated": 900}]
    curves = {1: [(1000, 2.0, None), (5000, 9.0, None)], 2: [(600, 8.0, 0.5), (1200, 9.0, 0.5)]}
    folder = finished_run(tmp_path_factory.mktemp("runs"), "two", steps, curves=curves, settings={"scale": "demo"})
    with (folder / "metrics.jsonl").open("a") as file:
        for member in (1, 2):
            row = {"member": member, "step": 9, "seconds": 60.0 * member, "report/exact_step1": 0.5}
            file.write(json.dumps(row | {"agent/imagined_shaped_sp": 0.2, "real_shaped_sp": 0.1}) + "\n")
    return folder


def test_a_run_and_its_population_give_the_same_page(run: Path) -> None:
    page = report_page(read_source(run))
    assert page == report_page(read_source(run / "population")) and len(page) < 3 * MEGABYTES
    for part in ("What it means", "SP/XP matrix", "Mixed play", "World model", "Imagined against real", "Provenance"):
        assert part in page, part
    assert "<td>300</td>" in page and "1,200" in page and "900" in page  # MP steps; real ones of member 2; simulated
    assert "popgen run method=xpm_wm env=overcooked/cramped_room scale=demo" in page
    assert not re.search(r"""(src|href)=["'](?!#|data:)|@import|https?://""", page)
    pictures = [base64.b64decode(held) for held in re.findall(r"data:image/svg\+xml;base64,([\w+/=]+)", page)]
    assert len(pictures) == 5 and all(b"seed 0" in picture for picture in pictures)
    assert str(run.parent) not in page  # no paths of this machine


def test_the_page_is_the_card_too(run: Path, tmp_path: Path) -> None:
    files = write_run_report(read_source(run))
    assert files == {"report": run / "report" / "report.html", "card": run / "population" / CARD}
    assert files["report"].read_bytes() == files["card"].read_bytes()
    assert len(load_population(run)) == 2  # the card is no obstacle
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        write_run_report(read_source(run), tmp_path / "file" / "x.html")


def test_a_population_alone_is_evaluated_once(run: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    shutil.copytree(run / "population", alone)
    source = read_source(alone, episodes=2)
    assert source.folder is None and source.run.scores["episodes"] == 2 and source.run.members[1].real == 1200
    page = report_page(source)
    assert "Not kept with this population" in page and "obstruction" in page
    assert main(["evaluate", str(alone), "--episodes", "3", "--quiet"]) == 0
    assert read_source(alone, episodes=2).run.scores["episodes"] == 3


def test_an_unfinished_run_is_its_population_and_a_damaged_one_is_refused(run: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (copy / "report" / "crossplay.json").unlink()
    assert read_source(copy, episodes=1).folder is None
    shutil.copy(run / "report" / "crossplay.json", copy / "report")
    (copy / "ledger.jsonl").write_text("x\n")
    with pytest.raises(UserError, match="no ledger entry"):
        read_source(copy)
    with pytest.raises(UserError, match="is not a population"):
        read_source(tmp_path)


def test_the_command(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(run), "--out", str(tmp_path / "a.html"), "--json", "--quiet"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["files"]["report"] == str(tmp_path / "a.html") and told["bytes"] == (tmp_path / "a.html").stat().st_size
    assert {"text", "good"} == set(told["findings"][0])
    assert main(["report", str(run), "--quiet"]) == 0 and "card.html" in capsys.readouterr().out
    assert main(["compare", str(run / "population"), "--out", str(tmp_path / "c"), "--no-tracking", "--quiet"]) == 0
    assert main(["show", str(run)]) == 0 and main(["report", str(tmp_path)]) == 2


@pytest.mark.parametrize("spelled", ["{}/two", "two", "two/population", "."])
def test_the_next_commands_take_the_run_as_it_was_given(
    spelled: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run if spelled == "." else run.parent.parent if "{}" in spelled else run.parent)
    given = spelled.format(run.parent.name)
    page = report_page(read_source(given))
    assert f"<code>popgen play {given.removesuffix('/population')} --watch 1 2</code>" in page


@pytest.mark.parametrize(("members", "games"), [(1, 1), (2, 4), (6, 36), (8, 36), (30, 40)])
def test_replays_are_chosen_by_their_number(members: int, games: int) -> None:
    chosen = choose_games(range(1, members + 1))
    assert len(chosen) == len(set(chosen)) == games and chosen[0] == ("1", "1")


def test_members_of_pairs_play_the_replays_with_their_mates_first() -> None:
    chosen = choose_games((2, 1, 4, 3))
    assert chosen[:4] == [("1", "2"), ("2", "1"), ("3", "4"), ("4", "3")]
    assert len(chosen) == len(set(chosen)) == 4 + 8


def test_the_page_of_pairs_says_that_they_play_with_their_mates(tmp_path: Path) -> None:
    extras = [{"role": role, "pair": pair} for pair in (1, 2) for role in ("biased", "partner")]
    page = report_page(read_source(finished_run(tmp_path, "pairs", [{"SP": 10}] * 4, extras=extras)))
    assert "play with the mate (bold) is SP" in page and "dishes with its mate" in page
    assert "Members of pairs have none" in page and "The diagonal is self-play" not in page
    assert '"players":["1","2"],"kind":"SP"' in page.replace(" ", "")


def test_ink_can_be_read_on_every_ground() -> None:
    labels = ["1", "random", "idle"]
    pairs = [
        {"seat_0": a, "seat_1": b, "score": {"mean": 1.5 * n, "standard_error": None}}
        for n, (a, b) in enumerate((a, b) for a in labels for b in labels if "1" in (a, b))
    ]
    rows = colour_matrix({"members": [1], "pairs": pairs})
    assert [label for label, _ in rows] == labels
    inks = {cell.ground: cell.ink for _, cells in rows for cell in cells if cell.text}
    assert set(inks.values()) == {"#000000", "#ffffff"}
