"""A driver that Ray's library ended is made again; every other end is that of the command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from conftest import ROOT

PROGRAM = """
import os, select, sys, signal
from pathlib import Path
from popgen.runs.directory import RunState
from popgen.runs.supervisor import guarded
from popgen.errors import UserError

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
folder, retries, *ends = Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]
try:
    code = guarded(folder, retries)
except UserError as error:
    sys.exit(str(error))
if code is not None:
    print("code", code, flush=True)
    sys.exit(code)
tries = folder / "tries.txt"
with tries.open("a") as file:
    file.write(f"{os.getpid()} {os.getpgid(0)}\\n")
end = ends[len(tries.read_text().splitlines()) - 1]
state = RunState(folder)
if end != "before":
    state.start(1)
if end == "progress":
    with (folder / "ledger.jsonl").open("a") as file:
        file.write("entry\\n")
if end == "waits":
    try:
        print("waits", flush=True)
        while True:  # a signal that came just before pause() would wait there with it
            select.select([], [], [], 0.05)
    except KeyboardInterrupt:
        state.end("KILLED", KeyboardInterrupt())
        sys.exit(130)
if end == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
if end == "error":
    state.end("FAILED", ValueError("x"))
if end == "finished":
    state.end("FINISHED")
os._exit({"finished": 0, "refused": 2, "before": 1}.get(end, 1))
"""


GIVEN_UP = ["silent", "silent", "silent", "finished"]


def start(folder: Path, retries: int, *ends: str) -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-c", PROGRAM, str(folder), str(retries), *ends]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def outcome(folder: Path, retries: int, *ends: str) -> tuple[int, int, str]:
    """Exit code, tries, and what was said on stderr, for a driver that ends in these ways one after the other."""
    process = start(folder, retries, *ends)
    _, told = process.communicate(timeout=60)
    return process.returncode, len((folder / "tries.txt").read_text().splitlines()), told


@pytest.mark.parametrize(
    ("ends", "code", "tries"),
    [
        (["finished"], 0, 1),
        (["silent", "finished"], 0, 2),
        (["silent", "silent", "finished"], 0, 3),
        (GIVEN_UP, 1, 3),
        (["progress", "silent", "progress", "silent", "finished"], 0, 5),
        (["silent", "refused"], 2, 2),
        (["refused", "finished"], 2, 1),
        (["error", "finished"], 1, 1),  # a traceback: how it ended is written
        (["before", "finished"], 1, 1),  # it had not begun
        (["killed", "finished"], -signal.SIGKILL, 1),
    ],
)
def test_what_ends_a_driver_decides_whether_it_is_made_again(
    ends: list[str], code: int, tries: int, tmp_path: Path
) -> None:
    got, tried, told = outcome(tmp_path / "r", 2, *ends)
    assert (got, tried) == (code, tries), told
    lines = told.splitlines()
    if ends == GIVEN_UP:
        assert lines.pop().startswith("cluster: Ray ended the driver 3 times in a row without progress")
    assert lines == ["popgen: Ray ended the driver: r goes on from its last checkpoint"] * (tries - 1)


def test_an_interruption_reaches_the_driver_once_and_ends_both(tmp_path: Path) -> None:
    process = start(tmp_path / "r", 2, "waits", "finished")
    assert process.stdout is not None and process.stdout.readline() == "waits\n"
    process.send_signal(signal.SIGINT)
    out, told = process.communicate(timeout=60)
    assert (process.returncode, out, told) == (130, "code 130\n", "")
    assert json.loads((tmp_path / "r" / "state.json").read_text())["state"] == "interrupted"
    child, group = (tmp_path / "r" / "tries.txt").read_text().split()
    assert child == group != str(process.pid)  # so that a terminal's signal comes from us alone


def test_an_interruption_while_the_driver_is_made_is_not_lost(tmp_path: Path) -> None:
    """What Python runs after a fork swallows the exception of a signal that comes then."""
    early = "import os, signal; os.register_at_fork(after_in_parent=lambda: os.kill(os.getpid(), signal.SIGINT))\n"
    command = [sys.executable, "-c", early + PROGRAM, str(tmp_path / "r"), "2", "waits", "finished"]
    (tmp_path / "r").mkdir()
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert process.returncode in (130, -signal.SIGINT) and "ignored" not in process.stderr, process.stderr


def test_a_signal_that_nobody_handles_ends_both(tmp_path: Path) -> None:
    process = start(tmp_path / "r", 2, "waits", "finished")
    assert process.stdout is not None and process.stdout.readline() == "waits\n"
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGTERM


def test_the_driver_does_not_outlive_its_command(tmp_path: Path) -> None:
    process = start(tmp_path / "r", 2, "waits")
    assert process.stdout is not None and process.stdout.readline() == "waits\n"
    child = psutil.Process(int((tmp_path / "r" / "tries.txt").read_text().split()[0]))
    process.kill()
    process.wait()
    psutil.wait_procs([child], timeout=30)
    assert not child.is_running()


def test_a_command_stops_and_goes_on_with_its_driver(tmp_path: Path) -> None:
    process = start(tmp_path / "r", 2, "waits")
    assert process.stdout is not None and process.stdout.readline() == "waits\n"
    child = psutil.Process(int((tmp_path / "r" / "tries.txt").read_text().split()[0]))
    for number, stopped in ((signal.SIGTSTP, True), (signal.SIGCONT, False)):
        process.send_signal(number)
        deadline = time.monotonic() + 30
        while (child.status() == psutil.STATUS_STOPPED) is not stopped:
            assert time.monotonic() < deadline
            os.sched_yield()
    process.kill()
    process.communicate()


def test_the_command_line_is_guarded(tmp_path: Path) -> None:
    """Not in this process: `main` with arguments of its own never is."""
    setup = "import sys; from popgen.cli import main; from popgen.runs import supervisor; "
    code = setup + "supervisor.guarded = lambda *args: print(*args) or 7; main()"
    command = [sys.executable, "-c", code, "run", "scale=smoke", "run.root=runs", "run.id=r", "cluster.retries=3"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout == "runs/r 3\n", done.stderr
    assert not (ROOT / "runs" / "r").exists()
