from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from study.study_folders import CHECK, STEPS, Browser, make_small_study, served
from websockets.exceptions import ConnectionClosed

from popgen.cli import main
from popgen.errors import UserError
from popgen.study.game_records import OPEN
from popgen.study.participant_path import list_stations
from popgen.study.recording_check import check_recordings
from popgen.study.study_definition import Study, read_study
from popgen.study.study_server import StudyService
from popgen.study.study_tables import Database, answers, games, participants, slots, ticks

RECRUIT = "5f9d1b2c3e4a5b6c7d8e9f01"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return make_small_study(tmp_path_factory.mktemp("people"))


@pytest.fixture(scope="module")
def server(study: Study) -> Iterator[tuple[StudyService, str]]:
    with served(study) as found:
        yield found


def rows(service: StudyService, table: Any, **given: Any) -> list[Any]:
    with service.people.database.read() as connection:
        chosen = sa.select(table).filter_by(**given)
        return list(connection.execute(chosen).all())


def own_row(service: StudyService, browser: Browser) -> Any:
    return rows(service, participants, code=browser.state()["code"])[0]


def test_from_consent_to_code(server: tuple[StudyService, str], study: Study) -> None:
    service, address = server
    browser = Browser(address)
    assert browser.state()["status"] == "new"
    assert browser.post("session", {"recruit": RECRUIT})[0] == 200
    assert "consent" in browser.state()["kind"] and "Taking part" in browser.state()["text"]
    assert browser.post("instructions", {})[0] == 409  # not due yet
    browser.post("consent", {"agreed": True, "version": "1"})
    assert any("cooks by itself" in text for text in browser.state()["instructions"])
    browser.post("instructions", {})
    assert browser.post("answers", {"form": "check", "answers": CHECK | {"filling": "an onion"}})[1] == {
        "passed": False
    }
    assert browser.post("answers", {"form": "check", "answers": CHECK})[1] == {"passed": True}
    done = browser.go_on()
    row = own_row(service, browser)
    assert done["status"] == "completed" and done["completion"] == row.completion and row.check_failures == 1
    played = rows(service, games, participant=row.id)
    plan = study.definition.design.plan_slot(row.slot)
    named = [(pair.layout, ego, place, pair.seat) for pair in plan for place, ego in enumerate(pair.egos)]
    assert [(g.layout, g.ego, g.position, g.seat) for g in played[1:]] == named
    assert played[0].ego is None and {g.status for g in played} == {"finished"}
    kept = rows(service, ticks, game=played[1].id)
    assert [tick.step for tick in kept] == list(range(STEPS)) and json.loads(kept[3].keys)[0] == ["ArrowUp", 1, 1.5]
    assert all((tick.action_0, tick.action_1)[played[1].seat] == 0 for tick in kept[1:])
    assert len(rows(service, answers, participant=row.id)) == 3 + 2 * 15 + 3
    assert rows(service, slots, number=row.slot)[0].state == "done"
    again = Browser(address)
    assert again.post("session", {"recruit": RECRUIT})[0] == 409  # once only


@pytest.mark.parametrize("whose", ["person", "ego"])
def test_every_game_is_proven_and_a_flipped_action_found(
    whose: str, server: tuple[StudyService, str], study: Study
) -> None:
    """Also one that changes nothing: whoever stands before a wall may stay or walk against it."""
    service, address = server
    browser = Browser(address)
    browser.pass_check()
    browser.go_on()
    checked = check_recordings(study, service.people.database)
    assert len(checked) >= 5 and not [one for one in checked if one.problem]
    copies = [(table, [row._asdict() for row in rows(service, table)]) for table in (participants, games, ticks)]
    for step in range(STEPS):
        tampered = Database(study.folder / f"tampered-{whose}-{step}.sqlite", study)
        with tampered.write() as target:
            for table, copied in copies:
                target.execute(table.insert(), copied)
            target.exec_driver_sql("DROP TRIGGER ticks_are_final")
            game = target.execute(sa.select(games).where(games.c.ego.is_not(None))).first()
            assert game is not None
            seat = game.seat if whose == "person" else 1 - game.seat
            column = (ticks.c.action_0, ticks.c.action_1)[seat]
            here = (ticks.c.game == game.id) & (ticks.c.step == step)
            target.execute(ticks.update().where(here).values({column: (column + 1) % 6}))
        wrong = [one for one in check_recordings(study, tampered) if one.problem]
        assert [one.game for one in wrong] == [game.id], step
        if whose == "ego":
            assert str(wrong[0].problem).startswith(f"step {step}: ")


