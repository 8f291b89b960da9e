from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import sqlalchemy as sa
from study.study_folders import STEPS, Browser, make_small_study, served

from popgen.errors import UserError
from popgen.evaluation.convention_effects import collect_samples
from popgen.evaluation.played_games import count_table_games
from popgen.humans.record_tables import COLUMNS, read_table_games
from popgen.study.study_tables import Database, games, ticks

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study that two people have finished; one has only begun."""
    study = make_small_study(tmp_path_factory.mktemp("exported"))
    with served(study) as (_, address):
        for _ in range(2):
            browser = Browser(address)
            browser.pass_check()
            browser.go_on()
        Browser(address).post("session", {"recruit": "somebody"})
    return study.folder


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_tables_hold_what_was_recorded_and_go_into_conventions(folder: Path, run: Run, kind: str) -> None:
    code, out, err = run("study", "export", str(folder), "--out", "out", "--format", kind, "--json")
    assert code == 0, err
    assert json.loads(out)["games"] == 10 and json.loads(out)["steps"] == 10 * STEPS
    read = read_table_games(Path("out") / f"steps.{kind}")
    with Database(folder / "records.sqlite").read() as connection:
        rows = connection.execute(sa.select(games).order_by(games.c.id)).all()
        for row, game in zip(rows, read, strict=True):
            own = connection.execute(sa.select(ticks).where(ticks.c.game == row.id).order_by(ticks.c.step)).all()
            assert [step.state for step in own] == [state.tobytes() for state in game.states]
            assert [[step.action_0, step.action_1] for step in own] == game.actions.tolist()
            assert game.people == (row.seat == 0, row.seat == 1) and game.dishes.sum() == row.score
    grouped = count_table_games(read)
    assert set(grouped) == {"people with A", "people with B", "people with tutorial"}
    samples = collect_samples(grouped["people with A"])
    assert len(samples.dishes) == 4 and len(np.unique(samples.clusters)) == 2  # people's seats alone
    code, out, err = run("conventions", "--records", f"out/steps.{kind}", "--json")
    assert code == 0, err
    assert [one["label"] for one in json.loads(out)["players"]] == ["people with A", "people with B"]


def test_the_fields_columns_come_first_and_nobodys_codes_leave(folder: Path, run: Run) -> None:
    assert run("study", "export", str(folder), "--out", "out")[0] == 0
    table = pd.read_parquet("out/steps.parquet")
    assert tuple(table.columns[:14]) == COLUMNS
    first = table.iloc[0]
    assert json.loads(first["joint_action"])[0] in ([0, 1], [0, -1], [1, 0], [-1, 0], [0, 0], "interact")
    assert json.loads(first["state"])["timestep"] == 0 and first["time_left"] == pytest.approx(STEPS * 0.15)
    people = pd.read_csv("out/participants.csv")
    assert people["participant"].tolist() == ["p0001", "p0002"] and not {"code", "session", "recruit"} & set(people)
    assert len(pd.read_csv("out/completions.csv")) == 2 and len(pd.read_csv("out/answers.csv")) == 2 * (3 + 2 * 15 + 3)


def test_games_of_other_rules_are_refused(folder: Path, run: Run) -> None:
    assert run("study", "export", str(folder), "--out", "out", "--format", "csv")[0] == 0
    table = pd.read_csv("out/steps.csv")
    moved = table.copy()
    moved.loc[3, "joint_action"] = json.dumps(["interact", [0, 1]])
    lost = table.drop(index=5)
    for number, wrong in enumerate((moved, lost, table.drop(columns="state"))):
        wrong.to_csv(f"wrong{number}.csv", index=False)
    for name in ("wrong1.csv", "wrong2.csv", "nothing.csv"):
        with pytest.raises(UserError):
            read_table_games(Path(name))
