"""Where MLflow keeps its records: addresses as its client reads them, looked at before anything starts, without MLflow.

Only an address that somebody gave is looked at; the store of a run's own folder is made when the run begins.
"""

from __future__ import annotations

import importlib
import os
import re
import socket
import sqlite3
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import quote

from popgen.errors import MASK, UserError, mask_credentials

_DATABASES = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}
"""Kinds of servers and the ports that they have where none is given."""

_SCHEMES = ("sqlite", "http", "https", *_DATABASES)
_OFF = "or use tracking=off"


def sqlite_uri(path: Path) -> str:
    """The address of a sqlite file whose path may hold any character: `?`, `#` and `%` mean something in addresses."""
    from sqlalchemy.engine import URL, make_url

    forms = (f"sqlite:///{path}", URL.create("sqlite", database=str(path)).render_as_string(hide_password=False))
    as_it_is = next((form for form in forms if make_url(form).database == str(path)), None)
    return as_it_is or f"sqlite:///file:{quote(str(path))}?uri=true"  # SQLAlchemy 2.0 does not quote


def check_uri(uri: str | None, timeout: float = 5.0) -> None:
    """Try a tracking URI as MLflow's client would.

    Raises:
        UserError: a scheme that MLflow has no database or server for, a file that is no sqlite store or cannot be
            written to, a database without its driver, or a server that does not answer in `timeout` s.
    """
    if uri is None:
        return
    scheme, _, place = uri.partition("://")
    scheme = scheme.partition("+")[0].lower()
    if scheme not in _SCHEMES or not place.strip("/"):
        raise UserError("tracking.uri", f"cannot track to {uri!r}", f"use null or one of {'://, '.join(_SCHEMES)}://")
    if f"{MASK}@" in place:
        raise UserError("tracking.uri", "holds no password, which records of runs leave out", "give it again")
    if scheme == "sqlite":
        _check_file(uri)
    elif scheme in _DATABASES:
        _check_database(uri, _DATABASES[scheme], timeout)
    else:
        _check_server(uri, timeout)


def _check_server(uri: str, timeout: float) -> None:
    """By `requests`, which MLflow uses: it takes credentials, proxies and certificates from the same places."""
    import requests

    user, password = (os.environ.get(f"MLFLOW_TRACKING_{name}") for name in ("USERNAME", "PASSWORD"))
    trusted = os.environ.get("MLFLOW_TRACKING_SERVER_CERT_PATH") or (
        os.environ.get("MLFLOW_TRACKING_INSECURE_TLS", "false").lower() not in ("true", "1")
    )
    try:
        # Whatever it answers: /health may be closed by a proxy.
        requests.get(
            f"{uri.rstrip('/')}/health",
            timeout=timeout,
            verify=trusted,
            auth=(user, password) if user and password else None,
            stream=True,
        ).close()
    except (OSError, ValueError) as error:  # requests' own errors are of the first kind, bad addresses of the second
        raise UserError(
            "tracking.uri", f"no server answers at {uri} ({_last_reason(error)})", "start it or use tracking=mlflow"
        ) from None


def _check_file(uri: str) -> None:
    """A sqlite file that is one and can be written to, or a folder to make it in."""
    path = _database_path(uri)
    if path is None:
        raise UserError("tracking.uri", f"{uri} is in memory, and lost with its process", "give a file")
    folder = path.parent
    try:
        if not folder.is_dir():
            raise NotADirectoryError(2, f"there is no folder {folder}")
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".popgen-"):
            pass  # sqlite keeps its journal beside the file
        if path.exists():
            if not os.access(path, os.R_OK | os.W_OK):
                raise PermissionError(13, "permission denied")
            with sqlite3.connect(f"file:{quote(str(path))}?mode=rw", uri=True, timeout=1.0) as connection:
                connection.execute("PRAGMA schema_version").fetchone()
            connection.close()
    except sqlite3.OperationalError as error:
        if "locked" not in str(error):  # another run is writing
            raise UserError("tracking.uri", f"cannot open {uri} ({error})", _OFF) from None
    except (OSError, ValueError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UserError("tracking.uri", f"cannot open {uri} ({reason})", _OFF) from None


def _database_path(uri: str) -> Path | None:
    """The file of a sqlite address, None for one in memory.

    Raises:
        UserError: the address cannot be read.
    """
    url = _read_address(uri)
    name = url.database or ""
    if not name or ":memory:" in name or url.query.get("mode") == "memory":
        return None
    return Path(name.removeprefix("file:")) if name.startswith("file:") else Path(name)


def _check_database(uri: str, port: int, timeout: float) -> None:
    """The driver is installed, and something listens at the address; the rest is MLflow's to try."""
    url = _read_address(uri)
    try:
        importlib.import_module(url.get_dialect().import_dbapi().__name__)
    except ImportError as error:
        raise UserError("tracking.uri", f"{uri} needs a driver ({error})", f"pip install it, {_OFF}") from None
    except Exception as error:  # of an unknown dialect, by SQLAlchemy's own class
        raise UserError("tracking.uri", f"cannot track to {uri} ({error})", _OFF) from None
    if url.host is None:
        return
    try:
        socket.create_connection((url.host, url.port or port), timeout).close()
    except OSError as error:
        raise UserError("tracking.uri", f"no server answers at {uri} ({error})", f"start it, {_OFF}") from None


def _read_address(uri: str) -> Any:
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import ArgumentError

    try:
        return make_url(uri)
    except (ArgumentError, ValueError) as error:
        raise UserError("tracking.uri", f"cannot read {uri!r} ({error})", _OFF) from None


def _last_reason(error: Exception) -> str:
    """What a chain of requests' errors says at its end."""
    found = re.search(r"\[Errno -?\d+\] [^'\")]+", str(error))
    return found[0] if found else mask_credentials(str(error))[:200]
