"""The one way in which files and folders are replaced: whatever interrupts it, the old contents are there or the new.

A nested state (dictionaries of arrays and plain values) is a folder of a safetensors and a JSON file; never pickled.
The JSON holds the digests of both parts, so that a damaged bit is noticed and not trained on.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from popgen.errors import UserError

ARRAYS, VALUES = "arrays.safetensors", "values.json"
FORMAT = 2
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


def name_folder(written: Path, final: Path) -> None:
    """Give a folder that was written under another name, in the same place, its own: at once and durably.

    Raises:
        OSError: the name is taken, or cannot be given.
    """
    sync_folder(written)
    os.rename(written, final)
    sync_folder(final.parent)


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


def save_state(folder: str | Path, state: dict[str, Any]) -> None:
    """Write `state` so that `load_state` finds either the old contents or the new, whatever interrupts it.

    Raises:
        OSError: it cannot be written, the disk being full for one; the old contents are there.
    """
    folder = Path(folder)
    fresh = folder.with_name(folder.name + ".writing")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    arrays: dict[str, np.ndarray] = {}
    values = _split_state(state, "", arrays)
    try:
        # Not safetensors' own writer, whose errors tell nothing of the disk.
        data = save(arrays)
        digests = {"arrays": _sha256(data), "values": _sha256(_encode_values(values))}
        document = {"format": FORMAT, "sha256": digests, "values": values}
        for name, content in ((ARRAYS, data), (VALUES, _encode_values(document))):
            write_file(fresh / name, content)
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    old = _old_folder(folder)
    if folder.exists():
        shutil.rmtree(old, ignore_errors=True)
        os.rename(folder, old)
    name_folder(fresh, folder)
    shutil.rmtree(old, ignore_errors=True)


def load_state(folder: str | Path) -> dict[str, Any]:
    """Read what `save_state` wrote.

    Raises:
        UserError: missing or damaged files, or those of another version.
    """
    folder = Path(folder)
    whole = folder if folder.exists() else _old_folder(folder)
    try:
        data = read_regular(whole / ARRAYS)
        state = _merge_state(_check_digests(json.loads(read_regular(whole / VALUES)), data), load(data))
        if not isinstance(state, dict):
            raise ValueError(f"{VALUES} holds no dictionary")
        return state
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SafetensorError) as error:
        raise UserError(str(folder), f"unreadable checkpoint ({error})", "remove it or start a new run") from None


def _check_digests(document: Any, data: bytes) -> Any:
    """The values of a document whose digests are right."""
    known = document.get("format") if isinstance(document, dict) else None
    if known != FORMAT:
        raise ValueError(f"of format {known!r}, this version reads {FORMAT}")
    values = document["values"]
    for name, content in (("arrays", data), ("values", _encode_values(values))):
        if document["sha256"][name] != _sha256(content):
            raise ValueError(f"its {name} are not what was written")
    return values


def _encode_values(values: Any) -> bytes:
    return json.dumps(values).encode()


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _old_folder(folder: Path) -> Path:
    """Where the old contents are for the moment between the two renames of `save_state`."""
    return folder.with_name(folder.name + ".old")


def _split_state(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        arrays[path] = np.asarray(value, order="C")
        return {"__array__": path}
    if isinstance(value, dict):
        return {str(key): _split_state(item, f"{path}/{key}", arrays) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_split_state(item, f"{path}/{index}", arrays) for index, item in enumerate(value)]
    return value


def _merge_state(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"__array__"}:
            return arrays[value["__array__"]]
        return {key: _merge_state(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_merge_state(item, arrays) for item in value]
    return value
