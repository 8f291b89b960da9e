"""Checkpoints: one of each finished member, and those at the boundaries between iterations of the running one.

    checkpoints/
      member_001/        both buffers, the world model's learner and the ledger's length after member 1
      progress_NNNNNN/   of the running member: learners, samplers, generators, counters; the last two are kept
      base_NNNNNN/       both buffers after segments_NNNNNN, where the log had become long
      segments_NNNNNN    the log: what was sampled since the last member, one file for each call of a sampler

The buffers are large and only ever grow at their end, so that an iteration's checkpoint holds a reference to the last
whole copy of them and the number of segment files to add to it. `progress` appears at once, by a rename, and names
everything it needs: whatever interrupts the writing, the old checkpoint or the new one is there. Should the newest be
damaged, the one before it counts.

They are written and read by one worker of the run, an actor on the driver's node or an object of the driver's. What it
is given may hold handles: it resolves them, so that neither segments nor whole buffers pass through the driver. A
worker does its calls in the order in which they were sent: a checkpoint is written after the log that it refers to.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from popgen.durable_files import load_state, save_state, write_file
from popgen.errors import UserError
from popgen.methods.training import Checkpoint, InlineTransport, Place, Segments, State, Transport, Worker
from popgen.types import Kind, Segment

_ARRAYS = tuple(field.name for field in fields(Segment) if field.name not in ("kind", "members", "sampler", "sequence"))


def save_segments(path: Path, segments: list[Segment], owner: int) -> None:
    """Write and sync; `owner` is the member during whose training the steps were taken."""
    arrays = {
        f"{number}.{name}": np.ascontiguousarray(getattr(segment, name))
        for number, segment in enumerate(segments)
        for name in _ARRAYS
    }
    marks = [[str(s.kind), list(s.members), s.sampler, s.sequence] for s in segments]
    said = {"owner": str(owner), "segments": json.dumps(marks)}
    data = save(arrays, metadata={**said, "sha256": _digest_segments(arrays, said)})
    write_file(path, data)


def load_segments(path: Path) -> tuple[list[Segment], int]:
    """What `save_segments` wrote: the segments and their owner.

    Raises:
        UserError: a missing or damaged file.
    """
    try:
        with safe_open(str(path), "numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
            if metadata.get("sha256", _digest_segments(arrays, metadata)) != _digest_segments(arrays, metadata):
                raise ValueError("they are not what was written")
            marks = json.loads(metadata["segments"])
            segments = [
                Segment(
                    Kind(kind),
                    (int(members[0]), int(members[1])),
                    **{name: arrays[f"{number}.{name}"] for name in _ARRAYS},
                    sampler=sampler,
                    sequence=int(sequence),
                )
                for number, (kind, members, sampler, sequence) in enumerate(marks)
            ]
            return segments, int(metadata["owner"])
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise UserError(str(path), f"unreadable segments ({error})", "remove checkpoints/progress") from None


def _digest_segments(arrays: Mapping[str, np.ndarray], said: Mapping[str, str]) -> str:
    """sha256 of the marks and, by name, of the arrays."""
    digest = hashlib.sha256(f"{said['owner']} {said['segments']}".encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    return digest.hexdigest()


KEPT = 2
"""Checkpoints of the running member that are there at any time, once there were so many."""


@contextmanager
def fitting(folder: Path) -> Iterator[None]:
    """Around what puts a checkpoint's parts where they belong: parts that do not fit are told in one line.

    Raises:
        UserError: a part is missing, or of another size or type.
    """
    try:
        yield
    except UserError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:  # torch's too
        cause = getattr(error, "cause", error)  # Ray's error of an actor is of both types
        reason = f"no {cause}" if isinstance(cause, KeyError) else str(cause).partition("\n")[0]
        problem = f"its checkpoint does not fit this run ({reason})"
        raise UserError(str(folder), problem, "remove it or start a new run") from None


def finished_member(root: Path, member: int) -> dict[str, Any]:
    """The checkpoint of a finished member; its `ledger` is a length, or is not there.

    Raises:
        UserError: it is damaged.
    """
    folder = member_folder(root, member)
    state = load_state(folder)
    length = state.get("ledger", 0)
    if type(length) is not int or length < 0:
        raise UserError(str(folder), "is no checkpoint of a finished member", "remove it or start a new run")
    return state


def _log_of(folder: Path, state: dict[str, Any]) -> dict[str, Any]:
    """The part about the log, of a state that is a running member's."""
    log = state.get("log")
    found = log if isinstance(log, dict) else {}
    counts = (state.get("member"), state.get("ledger"), *(found.get(name) for name in ("first", "count", "rows")))
    whole = all(type(count) is int and 0 <= count < 2**63 for count in counts)
    if not whole or found["first"] > found["count"] or not isinstance(found.get("base"), str | None):
        raise UserError(str(folder), "is no checkpoint of a running member", "remove it or start a new run")
    return found


def member_folder(root: Path, member: int) -> Path:
    """Where a run keeps the checkpoint of a finished member."""
    return root / "checkpoints" / f"member_{member:03d}"