def test_recorded_steps_cannot_be_changed(server: tuple[StudyService, str]) -> None:
    service, _ = server
    with pytest.raises(sa.exc.DatabaseError, match="never changed"), service.people.database.write() as connection:
        connection.execute(ticks.update().values(action_0=0))


def test_a_reload_goes_on_where_the_game_was(server: tuple[StudyService, str], study: Study) -> None:
    service, address = server
    browser = Browser(address)
    browser.pass_check()
    browser.play(until=5)
    with browser.line() as line:
        begun = json.loads(line.recv(30))
        assert begun["step"] == 5 and begun["begin"]["steps"] == STEPS
    assert browser.play()["over"] == "finished"
    game = rows(service, games, participant=own_row(service, browser).id)[0]
    assert [tick.step for tick in rows(service, ticks, game=game.id)] == list(range(STEPS))
    assert not [one for one in check_recordings(study, service.people.database) if one.problem]


def test_a_second_tab_takes_the_game_over(server: tuple[StudyService, str]) -> None:
    service, address = server
    browser = Browser(address)
    browser.pass_check()
    with browser.line() as first:
        told = json.loads(first.recv(30))
        first.send(json.dumps({"go": True, "ready": told["step"]}))
        assert json.loads(first.recv(30))["step"] == 1
        with browser.line() as second:
            assert json.loads(second.recv(30))["step"] == 1
            with pytest.raises(ConnectionClosed) as closed:
                first.recv(30)
            assert closed.value.rcvd is not None and closed.value.rcvd.code == 4001
    assert browser.play()["over"] == "finished"
    assert len(rows(service, games, participant=own_row(service, browser).id)) == 1


def test_a_killed_server_goes_on_with_every_game(tmp_path: Path) -> None:
    study = make_small_study(tmp_path)
    with served(study) as (service, address):
        browser = Browser(address)
        browser.pass_check()
        browser.play(until=4)
        where = own_row(service, browser).station
    with served(study) as (service, address):
        browser.address = address
        assert browser.state()["place"] == where and rows(service, games)[0].status == OPEN
        assert browser.go_on()["status"] == "completed"
        assert not [one for one in check_recordings(study, service.people.database) if one.problem]


def test_without_a_key_a_game_is_void_once_and_ends_the_study_then(tmp_path: Path) -> None:
    study = make_small_study(tmp_path, warn_seconds=0.5, end_seconds=0.9)
    with served(study) as (service, address):
        browser = Browser(address)
        browser.pass_check()
        assert browser.play(key="KeyQ")["over"] == "void"  # no key of the game
        assert browser.state()["kind"] == "game"
        assert browser.play()["over"] == "finished"
        assert browser.play(key="KeyQ")["over"] == "void"
        state = browser.state()
        assert state["status"] == "inactive" and state["completion"]
        assert [slot.state for slot in rows(service, slots)] == ["free"]  # returned
        other = Browser(address)
        other.pass_check()
        other.play()
        assert own_row(service, other).slot == 0 and not rows(service, slots, number=1)


