from __future__ import annotations

import base64
import json
import re
import sqlite3
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine
from sqlalchemy.engine import make_url

from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.runs.mlflow_tracker import remove_stray_folder
from popgen.runs.tracking_address import check_uri, sqlite_uri

ODD = ["a?b", "a#b", "a%20b", "a%3Fb", "a b&c=d;e", "ü[x]", "100%", "u:p@host", "plain"]


@pytest.mark.parametrize("name", ODD)
def test_the_store_is_where_its_path_says(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    folder.mkdir()
    uri = sqlite_uri(folder / "mlflow.db")
    check_uri(uri)
    engine = create_engine(uri)
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE runs (id INTEGER)")
    engine.dispose()
    check_uri(uri)
    assert [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()] == [Path(name, "mlflow.db")]


@pytest.mark.parametrize("name", ODD)
def test_no_folder_is_left_beside_the_store(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mlflow.store.db.utils import _make_parent_dirs_if_sqlite as make_folder_as_spelled

    monkeypatch.chdir(tmp_path)
    store = tmp_path / name / "deep#er" / "mlflow.db"
    store.parent.mkdir(parents=True)
    store.touch()
    with remove_stray_folder(sqlite_uri(store)):
        make_folder_as_spelled(sqlite_uri(store))
    assert sorted(tmp_path.rglob("*")) == [tmp_path / name, store.parent, store]


def test_a_plain_path_stays_readable() -> None:
    assert sqlite_uri(Path("/home/me/runs/r-1/mlflow.db")) == "sqlite:////home/me/runs/r-1/mlflow.db"
    assert make_url(sqlite_uri(Path("/a?b/c"))).database == "/a?b/c"


REFUSED = {
    "sqlite:////proc/x.db": "cannot open",
    "sqlite:///{}/nowhere/x.db": "there is no folder",
    "sqlite:///{}": "cannot open",
    "sqlite:///{}/text.db": "not a database",
    "sqlite:///:memory:": "in memory",
    "sqlite://": "cannot track to",
    "file:///tmp/x": "cannot track to",
    "mlruns": "cannot track to",
    "ftp://host": "cannot track to",
    "http://127.0.0.1:9": "no server answers",
    "http://me:secret@127.0.0.1:9": "no server answers at http://***@127.0.0.1:9",
    "http://[bad": "no server answers",
    "postgresql+nodriver://me:secret@127.0.0.1:9/d": "postgresql+nodriver://***@",
    "http://***@host": "give it again",
}


@pytest.mark.parametrize("uri", REFUSED)
def test_a_store_that_cannot_be_opened_is_refused_in_one_line(uri: str, tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("no database, " * 100)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UserError, match=re.escape(REFUSED[uri])) as caught:
        check_uri(uri.format(tmp_path), timeout=2.0)
    assert caught.value.field == "tracking.uri" and "secret" not in str(caught.value)
    assert sorted(tmp_path.iterdir()) == before


def test_a_store_that_is_there_stays_as_it_is(tmp_path: Path) -> None:
    check_uri(None)
    path = tmp_path / "kept.db"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE kept (id INTEGER)")
    connection.close()
    before = path.read_bytes()
    check_uri(f"sqlite:///{path}")
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.fixture
def server() -> Iterator[Any]:
    """A server that wants `user` and `secret`, and notes who came."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            told = self.headers.get("Authorization", "").removeprefix("Basic ")
            seen.append((self.path, base64.b64decode(told).decode()))
            self.send_response(200 if seen[-1][1] == "user:secret" else 401)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Nothing."""

    seen: list[tuple[str, str]] = []
    made = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield made.server_address[1], seen
    made.shutdown()
    made.server_close()


def test_a_server_is_asked_as_mlflow_would(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    port, seen = server
    check_uri(f"http://user:secret@127.0.0.1:{port}/")
    check_uri(f"http://127.0.0.1:{port}")  # it answers, if not to us
    monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "user")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "secret")
    check_uri(f"http://127.0.0.1:{port}")
    assert seen == [("/health", "user:secret"), ("/health", ""), ("/health", "user:secret")]


@pytest.mark.parametrize(
    "address", ["http://me:secret@host:5000", "postgresql://me:secr@et@host/d", "s3://key:secret@b/p"]
)
def test_no_record_of_a_run_holds_a_password(address: str) -> None:
    values = {"method": "mappo", "tracking": {"uri": address}, "run": {"storage": address}}
    config = RunConfig.parse(values)
    assert config.tracking.uri == address == config.run.storage
    kept = json.dumps(config.as_dict())
    assert "secr" not in kept and "me:" not in kept and kept.count("://***@") == 2
    assert RunConfig.parse(config.as_dict()).digest() == config.digest()
    assert "secr" not in str(UserError("tracking.uri", f"cannot use {address}", f"or {address}"))


def test_addresses_without_credentials_are_kept_as_they_are() -> None:
    for text in (
        "http://host/a@b",
        "s3://bucket/user@host",
        "sqlite:////home/a@b/x.db",
        "me@host",
        "see http://host?x=a@b",
    ):
        assert str(UserError("a", text)) == f"a: {text}"
