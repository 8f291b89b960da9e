"""Malformed, oversized and forged input, drawn with a seed: no error of the server's, nobody's game disturbed.
POPGEN_HOSTILE is the number of malformed messages."""

from __future__ import annotations

import http.client
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from study.study_folders import STEPS, Browser, make_small_study, served
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from popgen.study.recording_check import check_recordings
from popgen.study.study_messages import LARGEST_BODY, LARGEST_MESSAGE, read_game_message
from popgen.study.study_tables import answers, games, participants

NAMES = ("session", "consent", "instructions", "answers", "withdraw", "delete", "state", "game", "nothing")
PATHS = (
    *("/../study.json", "/..%2fstudy.json", "/records.sqlite", "//etc/passwd", "/%2e%2e/%2e%2e/etc/passwd"),
    *("/study.json", "/secret.key", "/api/../secret.key", "/study_page.js/../../secret.key", "/api/state/%00"),
    *("/\\..\\secret.key", "/docs", "/openapi.json", "/study.css%00.key", "/api//state", "/" + "a" * 4000),
    *("/?file=../secret.key", "/export/steps.parquet"),
)
ODD = ("", "x", "0", None, True, -1, 1e308, 2**70, "\u0000", "a" * 3000, [], {}, [[]], {"a": {}}, "'; DROP TABLE games")
COUNT = int(os.environ.get("POPGEN_HOSTILE", "300"))
METHODS = ("POST", "POST", "POST", "POST", "GET", "PUT", "DELETE", "HEAD", "OPTIONS")


def draw_value(rng: np.random.Generator, depth: int = 0) -> Any:
    """Something that JSON can hold."""
    kind = rng.integers(6)
    if depth < 3 and kind == 0:
        return [draw_value(rng, depth + 1) for _ in range(rng.integers(4))]
    if depth < 3 and kind == 1:
        keys = (
            "agreed",
            "version",
            "form",
            "answers",
            "delete",
            "code",
            "recruit",
            "keys",
            "go",
            "steps",
            "ready",
            "x",
        )
        return {str(rng.choice(keys)): draw_value(rng, depth + 1) for _ in range(rng.integers(4))}
    return ODD[rng.integers(len(ODD))]


def draw_body(rng: np.random.Generator) -> bytes:
    """Bytes that are, or nearly are, a body or a message."""
    kind = rng.integers(5)
    if kind == 0:
        return rng.bytes(int(rng.integers(200)))
    text = json.dumps(draw_value(rng))
    if kind == 1:
        return text[: int(rng.integers(len(text) + 1))].encode()
    if kind == 2:
        return b"[" * int(rng.integers(1, 5000))
    return text.encode()


def ask(address: str, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, bytes]:
    """A request exactly as given; what is no request of HTTP at all is not sent."""
    host, _, port = address.partition(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=30)
    try:
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


