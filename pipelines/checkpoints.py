"""Checkpoints: one of each finished member, and one at the boundary between two iterations of the running one.

    checkpoints/
      member_001/        both buffers, the world model's learner and the ledger's length after member 1
      progress/          of the running member: learners, samplers, generators, counters
      base_NNNNNN/       both buffers after segments_NNNNNN, where the log had become long
      segments_NNNNNN    the log: what was sampled since the last member, one file for each call of a sampler

The buffers are large and only ever grow at their end, so that an iteration's checkpoint holds a reference to the last
whole copy of them and the number of segment files to add to it. `progress` is replaced atomically, and names
everything it needs: whatever interrupts the writing, the old checkpoint or the new one is there.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from popgen.data.checkpoint import load_state, save_state
from popgen.data.segments import load_segments, save_segments
from popgen.types import Segment


def member_folder(root: Path, member: int) -> Path:
    """Where a run keeps the checkpoint of a finished member."""
    return root / "checkpoints" / f"member_{member:03d}"


class Checkpoints:
    """The iteration checkpoints of one run.

    Args:
        root: the run's folder.
        long: rows in the log from which on a whole copy of the buffers is written.
        seconds: least time between two checkpoints.
    """

    def __init__(self, root: Path, *, long: int, seconds: float) -> None:
        self.folder, self.long, self.seconds = root / "checkpoints", long, seconds
        self.folder.mkdir(parents=True, exist_ok=True)
        self.base: str | None = None
        self.first = self.count = self.rows = 0
        self.last = time.monotonic()

    def load(self, member: int) -> dict[str, Any] | None:
        """The running member's last checkpoint, None if there is none of this member.

        Raises:
            UserError: it is damaged.
        """
        if not self._progress.exists() and not self._progress.with_name("progress.old").exists():
            return None
        state = load_state(self._progress)
        if state["member"] != member:
            return None
        log = state["log"]
        self.base, self.first, self.count, self.rows = log["base"], log["first"], log["count"], log["rows"]
        return state

    def begin(self, base: Path | None) -> None:
        """A new member: nothing to go back to but `base`, a checkpoint of a finished member."""
        for path in (*self.folder.glob("progress*"), *self.folder.glob("base_*")):
            shutil.rmtree(path, ignore_errors=True)
        for path in self.folder.glob("segments_*"):
            path.unlink()
        self.base = None if base is None else str(base.resolve())
        self.first = self.count = self.rows = 0
        self.last = time.monotonic()

    def keep(self, segments: list[Segment], owner: int) -> None:
        """Add to the log."""
        save_segments(self._segments(self.count), segments, owner)
        self.count += 1
        self.rows += sum(segment.steps for segment in segments)

    def due(self) -> bool:
        """Is it time for the next one?"""
        return time.monotonic() - self.last >= self.seconds

    def save(self, member: int, state: dict[str, Any], replays: Callable[[], dict[str, Any]]) -> None:
        """Write `state`; `replays` gives the whole buffers, asked for where the log has become long."""
        if self.rows >= self.long:
            name = f"base_{self.count:06d}"
            save_state(self.folder / name, replays())
            self.base, self.first, self.rows = name, self.count, 0
        log = {"base": self.base, "first": self.first, "count": self.count, "rows": self.rows}
        save_state(self._progress, {**state, "member": member, "log": log})
        for path in self.folder.glob("base_*"):
            if path.name != self.base:
                shutil.rmtree(path, ignore_errors=True)
        for path in self.folder.glob("segments_*"):
            if int(path.name.rpartition("_")[2]) < self.first:
                path.unlink()
        self.last = time.monotonic()

    def replays(self) -> dict[str, Any] | None:
        """The whole copy of the buffers that the loaded checkpoint starts from; None for empty ones."""
        return None if self.base is None else load_state(self.folder / self.base)

    def log(self) -> Iterator[tuple[list[Segment], int]]:
        """Segments (with owner) to add to that, in order."""
        for number in range(self.first, self.count):
            yield load_segments(self._segments(number))

    @property
    def _progress(self) -> Path:
        return self.folder / "progress"

    def _segments(self, number: int) -> Path:
        return self.folder / f"segments_{number:06d}"
