"""A second place for a run's folder, so that a lost machine does not lose the run.

    URI/RUN_ID/
      objects/SHA256     contents of files, each once; never changed
      latest.json        which file of the run has which contents; replaced at once, when all that it names is there

Any URI that pyarrow (file, s3, gs, hdfs) or an installed fsspec package knows. Whatever interrupts a copy,
`latest.json` names a whole one. The folder's own `storage.json` tells whether it wrote the last copy itself, or another
machine did.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import uuid
from contextlib import closing
from pathlib import Path, PurePosixPath
from typing import Any

from popgen.durable_files import name_folder, read_regular, replace_file, write_file
from popgen.errors import UserError

LATEST, OBJECTS, MARK = "latest.json", "objects", "storage.json"
FORMAT = 1
_LEFT_OUT = (MARK, "run.lock")
_PASSING = (".writing", ".old", "-journal", "-wal", "-shm", ".restoring")


def open_storage(uri: str) -> tuple[Any, str]:
    """A pyarrow file system and the path in it.

    Raises:
        UserError: no file system for this URI, or it cannot be reached.
    """
    from pyarrow import ArrowException
    from pyarrow.fs import FileSystem, FSSpecHandler, PyFileSystem

    try:
        return FileSystem.from_uri(uri)
    except (ArrowException, ValueError, OSError) as first:
        try:
            from fsspec.core import url_to_fs

            system, path = url_to_fs(uri)
            return PyFileSystem(FSSpecHandler(system)), path
        except (ImportError, ValueError, OSError) as second:
            problem = f"cannot open {uri} ({first}; {second})"
            raise UserError("run.storage", problem, "give a URI such as s3://bucket/path or file:///path") from None


def local_folder(system: Any, path: str) -> Path | None:
    """The folder of this machine that `open_storage` gave, None if it is elsewhere."""
    handler = getattr(system, "handler", None)
    protocol = getattr(getattr(handler, "fs", None), "protocol", ())
    return Path(path) if system.type_name == "local" or "file" in protocol else None


class Mirror:
    """One run's folder and its copy.

    Args:
        folder: of the run; need not exist.
        uri: below which the copy is, in a folder of the run's name.

    Raises:
        UserError: see `open_storage`.
    """

    def __init__(self, folder: Path, uri: str) -> None:
        self.folder, self.uri = folder, f"{uri.rstrip('/')}/{folder.name}"
        self.system, self.path = open_storage(self.uri)
        self.writer = uuid.uuid4().hex
        self._known: dict[str, tuple[int, int, str]] = {}
        self._held: set[str] | None = None
        self._before: set[str] = set()

    # ---- to the storage --------------------------------------------------------------------------------------------

    def push(self) -> None:
        """Copy what has changed since the last time.

        Raises:
            OSError: the storage does not take it; the last copy is whole.
        """
        if self._held is None:
            self._list_objects()
        files: dict[str, list[Any]] = {}
        for path in sorted(self.folder.rglob("*")):
            name = path.relative_to(self.folder).as_posix()
            passing = any(part.endswith(_PASSING) for part in PurePosixPath(name).parts)
            if path.is_file() and not passing and name not in _LEFT_OUT:
                files[name] = self._upload_file(path, name)
        document = {"format": FORMAT, "writer": self.writer, "files": files}
        self._replace_object(LATEST, json.dumps(document).encode())
        self._remove_unneeded({digest for digest, _ in files.values()})

    def _list_objects(self) -> None:
        """Which objects are there, and which of them the present copy needs."""
        from pyarrow.fs import FileSelector

        self.system.create_dir(f"{self.path}/{OBJECTS}", recursive=True)
        found = self.system.get_file_info(FileSelector(f"{self.path}/{OBJECTS}", allow_not_found=True))
        self._held = {PurePosixPath(info.path).name for info in found}
        document = self._read_latest()
        self._before = {digest for digest, _ in document["files"].values()} if document else set()
        self._write_mark(self.folder, self.writer)

    def _write_mark(self, folder: Path, writer: str) -> None:
        """Note in the folder whose copy it is up to."""
        replace_file(folder / MARK, json.dumps({"writer": writer}).encode())

    def _upload_file(self, path: Path, name: str) -> list[Any]:
        """Upload a file if its contents are not there yet; its digest and size."""
        stat = path.stat()
        known = self._known.get(name)
        if known and known[:2] == (stat.st_size, stat.st_mtime_ns):
            return [known[2], stat.st_size]
        data = _snapshot_database(path) if path.suffix == ".db" else path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        assert self._held is not None
        if digest not in self._held:
            self._replace_object(f"{OBJECTS}/{digest}", data)
            self._held.add(digest)
        self._known[name] = (stat.st_size, stat.st_mtime_ns, digest)
        return [digest, len(data)]

    def _replace_object(self, name: str, data: bytes) -> None:
        """The old contents or the new: object stores replace at once, files are renamed."""
        target = f"{self.path}/{name}"
        local = self.system.type_name == "local"
        with self.system.open_output_stream(f"{target}.writing" if local else target) as stream:
            stream.write(data)
        if local:
            self.system.move(f"{target}.writing", target)

    def _remove_unneeded(self, needed: set[str]) -> None:
        """Remove what neither this copy nor the one before needs: somebody may be reading that."""
        assert self._held is not None
        for digest in self._held - needed - self._before:
            self.system.delete_file(f"{self.path}/{OBJECTS}/{digest}")
        self._held &= needed | self._before
        self._before = needed

    # ---- from the storage ------------------------------------------------------------------------------------------

    def pull(self) -> str | None:
        """Bring the folder to the state of the copy, where that is another machine's or the folder is gone.

        Returns:
            What was done, in words; None if nothing.

        Raises:
            UserError: the copy is damaged or of another version, or the storage cannot be read.
        """
        document = self._read_latest()
        if document is None or document["writer"] == self._read_mark():
            return None
        fresh = self.folder.with_name(self.folder.name + ".restoring")
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        for name, (digest, _) in document["files"].items():
            self._fetch_object(fresh, name, digest)
        self._write_mark(fresh, document["writer"])
        told = f"restored from {self.uri}"
        if self.folder.exists():
            aside = next(
                p for n in range(10**6) if not (p := self.folder.with_name(f"{self.folder.name}.stale{n}")).exists()
            )
            self.folder.rename(aside)
            told += f", which is newer; the folder as it was is {aside}"
        name_folder(fresh, self.folder)
        return told

    def _read_mark(self) -> str | None:
        try:
            return str(json.loads(read_regular(self.folder / MARK))["writer"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def _read_latest(self) -> dict[str, Any] | None:
        from pyarrow.fs import FileType

        target = f"{self.path}/{LATEST}"
        try:
            if self.system.get_file_info(target).type == FileType.NotFound:
                return None
            with self.system.open_input_stream(target) as stream:
                document = json.loads(stream.read())
            if document["format"] != FORMAT:
                raise ValueError(f"of format {document['format']!r}, this version reads {FORMAT}")
            for name, (digest, _) in document["files"].items():
                _check_names(name, digest)
            return {"writer": str(document["writer"]), "files": document["files"]}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(
                "run.storage", f"{self.uri}/{LATEST} is unreadable ({error})", "choose another id"
            ) from None

    def _fetch_object(self, root: Path, name: str, digest: str) -> None:
        try:
            with self.system.open_input_stream(f"{self.path}/{OBJECTS}/{digest}") as stream:
                data = stream.read()
        except OSError as error:
            raise UserError("run.storage", f"cannot read {name} in {self.uri} ({error})", "choose another id") from None
        if hashlib.sha256(data).hexdigest() != digest:
            raise UserError("run.storage", f"{name} in {self.uri} is damaged", "choose another id")
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, data)


def _check_names(name: str, digest: str) -> None:
    """Nothing outside the folder is written, whatever `latest.json` says."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or "\0" in name:
        raise ValueError(f"{name!r} is no name of a run's file")
    if len(digest) != 64 or not set(digest) <= set("0123456789abcdef"):
        raise ValueError(f"{digest!r} is no sha256")


def _snapshot_database(path: Path) -> bytes:
    """A consistent copy of a sqlite file that another process may be writing to."""
    copy = path.with_name(path.name + ".writing")
    copy.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
        return copy.read_bytes()
    except sqlite3.Error as error:
        raise OSError(f"{path}: {error}") from None
    finally:
        copy.unlink(missing_ok=True)
