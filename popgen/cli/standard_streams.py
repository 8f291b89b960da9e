"""Standard streams that decide over nothing: closed ones are like /dev/null, and progress that nobody reads is dropped.

Results are another matter: a disk that takes no more of stdout is an error, and a reader that went away is not.
"""

from __future__ import annotations

import errno
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

_KEPT: list[tuple[int, Path]] = []
"""The number under which the stderr of before is kept, and the file in its place, while `keep_native_lines` holds."""

_GONE = (errno.EPIPE, errno.EIO, errno.EBADF)
"""Nobody will ever read what is written there: a pipe without a reader, a terminal that was closed."""


class ProgressStream:
    """stderr whose text may be lost: an error of writing never reaches the work that reports its progress.

    Args:
        stream: what is written to; all else is asked of it too.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or drop the text."""
        try:
            return self._stream.write(text)
        except (OSError, ValueError) as error:  # the latter of a stream that was closed
            self._drop_text(error)
            return len(text)

    def flush(self) -> None:
        """Flush, or drop the text."""
        try:
            self._stream.flush()
        except (OSError, ValueError) as error:
            self._drop_text(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _drop_text(self, error: Exception) -> None:
        """What is left in the buffer goes to /dev/null, now or when the process ends, if nobody can ever read it."""
        if getattr(error, "errno", None) in _GONE:
            with suppress(OSError, ValueError):
                _point_to_null(self._stream.fileno())


def keep_native_lines(path: Path) -> None:
    """From here on, what libraries in other languages write to stderr goes to a file; what Python writes stays seen.

    Ray's C++ tells of processes that come and go, with addresses and stacks, which says nothing to a user. The way it
    was comes back where `mend_streams` ends.
    """
    if not _KEPT:
        kept = os.dup(2)
        _KEPT.append((kept, path))
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        sys.stderr.flush()
        os.dup2(file, 2)
        os.close(file)
        seen = open(kept, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False)  # noqa: SIM115
        sys.stderr = ProgressStream(seen)  # type: ignore[assignment]


def _return_stderr() -> None:
    if _KEPT:
        sys.stderr.flush()
        kept, path = _KEPT.pop()
        os.dup2(kept, 2)
        os.close(kept)
        with suppress(OSError):
            if not path.stat().st_size:
                path.unlink()


@contextmanager
def mend_streams() -> Iterator[None]:
    """Within it the three standard streams are there and open, and stderr is a `ProgressStream`."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        _open_if_closed(number)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", encoding="utf-8", closefd=False))  # noqa: SIM115
    before = sys.stderr
    sys.stderr = ProgressStream(before)  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stderr.flush()
        _return_stderr()
        sys.stderr = before
        try:
            sys.stdout.flush()
        except (OSError, ValueError):  # has been told, or has no reader
            drop_results()


def stdout_is_read() -> bool:
    """Whether stdout still has a reader; files and terminals have one."""
    try:
        number = sys.stdout.fileno()
        poll = select.poll()
        poll.register(number, select.POLLOUT)
        events = poll.poll(0)
    except (OSError, ValueError):
        return True
    return not any(found & (select.POLLERR | select.POLLHUP) for _, found in events)


def drop_results() -> None:
    """The reader of stdout went away: what it has not read goes to /dev/null."""
    with suppress(OSError, ValueError):
        _point_to_null(sys.stdout.fileno())


def _open_if_closed(number: int) -> None:
    """A standard stream that the caller closed is as /dev/null, and no file of ours gets its number."""
    try:
        os.fstat(number)
    except OSError:
        _point_to_null(number)


def _point_to_null(number: int) -> None:
    null = os.open(os.devnull, os.O_RDWR)
    if null != number:
        os.dup2(null, number)
        os.close(null)