class Checkpoints:
    """The iteration checkpoints of one run.

    Args:
        root: the run's folder.
        long: rows in the log from which on a whole copy of the buffers is written.

    Attributes:
        note: what `load` has to say about a damaged checkpoint.
    """

    def __init__(self, root: Path, *, long: int) -> None:
        self.folder, self.long = root / "checkpoints", long
        self.folder.mkdir(parents=True, exist_ok=True)
        self.base: str | None = None
        self.first = self.count = self.rows = 0
        self.needed: dict[int, dict[str, Any]] = {}
        self.note = ""

    def load(self, member: int) -> dict[str, Any] | None:
        """The running member's last whole checkpoint, None if there is none of this member.

        Raises:
            UserError: all are damaged.
        """
        damage: UserError | None = None
        for number in reversed(self._list_numbers()):
            try:
                state = load_state(self._progress_folder(number))
                log = _log_of(self._progress_folder(number), state)
            except UserError as error:
                damage = damage or error
                continue
            if damage is not None:
                self.note = f"{damage.field}: {damage.problem}; the checkpoint before it counts"
                self._drop_progress(above=number)
            if state["member"] != member:
                return None
            self.base, self.first, self.count, self.rows = log["base"], log["first"], log["count"], log["rows"]
            self.needed = {number: log}
            return state
        if damage is not None:
            raise damage
        return None

    def begin(self, base: Path | None) -> None:
        """A new member: nothing to go back to but `base`, a checkpoint of a finished member."""
        for path in (*self.folder.glob("progress*"), *self.folder.glob("base_*")):
            shutil.rmtree(path, ignore_errors=True)
        for path in self.folder.glob("segments_*"):
            path.unlink()
        # By its name if it is our own: the folder may go on elsewhere.
        own = base is not None and base.resolve().parent == self.folder.resolve()
        self.base = None if base is None else base.name if own else str(base.resolve())
        self.first = self.count = self.rows = 0
        self.needed = {}

    def keep(self, segments: list[Segment], owner: int) -> None:
        """Add to the log."""
        save_segments(self._segments_path(self.count), segments, owner)
        self.count += 1
        self.rows += sum(segment.steps for segment in segments)

    def save(self, member: int, state: dict[str, Any], replays: Callable[[], dict[str, Any]]) -> None:
        """Write `state`; `replays` gives the whole buffers, asked for where the log has become long."""
        if self.rows >= self.long:
            name = f"base_{self.count:06d}"
            save_state(self.folder / name, replays())
            self.base, self.first, self.rows = name, self.count, 0
        log = {"base": self.base, "first": self.first, "count": self.count, "rows": self.rows}
        number = max((0, *self._list_numbers())) + 1
        save_state(self._progress_folder(number), {**state, "member": member, "log": log})
        self.needed[number] = log
        self._remove_unneeded()

    def _remove_unneeded(self) -> None:
        """Remove what none of the kept checkpoints needs."""
        self.needed = {number: self.needed[number] for number in sorted(self.needed)[-KEPT:]}
        for number in self._list_numbers():
            if number not in self.needed:
                shutil.rmtree(self._progress_folder(number), ignore_errors=True)
        bases, first = {log["base"] for log in self.needed.values()}, min(log["first"] for log in self.needed.values())
        for path in self.folder.glob("base_*"):
            if path.name not in bases:
                shutil.rmtree(path, ignore_errors=True)
        for path in self.folder.glob("segments_*"):
            if int(path.name.rpartition("_")[2]) < first:
                path.unlink()

    def replays(self) -> dict[str, Any] | None:
        """The whole copy of the buffers that the loaded checkpoint starts from; None for empty ones."""
        return None if self.base is None else load_state(self.folder / self.base)

    def log(self) -> Iterator[tuple[list[Segment], int]]:
        """Segments (with owner) to add to that, in order."""
        for number in range(self.first, self.count):
            yield load_segments(self._segments_path(number))

    def _list_numbers(self) -> list[int]:
        """Of the checkpoints that are there, ascending."""
        names = (path.name.partition("_")[2] for path in self.folder.glob("progress_*"))
        return sorted(int(name) for name in names if name.isdecimal())

    def _drop_progress(self, above: int) -> None:
        for number in self._list_numbers():
            if number > above:
                shutil.rmtree(self._progress_folder(number), ignore_errors=True)

    def _progress_folder(self, number: int) -> Path:
        return self.folder / f"progress_{number:06d}"

    def _segments_path(self, number: int) -> Path:
        return self.folder / f"segments_{number:06d}"


# ---- the process that writes them ------------------------------------------------------------------------------------


