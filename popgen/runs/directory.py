"""The state of a run as its folder tells it: who is at it, how far it is, and how it ended.

    runs/RUN_ID/
      run.lock      locked by the driver as long as it lives; the system unlocks it, however the driver ends
      state.json    of the last attempt: its outcome, when it began, seconds of all attempts, what went wrong

A driver that was killed leaves the state "running" behind, and nobody holds the lock: the run was interrupted.
"""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import re
import secrets
import socket
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, Timeout

from popgen.config.run_config import RunConfig
from popgen.durable_files import read_regular, replace_file
from popgen.errors import UserError, mask_credentials
from popgen.runs.interruption import describe_interruption
from popgen.types import TRAINING_KINDS

LOCK, STATE = "run.lock", "state.json"
STATES = ("running", "finished", "failed", "interrupted", "damaged")
OUTCOMES = {"FINISHED": "finished", "FAILED": "failed", "KILLED": "interrupted"}
"""MLflow's status of a run -> ours."""

_STATE_TYPES: dict[str, Any] = {
    **{"state": str, "attempt": int, "pid": int, "host": str},
    **{"began": int | float, "seconds": int | float, "error": str},
}
_COLOURS = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
_TAKEN = (errno.EAGAIN, errno.EACCES)
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP)
_WAIT, _PAUSE = 2.0, 0.05  # a look at the lock holds it for a moment, and a killed process until it is gone
_ACTIVE = ("metrics.jsonl", "ledger.jsonl", STATE)
"""Files that a living driver writes to: the last of these times is when an attempt was last heard of."""


def named(config: RunConfig) -> RunConfig:
    """The config with an id for its run, if it has none: method, environment, seed, time, and letters of its own,
    because many runs can start in a second."""
    if config.run.id:
        return config
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    name = f"{describe_settings(config)}-{stamp}-{secrets.token_hex(3)}"
    return config.model_copy(update={"run": config.run.model_copy(update={"id": name})})


def describe_settings(config: RunConfig) -> str:
    """Method, environment and seed as part of a folder's name; a layout's file may be called anything."""
    layout = re.sub(r"[^A-Za-z0-9._-]+", "-", Path(config.env.name).stem)[:40]
    return f"{config.method}-{layout}-s{config.run.seed}"


def run_folder(config: RunConfig) -> Path:
    """Where a `named` run keeps everything."""
    return Path(config.run.root) / str(config.run.id)


class RunState:
    """The driver's hold on its run's folder: one driver at a time.

    Args:
        folder: the run's, which exists.

    Raises:
        UserError: another driver is at work on it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.began, self._past, self._attempt = folder, time.time(), 0.0, 0
        self._lock = FileLock(folder / LOCK, timeout=_WAIT, thread_local=False)
        _take_lock(self._lock, folder)
        (folder / LOCK).write_text(f"process {os.getpid()} on {socket.gethostname()}\n")

    @staticmethod
    def check_free(folder: Path) -> None:
        """Nobody is at work on this run, whose folder need not be there yet.

        Raises:
            UserError: another driver is.
        """
        if (folder / LOCK).exists():
            RunState(folder).release()

    def start(self, attempt: int) -> None:
        """The attempt begins."""
        try:
            self._past = _sum_seconds(self.folder, read_state(self.folder))
        except (OSError, ValueError, OverflowError, RecursionError):
            self._past = 0.0  # a damaged file costs the time of earlier attempts, and nothing else
        self.began, self._attempt = time.time(), attempt
        self._write_state("running")

    def end(self, status: str, error: BaseException | None = None) -> None:
        """It ended with an MLflow status; the lock is given up."""
        self._write_state(OUTCOMES[status], None if error is None else describe_end(error))
        self.release()

    def release(self) -> None:
        """Give up the lock, for the next attempt of this process: the state stays what it is."""
        self._lock.release()

    def _write_state(self, state: str, error: str | None = None) -> None:
        now = time.time()
        values = {
            "state": state,
            "attempt": self._attempt,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "began": round(self.began, 3),
            "seconds": round(self._past + (0.0 if state == "running" else now - self.began), 1),
            "error": error,
        }
        replace_file(self.folder / STATE, json.dumps(values).encode())


def _take_lock(lock: BaseFileLock, folder: Path) -> None:
    """Hold it until it is released or the process has ended; no child inherits it.

    Where the file system has no locks, nobody is kept out.

    Raises:
        UserError: another driver holds it.
    """
    try:
        lock.acquire(poll_interval=_PAUSE)
    except Timeout:
        holder = (folder / LOCK).read_text(errors="replace")[:200].strip() or "another process"
        problem = f"{folder.name} is being run by {holder}"
        raise UserError("run.id", problem, "wait for it, stop it, or choose another id") from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def list_runs(root: Path) -> list[dict[str, Any]]:
    """All runs below `root`, the oldest first; see `describe_run`.

    Raises:
        UserError: no such folder.
    """
    if not root.is_dir():
        raise UserError(str(root), "is not a folder", "give the one that holds the runs (run.root)")
    folders = [path for path in root.iterdir() if (path / "config.json").is_file()]
    return sorted((describe_run(path) for path in folders), key=lambda run: (run["began"] or 0.0, run["id"]))


def describe_run(folder: Path) -> dict[str, Any]:
    """What a run's folder tells of it; nothing in it is changed.

    Keys: id; state (running, finished, failed, interrupted, damaged); method, scale, environment; member (the one
    that is trained, or the last one) of size; steps (environment steps by ledger kind) and total_steps (of training);
    seconds of all attempts; attempt; began (of the last attempt, seconds since 1970); error (of the last attempt, None
    without one).
    A folder with a file that cannot be read is "damaged", and `error` names it.
    """
    known: dict[str, Any] = {"id": _strip_controls(folder.name), "state": "damaged", "method": None, "scale": None}
    known |= {"environment": None, "member": None, "size": None, "steps": {}, "total_steps": 0}
    known |= {"seconds": 0.0, "attempt": None, "began": None, "error": None}
    path = folder / "config.json"
    try:
        config = json.loads(read_regular(path))
        named = {"method": config["method"], "scale": config["scale"], "environment": config["env"]["name"]}
        known |= {key: _strip_controls(value) for key, value in named.items()} | {
            "size": int(config["population"]["size"])
        }
        path = folder / STATE
        state = read_state(folder)
        known |= {"seconds": _sum_seconds(folder, state), "attempt": state.get("attempt"), "began": state.get("began")}
        path = folder / "population" / "manifest.json"
        members = len(json.loads(read_regular(path))["members"]) if path.exists() else 0
        known["member"] = min(members + 1, known["size"])
        path = folder / "ledger.jsonl"
        known["steps"] = _count_steps(path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        return known | {"error": f"{path.relative_to(folder)} cannot be read ({_describe_reason(error)})"}
    done = members >= known["size"] and (folder / "report" / "crossplay.json").exists()
    told = state.get("error")
    known |= {"state": _present_state(folder, state, done), "error": None if told is None else _strip_controls(told)}
    return known | {"total_steps": sum(known["steps"].get(str(kind), 0) for kind in TRAINING_KINDS)}


def describe_unfinished(population: Path) -> str | None:
    """What is still to come of a population, by its folder or its run's; None where nothing is, or it lies in no run.

    Returns:
        Such as "runs/night is interrupted: 2 of 8 members are there".
    """
    folder = population.resolve()
    folder = folder.parent if folder.name == "population" else folder
    if not (folder / "config.json").is_file():
        return None
    run = describe_run(folder)
    if run["state"] == "finished":
        return None
    try:
        members = len(json.loads(read_regular(folder / "population" / "manifest.json"))["members"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None  # whoever loads it is told
    return f"{_strip_controls(str(population))} is {run['state']}: {members} of {run['size']} members are there"


def describe_end(error: BaseException) -> str:
    """What ended a run, in one line of plain text: Ray's errors bring colours and the tracebacks of other processes."""
    if (interruption := describe_interruption(error)) is not None:
        return interruption
    cause = getattr(error, "cause", None)
    known = cause if isinstance(cause, BaseException) else error
    text = _strip_controls(" ".join(_COLOURS.sub("", mask_credentials(str(known))).split()))
    name = type(known).__name__
    says_all = isinstance(known, UserError) or type(known) is RuntimeError
    return (text if text and says_all else f"{name}: {text}" if text else name)[:500]


