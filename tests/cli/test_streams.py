"""Streams that are closed, full or not read decide over nothing."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

from popgen.cli.standard_streams import ProgressStream, mend_streams
from popgen.progress import make_reporter

REPORTING = """
import sys
from popgen import cli
from popgen.cli import population_commands
from popgen.progress import make_reporter

def work(args):
    reporter = make_reporter()
    reporter.phase("work", 100)
    for done in range(100):
        reporter.update(done)
        reporter.note("x" * 4096)  # more than a pipe takes without a reader
    reporter.close()
    open("finished", "w").close()
    print("result")
    return 0

population_commands.show = work
sys.argv = ["popgen", "show", "."]
sys.exit(cli.main())
"""


def in_shell(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHON": sys.executable, "PROGRAM": REPORTING}
    return subprocess.run(
        ["bash", "-c", command], cwd=cwd, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("streams", "ends"),
    [
        ("2>&1 | head -n 1", 0),  # neither progress nor results are read
        ("2> >(head -n 1 >&2)", 0),  # progress is not
        ("2>&-", 0),
        (">&- 2>&- <&-", 0),
        ("2>/dev/full", 0),
        ("2>/dev/null >/dev/full", 2),  # results cannot be written
    ],
)
def test_work_goes_on_without_its_progress(streams: str, ends: int, tmp_path: Path) -> None:
    done = in_shell(f'"$PYTHON" -c "$PROGRAM" {streams}; exit ${{PIPESTATUS[0]}}', tmp_path)
    assert (done.returncode, (tmp_path / "finished").exists()) == (ends, True), done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


@pytest.mark.end_to_end
@pytest.mark.parametrize("streams", [">&-", "2>&-", "<&-", "<&- >&- 2>&-", "| head -n 0"])
def test_results_without_a_reader_are_no_error(streams: str, tmp_path: Path, random_population: Path) -> None:
    done = in_shell(f'"$PYTHON" -m popgen show {random_population} {streams}; exit ${{PIPESTATUS[0]}}', tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


class Broken(io.StringIO):
    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def write(self, text: str) -> int:
        raise OSError(self.number, os.strerror(self.number))


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EIO, errno.ENOSPC, errno.EAGAIN])
def test_no_error_of_stderr_reaches_the_work(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Broken(number))
    with mend_streams():
        reporter = make_reporter()
        reporter.phase("work", 2)
        reporter.update(1.0, dishes=3)
        reporter.note("half")
        reporter.close()
        print("told", file=sys.stderr)


def test_a_stream_of_progress_is_asked_for_all_else() -> None:
    stream: Any = ProgressStream(io.StringIO())
    assert stream.write("text") == 4 and stream.getvalue() == "text" and not stream.isatty()


@pytest.mark.usefixtures("new_parser")
def test_another_broken_pipe_is_no_success(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from popgen.cli import population_commands

    def lose_server(_: Any) -> int:
        raise BrokenPipeError(errno.EPIPE, "a server went away")

    monkeypatch.setattr(population_commands, "show", lose_server)
    with pytest.raises(BrokenPipeError):
        run("show", ".")


NATIVE = """
import os, sys
from pathlib import Path
from popgen import cli
from popgen.cli import population_commands
from popgen.cli.standard_streams import keep_native_lines

def work(args):
    keep_native_lines(Path("kept", "native.log"))
    os.write(2, b"*** C++ stack ***\\\\n" * int(sys.argv[2]))
    print("progress", file=sys.stderr)
    raise {"error": ValueError("ours"), "told": cli.UserError("a", "b")}[sys.argv[3]]

population_commands.show = work
sys.argv[1:1] = ["show"]
args = sys.argv
cli.parse = lambda argv: __import__("argparse").Namespace(command=work)
sys.exit(cli.main())
"""


@pytest.mark.parametrize("lines", [0, 3])
@pytest.mark.parametrize("end", ["error", "told"])
def test_lines_of_other_languages_are_kept_apart(lines: int, end: str, tmp_path: Path) -> None:
    program = NATIVE.replace("\\\\n", "\\n")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program, str(lines), end],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert "C++" not in done.stderr and done.stderr.startswith("progress\n")
    kept = tmp_path / "kept" / "native.log"
    assert kept.exists() == bool(lines) and (not lines or kept.read_text().count("C++") == lines)
    if end == "told":
        assert (done.returncode, done.stderr) == (2, "progress\npopgen: error: a: b\n")
    else:
        assert done.returncode == 1 and "ValueError: ours" in done.stderr  # a traceback of ours is seen
