"""The ledger: every environment step of a run, counted once."""

from __future__ import annotations

import csv
import json
import os
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from popgen.durable_files import replace_file
from popgen.errors import UserError
from popgen.types import POPULATION, TRAINING_KINDS, Kind, LedgerEntry


class LedgerConflict(RuntimeError):
    """A key was recorded again with other figures: two tasks claim the same environment steps."""


class Ledger:
    """An append-only JSONL file of `LedgerEntry`, one a line, with totals kept in memory.

    `record` buffers, `flush` writes and syncs to disk. A process that dies in `flush` can leave half a line at the
    end; the next `Ledger` on that path cuts it off and says so in `note`. One writer at a time.

    Args:
        path: of the file, made with its folder at the first flush; None keeps the ledger in memory.

    Raises:
        UserError: the file holds something other than ledger entries, or one key with two different entries.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        self.note = ""
        self._entries: dict[tuple[str, int, str, str, int], LedgerEntry] = {}
        self._totals: dict[tuple[int, Kind], list[float]] = defaultdict(lambda: [0, 0, 0.0])
        self._pending: list[str] = []
        if self.path is not None and self.path.exists():
            self._load_entries(self.path)

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[LedgerEntry]:
        return iter(self._entries.values())

    def record(self, entry: LedgerEntry) -> bool:
        """Count an entry; False if exactly this entry was counted before.

        Raises:
            LedgerConflict: the same key was counted with other figures.
            ValueError: negative steps or episodes.
        """
        entry = replace(
            entry,
            member=int(entry.member),
            kind=Kind(entry.kind),
            sequence=int(entry.sequence),
            steps=int(entry.steps),
            episodes=int(entry.episodes),
            score=float(entry.score),
        )
        if not self._count_entry(entry):
            return False
        if self.path is not None:
            self._pending.append(_entry_line(entry))
        return True

    def flush(self) -> None:
        """Write what is buffered and wait until the disk has it.

        Raises:
            OSError: nothing was written (a full disk, for one); the entries stay buffered.
        """
        if self.path is None or not self._pending:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab", buffering=0) as file:
            before = file.seek(0, os.SEEK_END)
            try:
                data = memoryview("".join(self._pending).encode())
                while data:
                    data = data[file.write(data) :]
                os.fsync(file.fileno())
            except OSError:
                file.truncate(before)
                raise
        self._pending.clear()

    def cut(self, count: int) -> int:
        """Keep the first `count` entries: the work behind the others was lost, and will be done again.

        They are set aside in `NAME.lost.jsonl` beside the file. Returns how many they were.

        Raises:
            ValueError: there are fewer than `count` entries.
        """
        entries = list(self._entries.values())
        if count > len(entries):
            raise ValueError(f"ledger: cannot keep {count} of {len(entries)} entries")
        lost = entries[count:]
        if not lost:
            return 0
        self.flush()
        if self.path is not None:
            with open(self.path.with_suffix(".lost.jsonl"), "a") as file:
                file.writelines(_entry_line(entry) for entry in lost)
            replace_file(self.path, "".join(_entry_line(entry) for entry in entries[:count]).encode())
        self._entries.clear()
        self._totals.clear()
        for entry in entries[:count]:
            self._count_entry(entry)
        return len(lost)

    def steps(self, member: int | None = None, kind: Kind | str | None = None) -> int:
        """Environment steps, of one member, of one kind, or of all."""
        return int(sum(total[0] for total in self._select_totals(member, kind)))

    def episodes(self, member: int | None = None, kind: Kind | str | None = None) -> int:
        """Finished episodes, of one member, of one kind, or of all."""
        return int(sum(total[1] for total in self._select_totals(member, kind)))

    def table(self) -> dict[str, dict[str, int]]:
        """Environment steps: member -> kind -> steps, a row `population` for what is no member's own, a row `total`.

        JSON-able. The `total` in each row is of the steps that training took, `TRAINING_KINDS`.
        """
        rows: dict[str, dict[str, int]] = {}
        total: dict[str, int] = {}
        for (member, kind), (steps, _, _) in sorted(self._totals.items()):
            row = rows.setdefault("population" if member == POPULATION else str(member), {})
            row[str(kind)] = int(steps)
            total[str(kind)] = total.get(str(kind), 0) + int(steps)
        rows["total"] = total
        for row in rows.values():
            row["total"] = sum(row.get(str(kind), 0) for kind in TRAINING_KINDS)
        return rows

    def to_csv(self, path: str | Path) -> None:
        """Write totals by member and kind: member, kind, steps, episodes, score."""
        with open(path, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["member", "kind", "steps", "episodes", "score"])
            for (member, kind), (steps, episodes, score) in sorted(self._totals.items()):
                writer.writerow([member, str(kind), int(steps), int(episodes), score])

    def _select_totals(self, member: int | None, kind: Kind | str | None) -> Iterator[list[float]]:
        wanted = None if kind is None else Kind(kind)
        for (who, what), total in self._totals.items():
            if member in (None, who) and wanted in (None, what):
                yield total

    def _count_entry(self, entry: LedgerEntry) -> bool:
        known = self._entries.get(entry.key)
        if known is not None:
            if known != entry:
                raise LedgerConflict(f"ledger: {entry.key} was recorded as {known} and comes again as {entry}")
            return False
        if entry.steps < 0 or entry.episodes < 0:
            raise ValueError(f"ledger: negative steps or episodes in {entry}")
        self._entries[entry.key] = entry
        total = self._totals[entry.member, entry.kind]
        total[0] += entry.steps
        total[1] += entry.episodes
        total[2] += entry.score
        return True

    def _load_entries(self, path: Path) -> None:
        data = path.read_bytes()
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            self.note = f"{path}: dropped an unfinished last line of {len(data) - whole} bytes"
            os.truncate(path, whole)
        for number, line in enumerate(data[:whole].splitlines(), start=1):
            try:
                self._count_entry(_parse_entry(json.loads(line)))
            except (ValueError, TypeError, KeyError, RecursionError, LedgerConflict) as error:
                fix = "restore the file from a copy, or start a new run"
                raise UserError("ledger", f"{path} line {number} is no ledger entry ({error})", fix) from None


def _entry_line(entry: LedgerEntry) -> str:
    return json.dumps(asdict(entry)) + "\n"


_FIELDS = {field.name for field in fields(LedgerEntry)}
_TYPES = {"run": str, "member": int, "sampler": str, "sequence": int, "steps": int, "episodes": int, "score": float}


def _parse_entry(values: dict[str, Any]) -> LedgerEntry:
    if not isinstance(values, dict) or set(values) != _FIELDS:
        raise ValueError(f"expected the fields {', '.join(sorted(_FIELDS))}")
    for name, kind in _TYPES.items():
        if type(values[name]) is not kind and not (kind is float and type(values[name]) is int):
            raise ValueError(f"{name} is {values[name]!r:.100}")
    return LedgerEntry(**{**values, "kind": Kind(values["kind"])})
