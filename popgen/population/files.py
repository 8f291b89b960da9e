"""Reading and writing an artefact's files: durable, atomic, and every trouble told in one line."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from popgen import durable_files
from popgen.errors import UserError
from popgen.jsonable import unique

TEMPORARY = ".writing-"
"""Prefix of files and folders that are not finished; readers never look at them."""

LARGEST = 2**31
"""Bytes of a file that is read: members are megabytes, and a file is held in memory to check its sum."""

_PICKLES = (b"PK", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")  # torch.save's archive, and bare pickles

R = TypeVar("R", bound=BaseModel)

_TROUBLE = {
    errno.ENOSPC: ("the disk is full", "free some space and run again; what was written before is intact"),
    errno.EDQUOT: ("the disk quota is used up", "free some space and run again; what was written before is intact"),
    errno.EACCES: ("permission denied", "choose a folder you can write to"),
    errno.EPERM: ("permission denied", "choose a folder you can write to"),
    errno.EROFS: ("the file system is read-only", "choose a folder you can write to"),
    errno.ENOTDIR: ("a part of the path is a file", "choose another folder"),
    errno.EEXIST: ("exists already and is not a folder", "choose another folder"),
}


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Turn an OSError while writing under `path` into a UserError of one line."""
    try:
        yield
    except OSError as error:
        problem, fix = _TROUBLE.get(error.errno or 0, (error.strerror or str(error), "check the folder"))
        raise UserError(str(path), f"cannot be written, {problem}", fix) from error


def digest(data: bytes) -> str:
    """sha256 as hexadecimal text."""
    return hashlib.sha256(data).hexdigest()


def to_json(record: BaseModel) -> bytes:
    """Indented JSON of a record; raises ValueError for a number that is not finite."""
    text = json.dumps(record.model_dump(mode="json"), indent=2, allow_nan=False, ensure_ascii=False)
    return (text + "\n").encode()


def replace_file(path: Path, data: bytes) -> None:
    """Write a file so that readers see the old or the new content, never a part."""
    durable_files.replace_file(path, data, path.with_name(f"{TEMPORARY}{path.name}"))


def publish_folder(final: Path, contents: Mapping[str, bytes]) -> None:
    """Write a folder of files under a temporary name, then give it its own; raises OSError if that is taken."""
    temporary = Path(tempfile.mkdtemp(prefix=f"{TEMPORARY}{final.name}-", dir=final.parent))
    try:
        temporary.chmod(0o777 & ~_umask())
        for name, data in contents.items():
            durable_files.write_file(temporary / name, data)
        durable_files.name_folder(temporary, final)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current


def remove_unfinished(folder: Path) -> None:
    """Delete what an interrupted writer left behind under temporary names."""
    for path in folder.glob(f"{TEMPORARY}*"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def read_bytes(path: Path) -> bytes:
    """Content of a regular file; UserError if it is missing, too large or cannot be read."""
    fix = "restore the population from a good copy"
    try:
        if path.exists() and not path.is_file():
            raise UserError(str(path), "is not a regular file", fix)
        if path.exists() and path.stat().st_size > LARGEST:
            raise UserError(str(path), f"is larger than {LARGEST / 2**30:g} GiB", fix)
        return path.read_bytes()
    except FileNotFoundError:
        raise UserError(str(path), "is missing", fix) from None
    except OSError as error:
        raise UserError(str(path), f"cannot be read: {error.strerror}", "check the path and its permissions") from error


def parse_json(path: Path, data: bytes) -> Any:
    """The JSON value in `data`, read from `path`; UserError if it is not JSON."""
    try:
        return json.loads(data.decode(), object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        raise UserError(str(path), f"is not valid JSON: {error}", "restore the population from a good copy") from None


def as_record(path: Path, value: Any, schema: type[R]) -> R:
    """Check a JSON value against a schema; UserError naming the file and the first bad field."""
    try:
        return schema.model_validate(value)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "content"
        problem = first["msg"].removeprefix("Value error, ")
        fix = "restore the population from a good copy"
        raise UserError(str(path), f"{where}: {problem}", fix) from None


def read_tensors(path: Path, sha256: str) -> dict[str, np.ndarray]:
    """Named arrays of a safetensors file, after checking its sum, its format and that all numbers are finite.

    Nothing is ever unpickled.

    Raises:
        UserError: missing, not safetensors, damaged, or not finite.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    data, fix = read_bytes(path), "restore the population from a good copy"
    # Byte 8 opens the JSON header of every safetensors file; the 8 before it are its length and can be anything.
    if data[8:9] != b"{" and data[:2] in _PICKLES:
        raise UserError(str(path), "is a pickle, which could run code, and will not be loaded", fix)
    if digest(data) != sha256:
        raise UserError(str(path), "is truncated or damaged: its sha256 differs from the one on record", fix)
    try:
        tensors = load(data)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise UserError(str(path), f"is not a safetensors file: {error}", fix) from None
    _check_finite(path, tensors, "train the member again")
    return tensors


def to_tensors(path: Path, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Safetensors bytes of named arrays; UserError if a number is not finite (`path` is where they will go)."""
    from safetensors.numpy import save

    kept = {name: np.array(array, order="C") for name, array in arrays.items()}
    _check_finite(path, kept, "lower the learning rate; the member was not saved")
    return save(kept)


def _check_finite(path: Path, tensors: Mapping[str, np.ndarray], fix: str) -> None:
    for name, array in tensors.items():
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise UserError(str(path), f"tensor {name!r} holds numbers that are not finite", fix)