def resolve_handles(value: Any) -> Any:
    """`value` with the results of all handles in it; records become dictionaries of their fields."""
    if hasattr(value, "result"):
        return resolve_handles(value.result())
    if isinstance(value, dict):
        return {key: resolve_handles(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [resolve_handles(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: resolve_handles(getattr(value, field.name)) for field in fields(value)}
    return value


class CheckpointWriter:
    """Holds the `Checkpoints` of one run.

    Args:
        root: the run's folder.
        long: rows in the log from which on a whole copy of the buffers is written.
        transport: makes the handles of what is read.
    """

    def __init__(self, root: Path, long: int, transport: Transport) -> None:
        self.root, self.transport = root, transport
        self.checkpoints = Checkpoints(root, long=long)
        self.log: Iterator[tuple[list[Segment], int]] = iter(())

    def begin(self, base: Path | None) -> None:
        """See `Checkpoints.begin`."""
        self.checkpoints.begin(base)

    def append(self, segments: Segments, owner: int) -> bool:
        """Add to the log; whether the log has become long."""
        self.checkpoints.keep([segment for part in segments.values() for segment in part.result()], owner)
        return self.checkpoints.rows >= self.checkpoints.long

    def save(self, member: int, state: State, buffers: State | None) -> None:
        """Write a checkpoint; `buffers` are needed where the log is long."""
        self.checkpoints.save(member, resolve_handles(state), lambda: resolve_handles(buffers or {}))

    def save_member(self, member: int, left: State) -> None:
        """Write what a finished member leaves behind."""
        save_state(member_folder(self.root, member), resolve_handles(left))

    def load(self, member: int) -> State | None:
        """See `Checkpoints.load`."""
        state = self.checkpoints.load(member)
        self.log = self.checkpoints.log()
        return state

    def note(self) -> str:
        """What the last `load` has to say about a damaged checkpoint."""
        return self.checkpoints.note

    def buffers(self) -> State | None:
        """The whole copy that the loaded checkpoint starts from, each part behind a handle."""
        whole = self.checkpoints.replays()
        return None if whole is None else self._behind_handles(whole)

    def read_log(self) -> tuple[Segments, int] | None:
        """The next file of the log that comes after it: segments by kind, and their owner; None at the end."""
        entry = next(self.log, None)
        if entry is None:
            return None
        by_kind: dict[Kind, list[Segment]] = {}
        for segment in entry[0]:
            by_kind.setdefault(segment.kind, []).append(segment)
        return {kind: self.transport.put(part) for kind, part in by_kind.items()}, entry[1]

    def load_member(self, root: Path, member: int) -> State:
        """What a finished member of a run left behind; its large parts behind handles."""
        return self._behind_handles(finished_member(root, member))

    def _behind_handles(self, state: State) -> State:
        return {name: self.transport.put(part) if isinstance(part, dict) else part for name, part in state.items()}


class CheckpointFiles:
    """The driver's end: when a checkpoint is due, and the calls to the writer.

    Args:
        root: the run's folder.
        long: rows in the log from which on a whole copy of the buffers is written.
        seconds: least time between two checkpoints.
        transport: where the writer works.
    """

    def __init__(self, root: Path, *, long: int, seconds: float, transport: Transport | None = None) -> None:
        self.folder, self.seconds = root / "checkpoints", seconds
        transport = transport or InlineTransport()
        self.writer: Worker[CheckpointWriter] = transport.start(
            CheckpointWriter, Place(with_driver=True), root, long, transport
        )
        self.last, self.log_is_long = time.monotonic(), False

    def begin(self, base: Path | None) -> None:
        """A new member: nothing to go back to but `base`, a checkpoint of a finished member."""
        self.writer.ask(CheckpointWriter.begin, base).result()
        self.last, self.log_is_long = time.monotonic(), False

    def append(self, segments: Segments, owner: int) -> None:
        """Add to the log; on disk when this returns."""
        self.log_is_long = self.writer.ask(CheckpointWriter.append, segments, owner).result()

    def due(self) -> bool:
        """Is it time for the next one?"""
        return time.monotonic() - self.last >= self.seconds

    def save(self, member: int, state: State, buffers: State | None) -> None:
        """Write a checkpoint; whole on disk when this returns."""
        self.writer.ask(CheckpointWriter.save, member, state, buffers).result()
        self.last = time.monotonic()
        if buffers is not None:
            self.log_is_long = False

    def save_member(self, member: int, left: State) -> None:
        """What a finished member leaves behind; on disk when this returns."""
        self.writer.ask(CheckpointWriter.save_member, member, left).result()

    def load(self, member: int) -> Checkpoint | None:
        """The running member's last whole checkpoint, None if there is none of this member."""
        state = self.writer.ask(CheckpointWriter.load, member).result()
        if state is None:
            return None
        return Checkpoint(state, self.writer.ask(CheckpointWriter.buffers).result(), self._read_log())

    def _read_log(self) -> Iterator[tuple[Segments, int]]:
        while (entry := self.writer.ask(CheckpointWriter.read_log).result()) is not None:
            yield entry

    def note(self) -> str:
        """What `load` has to say about a damaged checkpoint."""
        return self.writer.ask(CheckpointWriter.note).result()

    def load_member(self, root: Path, member: int) -> State:
        """What a finished member of a run left behind.

        Raises:
            UserError: it is damaged.
        """
        return self.writer.ask(CheckpointWriter.load_member, root, member).result()

    def close(self) -> None:
        """End the writer."""
        self.writer.end()
