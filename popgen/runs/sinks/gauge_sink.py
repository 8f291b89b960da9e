"""Gauges for Prometheus; nothing happens without Ray."""

from __future__ import annotations

from collections.abc import Sequence

from popgen.runs.ledger import Ledger
from popgen.runs.monitoring import gauge, show_figures
from popgen.runs.sinks.sink import CheckpointWritten, MemberAdded, MetricPoint, Sink
from popgen.types import Kind, LedgerEntry


class GaugeSink(Sink):
    """Sets the gauges that `popgen.runs.monitoring.GAUGES` lists."""

    def __init__(self, run: str, ledger: Ledger) -> None:
        self.run, self.ledger = run, ledger

    def on_entries(self, entries: Sequence[LedgerEntry]) -> None:
        """Totals by kind."""
        for kind in Kind:
            if steps := self.ledger.steps(kind=kind):
                gauge("popgen_environment_steps", steps, run=self.run, kind=str(kind))

    def on_metrics(self, point: MetricPoint) -> None:
        """The member's score, the learners' speed, room on the disk."""
        if point.free_bytes is not None:
            gauge("popgen_disk_free_bytes", point.free_bytes, run=self.run)
        show_figures(self.run, point.member, point.figures)

    def on_checkpoint(self, checkpoint: CheckpointWritten) -> None:
        """Iterations of the member in training."""
        gauge("popgen_iteration", checkpoint.iteration, run=self.run, member=str(checkpoint.member))

    def on_member(self, added: MemberAdded) -> None:
        """Members in the population."""
        gauge("popgen_members", added.member, run=self.run)
