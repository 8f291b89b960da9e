"""`popgen run` in a process of its own, which is made again when Ray's library has ended it.

Where the driver is talking to a raylet or a control store that dies, Ray's library ends the whole process: exit code 1,
no exception, no message. Nothing in that process can go on, but the run can, as it would if it were submitted again.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import FrameType

from popgen.errors import UserError
from popgen.runs.directory import read_state

FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP, signal.SIGCONT)
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
RAY_ENDED_US = 1
"""Exit code of a process that Ray's library ended; also that of a traceback, before which a run's state is written."""

LOOK = 0.1
"""Seconds between two looks at the child."""

_PARENT_DEATH = 1  # prctl's PR_SET_PDEATHSIG


def guarded(folder: Path, retries: int) -> int | None:
    """Go on in a child process, and in another one whenever Ray's library ended it.

    What ends the child otherwise ends this process alike: an exit code, or a signal. Signals to this process reach
    the child once, which is in a process group of its own, and the child does not outlive this process.

    Args:
        folder: the run's, which need not exist.
        retries: times in a row that the child may be ended without a new ledger entry in between.

    Returns:
        None in the child, which is to do the work, or where children cannot be bound to their parent (not Linux);
        in the parent the exit code, when the work is over.

    Raises:
        UserError: the child was ended too often.
    """
    if not sys.platform.startswith("linux"):
        return None
    spent, most = 0, -1
    while True:
        # A signal that comes while the child is made waits until it can be forwarded: what Python runs after a fork
        # swallows exceptions, KeyboardInterrupt too.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, FORWARDED)
        if (pid := _fork_child()) == 0:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            return None
        code, asked = _wait_for_child(pid, mask)
        if asked and code == RAY_ENDED_US:
            return 128 + asked  # whoever ends us may have ended Ray's processes too, and its library then the child
        if not _without_a_word(folder, pid, code):
            return _same_end(code)
        done = _file_size(folder / "ledger.jsonl")
        spent, most = 1 if done > most else spent + 1, max(most, done)
        if spent > retries:
            problem = f"Ray ended the driver {spent} times in a row without progress"
            raise UserError("cluster", problem, "see Ray's logs; the same run.id goes on from the last checkpoint")
        print(f"popgen: Ray ended the driver: {folder.name} goes on from its last checkpoint", file=sys.stderr)


def end_with_parent() -> None:
    """Have this process killed when the thread that made it ends (Linux)."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PARENT_DEATH, signal.SIGKILL)


def _fork_child() -> int:
    """The child's id in this process, 0 in the child."""
    sys.stdout.flush()
    sys.stderr.flush()
    parent = os.getpid()
    if (pid := os.fork()) != 0:
        return pid
    os.setpgid(0, 0)
    end_with_parent()
    if os.getppid() != parent:  # it was gone before we could say so
        os._exit(RAY_ENDED_US)
    return 0


def _wait_for_child(pid: int, mask: Iterable[int]) -> tuple[int, int]:
    """The child's exit code, or less the number of the signal that ended it; and the signal by which we were asked to
    end meanwhile, 0 without one. Signals are forwarded, from where `mask` blocks them no more."""
    asked = 0

    def forward(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if number in ENDING:
            asked = number
        with suppress(ProcessLookupError):
            os.kill(pid, number)
        if number == signal.SIGTSTP:
            os.kill(os.getpid(), signal.SIGSTOP)

    before = {number: signal.signal(number, forward) for number in FORWARDED}
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:  # not blocked in waitpid: a signal that comes just before it would wait there with us
        while not (ended := os.waitpid(pid, os.WNOHANG))[0]:
            time.sleep(LOOK)
        return os.waitstatus_to_exitcode(ended[1]), asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _without_a_word(folder: Path, pid: int, code: int) -> bool:
    """It was at the run, and ended by no signal and without writing how: nothing but Ray's library does that."""
    try:
        state = read_state(folder)
    except (OSError, ValueError, RecursionError):
        return False
    return code == RAY_ENDED_US and (state.get("state"), state.get("pid")) == ("running", pid)


def _same_end(code: int) -> int:
    """The exit code; of the signal that ended the child this process dies too."""
    if code < 0:
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    return code


def _file_size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
