"""Environment steps to the ledger, on disk before training continues."""

from __future__ import annotations

from collections.abc import Sequence

from popgen.runs.ledger import Ledger
from popgen.runs.sinks.sink import Sink
from popgen.types import LedgerEntry


class LedgerSink(Sink):
    """Counts every entry once."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger

    def on_entries(self, entries: Sequence[LedgerEntry]) -> None:
        """Record and flush."""
        for entry in entries:
            self.ledger.record(entry)
        self.ledger.flush()

    def on_end(self, status: str) -> None:
        """Flush what a full disk may have kept back."""
        self.ledger.flush()
