"""Writes what games put, in a thread beside them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from sqlalchemy.exc import OperationalError

from popgen.study.game_records import GameEnd, GameRecords, Tick

FLUSH_SECONDS = 0.4
"""Steps wait so long at most until they are written."""

_log = logging.getLogger("popgen.study")


class RecordWriter:
    """Writes what games put, in their order, in a thread of its own.

    Args:
        records: where it is written.
        wait: seconds that a step waits at most.
    """

    def __init__(self, records: GameRecords, wait: float = FLUSH_SECONDS) -> None:
        self._records, self._wait = records, wait
        self._rows: list[Tick | GameEnd] = []
        self._after: list[Callable[[], None]] = []
        self._ready = threading.Condition()
        self._hurry = self._stopping = False
        self._thread = threading.Thread(target=self._run_writer, name="popgen-records", daemon=True)
        self._thread.start()

    def put(self, row: Tick | GameEnd, after: Callable[[], None] | None = None) -> None:
        """Write soon; `after` is called once it is written. An end is written at once, with all before it."""
        with self._ready:
            self._rows.append(row)
            if after is not None:
                self._after.append(after)
            self._hurry |= isinstance(row, GameEnd)
            self._ready.notify()

    def tell(self, after: Callable[[], None]) -> None:
        """Call `after` once everything put so far is written."""
        with self._ready:
            self._after.append(after)
            self._ready.notify()

    def flush(self) -> None:
        """Return when everything put so far is written."""
        written = threading.Event()
        with self._ready:
            self._after.append(written.set)
            self._hurry = True
            self._ready.notify()
        written.wait()

    def stop(self) -> None:
        """Write all and end."""
        with self._ready:
            self._stopping = self._hurry = True
            self._ready.notify()
        self._thread.join()

    def _run_writer(self) -> None:
        while True:
            with self._ready:
                while not (self._rows or self._after or self._stopping):
                    self._ready.wait()
                self._ready.wait_for(lambda: self._hurry, self._wait)
                rows, after, ended = self._rows, self._after, self._stopping
                self._rows, self._after, self._hurry = [], [], self._stopping
            self._write_rows(rows)
            for call in after:
                call()
            if ended:
                return

    def _write_rows(self, rows: list[Tick | GameEnd]) -> None:
        """A full disk is waited for; nothing is given up."""
        while rows:
            try:
                self._records.write(rows)
                return
            except OperationalError as error:
                _log.error("records cannot be written (%s); trying again", error.orig)
                time.sleep(FLUSH_SECONDS)
                if self._stopping:
                    return
