"""The process that writes and reads a run's checkpoints: an actor on the driver's node, or an object of the driver's.

What it is given may hold handles: it resolves them, so that neither segments nor whole buffers pass through the driver.
A worker does its calls in the order in which they were sent: a checkpoint is written after the log that it refers to.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from popgen.methods.training import Checkpoint, Segments, State
from popgen.methods.transport import InlineTransport, Place, Transport, Worker
from popgen.runs.checkpoints import Checkpoints, finished_member, member_folder
from popgen.runs.state_files import save_state
from popgen.types import Kind, Segment


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
        self.checkpoints = Checkpoints(root, long=long, seconds=0.0)
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
        return Checkpoint(state, self.writer.ask(CheckpointWriter.buffers).result(), self._log())

    def _log(self) -> Iterator[tuple[Segments, int]]:
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
