"""A copy of the run's folder in the storage after each checkpoint and member. A storage that fails stops no run."""

from __future__ import annotations

from popgen.runs.monitoring import RunLog
from popgen.runs.sinks.sink import CheckpointWritten, MemberAdded, Sink
from popgen.runs.storage import Mirror


class StorageSink(Sink):
    """Pushes the folder; a copy that was not taken is a line of the run's log."""

    def __init__(self, mirror: Mirror, log: RunLog) -> None:
        self.mirror, self.log = mirror, log

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """Copy what has changed."""
        self._push_copy()

    def on_member(self, added: MemberAdded) -> None:
        """Copy what has changed."""
        self._push_copy()

    def on_end(self, status: str) -> None:
        """Copy a finished run."""
        if status == "FINISHED":
            self._push_copy()

    def _push_copy(self) -> None:
        try:
            self.mirror.push()
        except OSError as error:
            text = f"{self.mirror.uri} did not take a copy ({' '.join(str(error).split())[:200]})"
            self.log.write("note", level="WARNING", text=text)
