"""A folder for the sockets of a local Ray, whose paths the system limits to 107 bytes."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from popgen.errors import UserError

LONGEST_SOCKET = 107
"""Bytes of the path of a Unix socket."""

SHORT_PLACES = ("/tmp", "/var/tmp", "/dev/shm")
_SOCKET = "session_2026-01-01_00-00-00_000000_4194304/sockets/plasma_store"
"""Below Ray's folder, with the longest process id."""


def default_folder() -> Path:
    """Where Ray keeps its session if nobody says otherwise."""
    return Path(os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir(), "ray")


def holds_sockets(folder: Path) -> bool:
    """Whether the sockets of a Ray in this folder have paths that the system takes."""
    return len(os.fsencode(folder / _SOCKET)) <= LONGEST_SOCKET


def check_ray_folder(places: Sequence[str] = SHORT_PLACES) -> None:
    """A local Ray will find a folder for its files, and for its sockets.

    Raises:
        UserError: it will not.
    """
    name = "RAY_TMPDIR" if os.environ.get("RAY_TMPDIR") else "TMPDIR"
    folder = default_folder()
    if not _is_writable(folder):
        raise UserError(name, f"cannot write to {folder.parent}", "give a folder that you can write to")
    if not holds_sockets(folder) and _short_place(places) is None:
        problem = f"{folder.parent} is too long for Ray's sockets, and there is no room in {' or '.join(places)}"
        raise UserError(name, problem, "give a shorter one")


def make_ray_folder(places: Sequence[str] = SHORT_PLACES) -> str | None:
    """A short path for Ray to its folder, where that one's is too long; None where it is not.

    The files stay where RAY_TMPDIR or TMPDIR wants them: the short path is a link, which goes with this process.
    """
    folder = default_folder()
    if holds_sockets(folder) or (place := _short_place(places)) is None:
        return None
    short = Path(tempfile.mkdtemp(prefix="pg-", dir=place))
    folder.mkdir(parents=True, exist_ok=True)
    (short / "ray").symlink_to(folder.absolute(), target_is_directory=True)
    atexit.register(shutil.rmtree, short, ignore_errors=True)
    return str(short / "ray")


def _short_place(places: Sequence[str]) -> str | None:
    writable = (place for place in places if os.access(place, os.W_OK | os.X_OK) and Path(place).is_dir())
    return next((place for place in writable if holds_sockets(Path(place, "pg-12345678", "ray"))), None)


def _is_writable(folder: Path) -> bool:
    """Whether the folder, or the one above it that is there, can be written to."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)
