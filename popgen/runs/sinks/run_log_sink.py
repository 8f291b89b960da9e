"""Checkpoints and members as lines of run.log, each with the place where the run is."""

from __future__ import annotations

from popgen.runs.monitoring import RunLog
from popgen.runs.sinks.sink import CheckpointWritten, MemberAdded, Sink


class RunLogSink(Sink):
    """Writes to the run's log. Its last line is the recorder's, whatever the other sinks raise."""

    def __init__(self, log: RunLog) -> None:
        self.log = log

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """Lines are from now on of this member and iteration."""
        self.log.place = {"member": checkpoint.member, "iteration": checkpoint.iteration}
        self.log.write("checkpoint", steps=checkpoint.steps)

    def on_member(self, added: MemberAdded) -> None:
        """Lines are from now on of the following member."""
        self.log.write("member", member=added.member, steps=added.steps)
        self.log.place = {} if added.following is None else {"member": added.following}
