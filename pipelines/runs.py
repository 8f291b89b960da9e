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
import os
import socket
import time
from collections import Counter
from pathlib import Path
from typing import Any, TextIO

from popgen.errors import UserError

LOCK, STATE = "run.lock", "state.json"
STATES = ("running", "finished", "failed", "interrupted", "damaged")
OUTCOMES = {"FINISHED": "finished", "FAILED": "failed", "KILLED": "interrupted"}
"""MLflow's status of a run -> ours."""

_TAKEN = (errno.EAGAIN, errno.EACCES)
_TRIES, _PAUSE = 10, 0.05  # a look at the lock holds it for a moment
_ACTIVE = ("metrics.jsonl", "ledger.jsonl", STATE)
"""Files that a living driver writes to: the last of these times is when an attempt was last heard of."""


class RunState:
    """The driver's hold on its run's folder: one driver at a time.

    Args:
        folder: the run's, which exists.

    Raises:
        UserError: another driver is at work on it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.began, self._past, self._attempt = folder, time.time(), 0.0, 0
        self._file = open(folder / LOCK, "a+", encoding="utf-8")  # noqa: SIM115 (held until the end)
        if not _lock(self._file):
            self._file.seek(0)
            holder = self._file.read(200).strip() or "another process"
            self._file.close()
            problem = f"{folder.name} is being run by {holder}"
            raise UserError("run.id", problem, "wait for it, stop it, or choose another id")
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        self._file.flush()

    @staticmethod
    def check_free(folder: Path) -> None:
        """Nobody is at work on this run, whose folder need not be there yet.

        Raises:
            UserError: another driver is.
        """
        if (folder / LOCK).exists():
            RunState(folder)._file.close()

    def start(self, attempt: int) -> None:
        """The attempt begins."""
        try:
            self._past = _seconds(self.folder, _read_state(self.folder))
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            self._past = 0.0  # a damaged file costs the time of earlier attempts, and nothing else
        self.began, self._attempt = time.time(), attempt
        self._write("running")

    def end(self, status: str, error: BaseException | None = None) -> None:
        """It ended with an MLflow status; the lock is given up."""
        text = None if error is None else " ".join((str(error) or type(error).__name__).split())[:500]
        self._write(OUTCOMES[status], text)
        self._file.close()

    def _write(self, state: str, error: str | None = None) -> None:
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
        fresh = self.folder / f"{STATE}.writing"
        fresh.write_text(json.dumps(values), encoding="utf-8")
        fresh.replace(self.folder / STATE)


def _lock(file: TextIO) -> bool:
    """Take the lock for the file's life; False if another process holds it.

    A record lock: it belongs to the process, no child inherits it, and NFS carries it to other hosts. Where the file
    system has no locks, nobody is kept out.
    """
    for _ in range(_TRIES):
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except OSError as error:
            if error.errno not in _TAKEN:
                return True
        time.sleep(_PAUSE)
    return False


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
    that is trained, or the last one) of size; steps (environment steps by ledger kind) and total_steps; seconds of all
    attempts; attempt; began (of the last attempt, seconds since 1970); error (of the last attempt, None without one).
    A folder with a file that cannot be read is "damaged", and `error` names it.
    """
    known: dict[str, Any] = {"id": folder.name, "state": "damaged", "method": None, "scale": None}
    known |= {"environment": None, "member": None, "size": None, "steps": {}, "total_steps": 0}
    known |= {"seconds": 0.0, "attempt": None, "began": None, "error": None}
    path = folder / "config.json"
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        known |= {"method": config["method"], "scale": config["scale"], "environment": config["env"]["name"]}
        known["size"] = int(config["population"]["size"])
        path = folder / STATE
        state = _read_state(folder)
        known |= {"seconds": _seconds(folder, state), "attempt": state.get("attempt"), "began": state.get("began")}
        path = folder / "population" / "manifest.json"
        members = len(json.loads(path.read_text(encoding="utf-8"))["members"]) if path.exists() else 0
        known["member"] = min(members + 1, known["size"])
        path = folder / "ledger.jsonl"
        known["steps"] = _steps(path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return known | {"error": f"{path.relative_to(folder)} cannot be read ({_reason(error)})"}
    done = members >= known["size"] and (folder / "report" / "crossplay.json").exists()
    known |= {"state": _present(folder, state, done), "error": state.get("error")}
    return known | {"total_steps": sum(known["steps"].values())}


def _present(folder: Path, state: dict[str, Any], done: bool) -> str:
    told = state.get("state")
    if told == "running":
        return "running" if _is_alive(folder / LOCK, state) else "interrupted"
    if told in STATES:
        return str(told)
    return "finished" if done else "interrupted"  # of a version that did not write the file


def _is_alive(lock: Path, state: dict[str, Any]) -> bool:
    """Is the driver at work? Not to be asked by the driver's own process, whose lock it would end."""
    try:
        with open(lock, "rb") as file:
            fcntl.lockf(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except FileNotFoundError:
        return False
    except OSError as error:
        if error.errno in _TAKEN:
            return True
    # No locks here: what is left is its process, on this host.
    return state.get("host") != socket.gethostname() or Path(f"/proc/{state.get('pid')}").exists()


def _read_state(folder: Path) -> dict[str, Any]:
    path = folder / STATE
    if not path.exists():
        return {}
    state = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(state, dict):
        raise ValueError("no object")
    return state


def _seconds(folder: Path, state: dict[str, Any]) -> float:
    """Of all attempts; one that ended without a word lasted until it was last heard of."""
    known = float(state.get("seconds") or 0.0)
    if state.get("state") != "running":
        return known
    heard = max((folder / name).stat().st_mtime for name in _ACTIVE if (folder / name).exists())
    return round(known + max(0.0, heard - float(state["began"])), 1)


def _steps(ledger: Path) -> dict[str, int]:
    """Environment steps by kind; a line that is still being written does not count."""
    steps: Counter[str] = Counter()
    whole = ledger.read_bytes().rpartition(b"\n")[0] if ledger.exists() else b""
    for line in whole.splitlines():
        entry = json.loads(line)
        steps[str(entry["kind"])] += int(entry["steps"])
    return dict(steps)


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"it has no {error.args[0]!r}"
    text = getattr(error, "strerror", None) or str(error)
    return " ".join(text.split())[:120] or type(error).__name__