def _strip_controls(value: Any) -> str:
    """Text in one line that a terminal takes for text: what other programs wrote may hold control characters."""
    return "".join(letter if letter.isprintable() else "?" for letter in str(value))


def _present_state(folder: Path, state: dict[str, Any], done: bool) -> str:
    told = state.get("state")
    if told == "running":
        return "running" if _is_alive(folder / LOCK, state) else "interrupted"
    if told in STATES:
        return str(told)
    return "finished" if done else "interrupted"  # of a version that did not write the file


def _is_alive(lock: Path, state: dict[str, Any]) -> bool:
    """Is the driver at work? A look changes nothing, and needs no right to write: a lock of its own would take both."""
    try:
        with open(lock, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except FileNotFoundError:
        return False
    except OSError as error:
        if error.errno in _TAKEN:
            return True
    # No locks here: what is left is its process, on this host.
    return state.get("host") != socket.gethostname() or Path(f"/proc/{state.get('pid')}").exists()


def read_state(folder: Path) -> dict[str, Any]:
    """`state.json`, {} without one.

    Raises:
        OSError, ValueError, RecursionError: it cannot be read, or a field is not of its type.
    """
    path = folder / STATE
    if not path.exists():
        return {}
    state = json.loads(read_regular(path))
    if not isinstance(state, dict):
        raise ValueError("no object")
    for name, kinds in _STATE_TYPES.items():
        value = state.get(name)
        wrong = isinstance(value, bool) or not isinstance(value, kinds)
        if value is not None and (wrong or isinstance(value, float) and not math.isfinite(value)):
            raise ValueError(f"{name} is {value!r:.40}")
    return state


def _sum_seconds(folder: Path, state: dict[str, Any]) -> float:
    """Of all attempts; one that ended without a word lasted until it was last heard of."""
    known = float(state.get("seconds") or 0.0)
    if state.get("state") != "running":
        return known
    heard = max((folder / name).stat().st_mtime for name in _ACTIVE if (folder / name).exists())
    return round(known + max(0.0, heard - float(state.get("began") or heard)), 1)


def _count_steps(ledger: Path) -> dict[str, int]:
    """Environment steps by kind; a line that is still being written does not count."""
    steps: Counter[str] = Counter()
    whole = read_regular(ledger).rpartition(b"\n")[0] if ledger.exists() else b""
    for line in whole.splitlines():
        entry = json.loads(line)
        steps[_strip_controls(entry["kind"])] += int(entry["steps"])
    return dict(steps)


def _describe_reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"it has no {error.args[0]!r}"
    text = getattr(error, "strerror", None) or str(error)
    return _strip_controls(" ".join(text.split())[:120]) or type(error).__name__
