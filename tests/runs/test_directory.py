"""What a run's folder tells of the run, and that one driver at a time works on it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

from popgen import cli
from popgen.config.run_config import RunConfig
from popgen.errors import UserError
from popgen.methods.xpm_wm.config import XpmWmRun
from popgen.pipelines.population import run_population
from popgen.progress import NullReporter
from popgen.runs import directory as runs
from popgen.runs.directory import RunState, describe_run, list_runs
from popgen.runs.ledger import Ledger
from popgen.runs.storage import MARK, Mirror
from popgen.types import Kind, LedgerEntry

HOLD = (
    "import sys; from pathlib import Path; from popgen.runs.directory import RunState; "
    "state = RunState(Path(sys.argv[1]))"
)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for a lock that is not going to be free."""
    monkeypatch.setattr(runs, "_WAIT", 0.1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run of three members of which one is there, with 30 random and 12 self-play steps."""
    path = tmp_path / "runs" / "first"
    (path / "population").mkdir(parents=True)
    values = XpmWmRun().as_dict()
    values["population"]["size"] = 3
    (path / "config.json").write_text(json.dumps(values))
    (path / "population" / "manifest.json").write_text(json.dumps({"members": [{"id": 1}]}))
    ledger = Ledger(path / "ledger.jsonl")
    for sequence, (kind, steps) in enumerate([(Kind.RANDOM, 30), (Kind.SP, 5), (Kind.SP, 7)]):
        ledger.record(LedgerEntry("first", 1, kind, "sampler0", sequence, steps, 0, 0.0))
    ledger.flush()
    return path


@pytest.fixture
def elsewhere(folder: Path) -> Any:
    """A process that works on the run until its input ends."""
    done = f"{HOLD}; state.start(1); print('ready', flush=True); sys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", done, folder], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


@pytest.mark.usefixtures("impatient")
def test_a_living_driver_is_seen_and_keeps_others_out(folder: Path, elsewhere: Any) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    told = describe_run(folder)
    assert (told["state"], told["member"], told["size"]) == ("running", 2, 3)
    assert told["steps"] == {"random": 30, "SP": 12} and told["total_steps"] == 42
    with pytest.raises(UserError, match=rf"first is being run by process {elsewhere.pid} on {socket.gethostname()}"):
        RunState(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


@pytest.mark.usefixtures("impatient")
def test_a_copy_elsewhere_does_not_replace_the_folder_of_a_living_driver(folder: Path, elsewhere: Any) -> None:
    copy = folder.parent / "storage"
    Mirror(folder, copy.as_uri()).push()
    (folder / MARK).unlink()  # so that the copy is another machine's
    config = RunConfig.parse(
        {
            "env": {"name": "rendezvous/mppmr"},
            "run": {"root": str(folder.parent), "id": folder.name, "storage": copy.as_uri()},
        }
    )
    with pytest.raises(UserError, match=f"first is being run by process {elsewhere.pid}"):
        run_population(config, reporter=NullReporter())
    assert not (folder / MARK).exists() and [p.name for p in folder.parent.iterdir()].count("first.stale0") == 0
    elsewhere.kill()
    elsewhere.wait()
    RunState.check_free(folder)
    RunState.check_free(folder.parent / "none")


def test_a_driver_that_is_killed_leaves_an_interrupted_run_that_can_be_taken_up(folder: Path, elsewhere: Any) -> None:
    elsewhere.kill()
    elsewhere.wait()
    told = describe_run(folder)
    assert (told["state"], told["error"], told["attempt"]) == ("interrupted", None, 1)
    state = RunState(folder)
    state.start(2)
    state.end("FINISHED")
    assert (describe_run(folder)["state"], describe_run(folder)["attempt"]) == ("finished", 2)


@pytest.mark.usefixtures("impatient")
def test_one_process_has_a_run_once_and_reading_its_files_does_not_end_that(folder: Path) -> None:
    state = RunState(folder)
    with (folder / runs.LOCK).open():
        pass  # a record lock would end here
    with pytest.raises(UserError, match=f"first is being run by process {os.getpid()}"):
        RunState(folder)
    state.release()
    RunState(folder).release()


@pytest.mark.usefixtures("impatient")
def test_looking_at_a_run_does_not_end_its_lock(folder: Path, elsewhere: Any) -> None:
    for _ in range(20):
        assert describe_run(folder)["state"] == "running"
    with pytest.raises(UserError):
        RunState(folder)


@pytest.mark.parametrize(
    ("status", "error", "state", "told"),
    [
        ("FINISHED", None, "finished", None),
        ("FAILED", UserError("training", "loss is\nnan", "lower it"), "failed", "training: loss is nan; lower it"),
        ("FAILED", RuntimeError(), "failed", "RuntimeError"),
        ("FAILED", RuntimeError("a\nb" + "x" * 1000), "failed", "a b" + "x" * 497),
        ("FAILED", RuntimeError("\x1b[36mray::Tracker\x1b[39m says"), "failed", "ray::Tracker says"),
        ("FAILED", OSError("http://me:secret@host/x"), "failed", "OSError: http://***@host/x"),
        ("KILLED", SystemExit(15), "interrupted", "interrupted by SIGTERM"),
        ("KILLED", KeyboardInterrupt(), "interrupted", "interrupted by Ctrl-C"),
    ],
)
def test_how_it_ended(folder: Path, status: str, error: BaseException | None, state: str, told: str | None) -> None:
    recorder = RunState(folder)
    recorder.start(1)
    recorder.end(status, error)
    found = describe_run(folder)
    assert (found["state"], found["error"]) == (state, told)


def test_seconds_are_those_of_all_attempts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(runs.time, "time", lambda: now)
    first = RunState(folder)
    first.start(1)
    for name in ("state.json", "ledger.jsonl"):  # it is killed, 40 s after it began last heard of
        os.utime(folder / name, (1040, 1040))
    first.release()
    assert describe_run(folder)["seconds"] == 40
    now = 2000.0
    second = RunState(folder)
    second.start(2)
    now = 2002.5
    second.end("FAILED", ValueError("x"))
    assert describe_run(folder)["seconds"] == 42.5
    now = 3000.0
    third = RunState(folder)
    third.start(3)
    now = 3001.0
    third.end("FINISHED")
    assert describe_run(folder)["seconds"] == 43.5


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("config.json", b"{"),
        ("config.json", b"[]"),
        ("config.json", b'{"method": "xpm_wm"}'),
        ("config.json", b"[" * 100_000),
        ("config.json", b'{"method": 1, "scale": 1, "env": {"name": 1}, "population": {"size": Infinity}}'),
        ("state.json", b"[]"),
        ("state.json", b"\xff"),
        ("state.json", b'{"began": "yesterday"}'),
        ("state.json", b'{"began": NaN}'),
        ("state.json", b'{"error": 3}'),
        ("state.json", b'{"seconds": [1]}'),
        ("state.json", b'{"attempt": true}'),
        ("population/manifest.json", b'{"members": 3}'),
        ("ledger.jsonl", b"{}\n"),
        ("ledger.jsonl", b'{"kind": "SP", "steps": "x"}\n'),
        ("ledger.jsonl", b'{"kind": "SP", "steps": Infinity}\n'),
    ],
)
def test_a_damaged_run_is_named_and_hides_no_other(folder: Path, name: str, content: bytes) -> None:
    (folder / name).write_bytes(content)
    other = folder.parent / "second"
    other.mkdir()
    (other / "config.json").write_text(json.dumps(XpmWmRun().as_dict()))
    (folder.parent / "no_run").mkdir()
    found = {run["id"]: run for run in list_runs(folder.parent)}
    assert found.keys() == {"first", "second"}
    assert found["first"]["state"] == "damaged" and name in found["first"]["error"]
    assert "\n" not in found["first"]["error"] and len(found["first"]["error"]) < 200
    assert found["second"]["state"] == "interrupted" and found["second"]["steps"] == {}


@pytest.mark.parametrize("name", ["state.json", "population/manifest.json", "ledger.jsonl"])
def test_a_device_in_a_files_place_is_not_read(folder: Path, name: str) -> None:
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to("/dev/zero")
    told = describe_run(folder)
    assert told["state"] == "damaged" and told["error"] == f"{name} cannot be read (is no regular file)"


def test_what_others_wrote_does_not_reach_the_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Control characters, and text that is no Unicode."""
    (folder / "state.json").write_text(json.dumps({"state": "failed", "error": "\x1b]0;x\x07\ud800 é"}))
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"method": "\x1b[2J"}))
    odd = folder.with_name(os.fsdecode(b"od\xffd\n"))
    folder.rename(odd)
    told = describe_run(odd)
    assert (told["id"], told["method"], told["error"]) == ("od?d?", "?[2J", "?]0;x?? é")
    assert cli.main(["runs", str(odd.parent)]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_a_line_that_is_being_written_does_not_count(folder: Path) -> None:
    with open(folder / "ledger.jsonl", "a") as file:
        file.write('{"run": "first", "mem')
    assert describe_run(folder)["total_steps"] == 42


def test_a_run_of_a_version_without_states_is_finished_if_it_is_complete(folder: Path) -> None:
    assert describe_run(folder)["state"] == "interrupted"
    (folder / "population" / "manifest.json").write_text(json.dumps({"members": [{}, {}, {}]}))
    (folder / "report").mkdir()
    (folder / "report" / "crossplay.json").write_text("{}")
    assert describe_run(folder)["state"] == "finished" and describe_run(folder)["member"] == 3


def test_a_damaged_state_does_not_stop_a_run(folder: Path) -> None:
    (folder / "state.json").write_text("{")
    state = RunState(folder)
    state.start(5)
    state.end("FINISHED")
    assert describe_run(folder)["state"] == "finished"


def test_where_there_are_no_locks_the_process_is_looked_for(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: Any) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(runs.fcntl, "flock", no_locks)
    RunState(folder).start(1)
    assert describe_run(folder)["state"] == "running"
    values = json.loads((folder / "state.json").read_text())
    (folder / "state.json").write_text(json.dumps({**values, "pid": 2**30}))
    assert describe_run(folder)["state"] == "interrupted"
    (folder / "state.json").write_text(json.dumps({**values, "pid": 2**30, "host": "another"}))
    assert describe_run(folder)["state"] == "running"


Run = Callable[..., tuple[int, str, str]]


def test_the_command(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ray", "mlflow", "torch"):
        monkeypatch.setitem(sys.modules, name, None)  # none of them is needed
    state = RunState(folder)
    state.start(1)
    state.end("FAILED", UserError("disk", "is full [bold]", "make room"))
    assert cli.main(["runs", str(folder.parent), "--json"]) == 0
    out, err = capsys.readouterr()
    (run,) = json.loads(out)["runs"]
    assert err == "" and (run["id"], run["state"], run["error"]) == (
        "first",
        "failed",
        "disk: is full [bold]; make room",
    )
    monkeypatch.chdir(folder.parent.parent)
    assert cli.main(["runs"]) == 0
    out, _ = capsys.readouterr()
    for cell in ("first", "failed", "2 of 3", "random 30", "SP 12", "is full [bold]"):
        assert cell in out
    assert cli.main(["runs", "nowhere"]) == 2
    assert capsys.readouterr().err.startswith("popgen: error: nowhere: is not a folder")