def test_a_slot_of_somebody_who_went_away_is_given_on(tmp_path: Path) -> None:
    study = make_small_study(tmp_path, away_minutes=1.0)
    with served(study) as (service, address):
        first, second = Browser(address), Browser(address)
        first.pass_check()
        first.play()
        assert own_row(service, first).slot == 0
        with service.people.database.write() as connection:
            connection.execute(participants.update().values(seen_ms=participants.c.seen_ms - 61_000))
        second.pass_check()
        second.play()
        assert own_row(service, second).slot == 0 and first.state()["status"] == "away"


def test_withdrawal_keeps_and_deletion_removes_everything(server: tuple[StudyService, str]) -> None:
    service, address = server
    stays, goes, later = (Browser(address) for _ in range(3))
    for browser in (stays, goes, later):
        browser.pass_check()
        browser.play()
    kept, *removed = (own_row(service, browser).id for browser in (stays, goes, later))
    code = later.state()["code"]
    assert stays.post("withdraw", {"delete": False})[0] == goes.post("withdraw", {"delete": True})[0] == 200
    assert Browser(address).post("delete", {"code": code})[1] == {"deleted": True}
    assert stays.state()["status"] == "withdrawn" and goes.state()["status"] == "new"
    assert rows(service, games, participant=kept)
    for gone in removed:
        assert not rows(service, games, participant=gone) and not rows(service, answers, participant=gone)
    assert Browser(address).post("delete", {"code": "0" * 20})[1] == {"deleted": False}


def test_whoever_declines_leaves_an_empty_row(server: tuple[StudyService, str]) -> None:
    service, address = server
    browser = Browser(address)
    browser.post("session", {})
    browser.post("consent", {"agreed": False, "version": "1"})
    assert browser.state()["status"] == "declined" and browser.state()["completion"] is None


def test_nothing_of_who_somebody_is_lies_on_the_disk(server: tuple[StudyService, str], study: Study) -> None:
    Browser(server[1]).post("session", {"recruit": "1234567890abcdef12345678"})
    held = b"".join(path.read_bytes() for path in study.folder.iterdir() if path.is_file())
    assert b"1234567890abcdef12345678" not in held and RECRUIT.encode() not in held and b"127.0.0.1" not in held
    columns = {column.name for table in participants.metadata.tables.values() for column in table.columns}
    assert not {one for one in columns for word in ("mail", "address", "prolific", "ip", "name_") if word == one}


def test_a_changed_study_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = make_small_study(tmp_path)
    Database(study.database, study).close()
    (study.folder / "consent.md").write_text("other words")
    with pytest.raises(UserError, match="another study"):
        Database(study.database, read_study(study.folder))
    assert main(["study", "serve", str(tmp_path / "nothing")]) == 2
    text = (study.folder / "study.json").read_text().replace('"tutorials": 1', '"tutorials": -1')
    (study.folder / "study.json").write_text(text)
    assert main(["study", "verify", str(study.folder)]) == 2
    assert "tutorials" in capsys.readouterr().err


def test_stations_are_those_of_the_paper() -> None:
    definition = read_definition()
    kinds = [station.kind for station in list_stations(definition)]
    assert kinds.count("game") == 23 and kinds.count("items") == 10 and kinds[-2:] == ["demographics", "end"]


def read_definition() -> Any:
    from popgen.study.study_definition import Ego, StudyDefinition
    from popgen.study.study_texts import list_check, list_demographics, list_items

    layouts = tuple("abcde")
    ego = [Ego(population="x", member=1, sha256=str(n) * 64) for n in range(4)]
    egos = {name: dict.fromkeys(layouts, ego[n]) for n, name in enumerate("ABC")}
    asked = {"check": list_check("auto"), "items": list_items(), "demographics": list_demographics()}
    return StudyDefinition(layouts=layouts, egos=egos, tutorial=ego[3], **asked)


def test_an_ego_of_the_comparison_cannot_teach() -> None:
    definition = read_definition()
    with pytest.raises(ValueError, match="tutorial's ego"):
        type(definition)(**{**definition.model_dump(), "tutorial": definition.egos["A"]["a"]})
    assert np.unique([len(members) for members in definition.egos.values()]).tolist() == [5]
