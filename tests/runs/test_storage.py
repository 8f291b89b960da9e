"""A run's folder and its copy in another place."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from popgen.errors import UserError
from popgen.runs.storage import LATEST, Mirror, open_storage


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "storage.json"
    }


def make_run(root: Path) -> Path:
    run = root / "runs" / "r"
    (run / "checkpoints" / "progress_000001").mkdir(parents=True)
    (run / "checkpoints" / "progress_000001" / "values.json").write_text("{}")
    (run / "ledger.jsonl").write_text("one\n")
    return run


@pytest.fixture
def place(tmp_path: Path) -> str:
    return f"file://{tmp_path}/store"


def test_a_lost_folder_comes_back(tmp_path: Path, place: str) -> None:
    run = make_run(tmp_path)
    (run / "run.lock").write_text("me")
    (run / "x.writing").mkdir()
    (run / "x.writing" / "half").write_text("ha")
    Mirror(run, place).push()
    wanted = contents(run)
    shutil.rmtree(run)
    assert Mirror(run, place).pull() == f"restored from {place}/r"
    assert contents(run) == {name: data for name, data in wanted.items() if name not in ("run.lock", "x.writing/half")}


def test_only_what_changed_is_sent_and_what_nobody_needs_is_removed(tmp_path: Path, place: str) -> None:
    run, sent = make_run(tmp_path), []
    mirror = Mirror(run, place)
    replace = mirror._replace_object
    mirror._replace_object = lambda name, data: (sent.append(name), replace(name, data))[1]  # type: ignore[method-assign]
    mirror.push()
    assert len(sent) == 3 and sent[-1] == LATEST
    sent.clear()
    for text in ("one\ntwo\n", "one\ntwo\nthree\n"):
        (run / "ledger.jsonl").write_text(text)
        mirror.push()
    assert [name == LATEST for name in sent] == [False, True, False, True]
    objects = tmp_path / "store" / "r" / "objects"
    assert sorted(path.read_text() for path in objects.iterdir()) == ["one\ntwo\n", "one\ntwo\nthree\n", "{}"]


def test_a_copy_that_was_interrupted_leaves_the_one_before(tmp_path: Path, place: str) -> None:
    run = make_run(tmp_path)
    mirror = Mirror(run, place)
    mirror.push()
    before = contents(run)
    (run / "ledger.jsonl").write_text("two\n")
    replace = mirror._replace_object

    def dies(name: str, data: bytes) -> None:
        if name == LATEST:
            raise OSError("unplugged")
        replace(name, data)

    mirror._replace_object = dies  # type: ignore[method-assign]
    with pytest.raises(OSError, match="unplugged"):
        mirror.push()
    shutil.rmtree(run)
    Mirror(run, place).pull()
    assert contents(run) == before


def test_the_folder_that_wrote_the_copy_is_left_as_it_is(tmp_path: Path, place: str) -> None:
    run = make_run(tmp_path)
    assert Mirror(run, place).pull() is None  # no copy yet
    Mirror(run, place).push()
    (run / "ledger.jsonl").write_text("newer than the copy\n")
    assert Mirror(run, place).pull() is None
    assert (run / "ledger.jsonl").read_text() == "newer than the copy\n"


def test_another_machine_that_went_on_is_followed(tmp_path: Path, place: str) -> None:
    here, there = make_run(tmp_path), tmp_path / "elsewhere" / "r"
    Mirror(here, place).push()
    other = Mirror(there, place)
    assert other.pull() is not None
    assert Mirror(there, place).pull() is None  # nothing newer than what it has
    (there / "ledger.jsonl").write_text("two\n")
    other.push()
    told = Mirror(here, place).pull()
    assert told is not None and "r.stale0" in told
    assert (here / "ledger.jsonl").read_text() == "two\n"
    assert (here.parent / "r.stale0" / "ledger.jsonl").read_text() == "one\n"


def test_a_store_in_use_is_copied_whole(tmp_path: Path, place: str) -> None:
    run = make_run(tmp_path)
    with sqlite3.connect(run / "mlflow.db") as writer:
        writer.execute("create table points (x)")
        writer.execute("insert into points values (1)")
        writer.commit()
        writer.execute("insert into points values (2)")  # not yet committed
        Mirror(run, place).push()
    shutil.rmtree(run)
    Mirror(run, place).pull()
    with sqlite3.connect(run / "mlflow.db") as reader:
        assert reader.execute("select x from points").fetchall() == [(1,)]


def test_any_file_system_of_fsspec_will_do(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    Mirror(run, "memory://somewhere").push()
    wanted = contents(run)
    shutil.rmtree(run)
    assert Mirror(run, "memory://somewhere").pull() and contents(run) == wanted


@pytest.mark.parametrize("uri", ["nosuch://x", "s3:///"])
def test_a_place_that_cannot_be_opened_is_one_line(uri: str) -> None:
    with pytest.raises(UserError, match="run.storage") as caught:
        open_storage(uri)
    assert "\n" not in str(caught.value)


def damage(document: dict[str, Any], how: str) -> Any:
    files = document["files"]
    digest = files["ledger.jsonl"]
    changes = {
        "format": lambda: document.update(format=99),
        "outside": lambda: files.update({"../../evil": digest}),
        "absolute": lambda: files.update({"/tmp/evil": digest}),
        "digest": lambda: files.update({"ledger.jsonl": ["../../../etc/passwd", 1]}),
        "no files": lambda: document.pop("files"),
        "object missing": lambda: files.update({"ledger.jsonl": ["0" * 64, 1]}),
    }
    changes[how]()
    return document


@pytest.mark.parametrize("how", ["format", "outside", "absolute", "digest", "no files", "object missing"])
def test_a_bad_copy_is_one_line_and_nothing_is_written(tmp_path: Path, place: str, how: str) -> None:
    run = make_run(tmp_path)
    Mirror(run, place).push()
    latest = tmp_path / "store" / "r" / LATEST
    latest.write_text(json.dumps(damage(json.loads(latest.read_text()), how)))
    shutil.rmtree(run)
    with pytest.raises(UserError, match="run.storage") as caught:
        Mirror(run, place).pull()
    assert "\n" not in str(caught.value) and not run.exists() and not (tmp_path / "evil").exists()


@pytest.mark.parametrize(
    "content", [b"[" * 100_000, b"[]", b"\xff", b'{"format": 1}', b'{"format": 1, "writer": "x", "files": {"a": 3}}']
)
def test_a_list_of_files_that_is_none_is_one_line(tmp_path: Path, place: str, content: bytes) -> None:
    run = make_run(tmp_path)
    Mirror(run, place).push()
    (tmp_path / "store" / "r" / LATEST).write_bytes(content)
    with pytest.raises(UserError, match=f"run.storage: .*{LATEST} is unreadable") as caught:
        Mirror(run, place).pull()
    assert "\n" not in str(caught.value) and (run / "ledger.jsonl").read_text() == "one\n"


def test_a_turned_bit_is_noticed(tmp_path: Path, place: str) -> None:
    run = make_run(tmp_path)
    Mirror(run, place).push()
    path = next((tmp_path / "store" / "r" / "objects").iterdir())
    path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:])
    shutil.rmtree(run)
    with pytest.raises(UserError, match="is damaged"):
        Mirror(run, place).pull()
