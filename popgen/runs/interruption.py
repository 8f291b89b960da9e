"""The end by SIGTERM, as batch systems and containers ask for it: the run writes its books, then exit code 15."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType

_received = threading.Event()


def end_on_sigterm() -> None:
    """SIGTERM raises SystemExit(15) in the main thread, once; a second one does not disturb what is being written.

    To be called again after `ray.init`, whose library takes the signal for a crash: it prints its C++ stack and aborts
    the process three seconds later, however far the books are.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _raise_exit)


def _raise_exit(number: int, frame: FrameType | None) -> None:
    _received.set()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(number)


def follows_sigterm(error: BaseException) -> bool:
    """Whether SIGTERM asked for this exit: Ray gives back one that is raised while it waits as SystemExit(1)."""
    return isinstance(error, SystemExit) and (error.code == signal.SIGTERM or _received.is_set())


def describe_interruption(error: BaseException) -> str | None:
    """What happened, in words; None for an error."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted by Ctrl-C"
    if follows_sigterm(error):
        return "interrupted by SIGTERM"
    return None
