"""The one way in which files are replaced: whatever interrupts it, the old contents are there or the new ones."""

from __future__ import annotations

import errno
import os
from pathlib import Path

_NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP)


def write_file(path: Path, data: bytes) -> None:
    """Write a file and wait until the disk has its contents; an interruption may leave a part of it."""
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, where its file system can."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:  # some network file systems sync files only
            raise
    finally:
        os.close(handle)


def replace_file(path: Path, data: bytes, temporary: Path | None = None) -> None:
    """Replace a file's contents at once and durably.

    Args:
        path: of the file, which need not exist.
        data: the new contents.
        temporary: where they are written first, in the same folder; NAME.writing by default.

    Raises:
        OSError: it cannot be written; the old contents are there.
    """
    temporary = temporary or path.with_name(f"{path.name}.writing")
    try:
        write_file(temporary, data)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def read_regular(path: Path) -> bytes:
    """Contents of a file; a device or a pipe in its place may have no end.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is no regular file", str(path))
    return path.read_bytes()