@pytest.mark.parametrize("seed", [0])
def test_malformed_messages_disturb_nobody(tmp_path: Path, seed: int) -> None:
    study, rng = make_small_study(tmp_path), np.random.default_rng(seed)
    with served(study) as (service, address):
        good, bad = Browser(address), Browser(address)
        for browser in (good, bad):
            browser.pass_check()
        good.play(until=3)
        secrets = [(study.folder / name).read_bytes() for name in ("secret.key", "study.json")]
        for _ in range(COUNT * 7 // 10):
            cookie = str(
                rng.choice(["", bad.cookie, "popgen_study=" + "a" * 43, "popgen_study=%00", "x=" + "y" * 2000])
            )
            method = str(
                rng.choice(["POST", "GET", "PUT", "DELETE", "HEAD", "OPTIONS"], p=[0.7, 0.1, 0.05, 0.05, 0.05, 0.05])
            )
            kind = str(rng.choice(["application/json", "text/plain", "application/x-www-form-urlencoded", ""]))
            headers = {"Content-Type": kind, "Cookie": cookie}
            status, told = ask(address, method, f"/api/{rng.choice(NAMES)}", draw_body(rng), **headers)
            assert status < 500, told
        for path in PATHS:
            try:
                status, told = ask(address, "GET", path)
            except http.client.InvalidURL:
                continue
            assert status < 500 and not any(secret in told for secret in secrets), path
        for _ in range(COUNT * 3 // 10):
            body = draw_body(rng)
            with connect(f"ws://{address}/api/game", additional_headers={"Cookie": bad.cookie}) as line:
                try:
                    line.recv(30)
                    line.send(body if rng.random() < 0.3 else body.decode("latin-1"))
                    if read_game_message(body.decode("latin-1")) is None:
                        while True:
                            line.recv(30)
                except ConnectionClosed:
                    pass
        assert good.play()["over"] == "finished" and good.go_on()["status"] == "completed"
        checked = check_recordings(study, service.people.database)
        assert not [one for one in checked if one.problem] and sum(one.status == "finished" for one in checked) == 5
        with service.people.database.read() as connection:
            assert connection.scalar(sa.select(sa.func.count()).select_from(games)) in (5, 6)


def test_bodies_are_bounded_and_other_sites_refused(tmp_path: Path) -> None:
    study = make_small_study(tmp_path)
    with served(study) as (service, address):
        browser = Browser(address)
        assert browser.post("session", b"x" * (LARGEST_BODY + 1))[0] == 413
        assert browser.post("session", {}, Origin="https://elsewhere.example")[0] == 403
        assert browser.post("session", {}, Origin="null")[0] == 403
        assert browser.post("session", {"recruit": "x" * 101})[0] == 422
        assert browser.post("session", {}, Origin=f"http://{address}")[0] == 200
        browser.pass_check()
        with pytest.raises(InvalidHandshake):
            connect(f"ws://{address}/api/game", origin="https://elsewhere.example")  # type: ignore[arg-type]
        with browser.line() as line:
            line.recv(30)
            line.send("x" * (LARGEST_MESSAGE * 4 + 1))
            with pytest.raises(ConnectionClosed):
                line.recv(30)
        with service.people.database.read() as connection:
            assert connection.scalar(sa.select(sa.func.count()).select_from(participants)) == 1


def test_a_forged_session_sees_and_changes_nothing(tmp_path: Path) -> None:
    study = make_small_study(tmp_path)
    with served(study) as (service, address):
        owner = Browser(address)
        owner.pass_check()
        with service.people.database.read() as connection:
            kept = connection.execute(sa.select(participants.c.session)).scalar_one()
        for token in (kept, "1", "' OR 1=1 --", owner.state()["code"]):
            status, told = ask(address, "GET", "/api/state", Cookie=f"popgen_study={token}")
            assert status == 200 and json.loads(told)["status"] == "new"
            body, kind = json.dumps({"delete": True}).encode(), "application/json"
            given = {"Cookie": f"popgen_study={token}", "Content-Type": kind}
            assert ask(address, "POST", "/api/withdraw", body, **given)[0] == 401
        given = {"Cookie": f"popgen_study={kept}"}
        with connect(f"ws://{address}/api/game", additional_headers=given) as line, pytest.raises(ConnectionClosed):
            line.recv(30)
        assert owner.state()["kind"] == "game"


def test_answers_of_no_form_are_refused(tmp_path: Path) -> None:
    study = make_small_study(tmp_path)
    with served(study) as (service, address):
        browser = Browser(address)
        browser.pass_check()
        for form in ("check", "pair_0", "demographics", "consent"):
            assert browser.post("answers", {"form": form, "answers": {}})[0] == 409
        with service.people.database.read() as connection:
            assert connection.scalar(sa.select(sa.func.count()).select_from(answers)) == 3


@pytest.mark.parametrize(
    "text",
    [
        *("", "x", "[]", "{}", '{"a": 1}', '{"go": 1}', '{"go": true, "x": 1}', '{"keys": 3}', '{"keys": [["a", 1]]}'),
        *('{"keys": [["a", true, 1]]}', '{"keys": [["a", 1, -1]]}', '{"keys": [["a", 1, 1e400]]}', '{"seen": true}'),
        *('{"ready": -1}', '{"seen": 1.5}', '{"ready": 2147483648}', '{"keys": [["a", 1, NaN]]}', "[" * 1000),
        '{"keys": [' + '["a", 1, 1],' * 16 + '["a", 1, 1]]}',
        '{"keys": [["' + "a" * 21 + '", 1, 1]]}',
        *('{"steps": 3}', '{"steps": [[0, "00", 0, 0, 1, 1]]}', '{"steps": [[0, "0", 0, 0, 1, 1, []]]}'),
        *('{"steps": [[0, "zz", 0, 0, 1, 1, []]]}', '{"steps": [[0, "00", 0, -1, 1, 1, []]]}'),
        *('{"steps": [[null, "00", 0, 0, 1, 1, []]]}', '{"steps": [[0, "00", 0, 0, 1, 1, [1]]]}', '{"latency": "1"}'),
        '{"steps": [' + '[0, "00", 0, 0, 1, 1, []],' * 4 + '[0, "00", 0, 0, 1, 1, []]]}',
        '{"steps": [[0, "' + "00" * 513 + '", 0, 0, 1, 1, []]]}',
    ],
)
def test_what_is_no_message(text: str) -> None:
    assert read_game_message(text) is None


def test_what_is_a_message() -> None:
    told = read_game_message('{"keys": [["Space", 1, 3.5]], "go": true, "seen": 4}')
    assert told is not None and told.go and told.seen == 4 and told.ready is None and not told.hidden
    assert [(one.code, one.down, one.at) for one in told.keys] == [("Space", True, 3.5)] and STEPS > 3
    played = read_game_message('{"steps": [[7, "00ff", 5, 4, 20, 300, []]], "latency": 2}')
    assert played is not None and played.latency == 2 and played.steps[0].state == b"\x00\xff"
    assert played.steps[0].actions == (5, 4) and (played.steps[0].time_ms, played.steps[0].late_us) == (20, 300)
