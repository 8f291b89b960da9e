from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from popgen.errors import UserError
from popgen.runs.ledger import Ledger, LedgerConflict
from popgen.types import POPULATION, Kind, LedgerEntry

ENTRY = LedgerEntry("run", 1, Kind.SP, "sampler0", 0, 400, 1, 3.0)


def entries(count: int) -> list[LedgerEntry]:
    kinds = (Kind.SP, Kind.XP)
    return [replace(ENTRY, member=1 + n // 4, kind=kinds[n % 2], sequence=n, steps=100 + n) for n in range(count)]


def filled(path: Path, count: int = 8) -> Ledger:
    ledger = Ledger(path)
    for entry in entries(count):
        assert ledger.record(entry)
    ledger.flush()
    return ledger


def test_totals_by_member_and_kind(tmp_path: Path) -> None:
    ledger = filled(tmp_path / "ledger.jsonl")
    assert ledger.steps() == sum(range(100, 108))
    assert ledger.steps(member=1) == 100 + 101 + 102 + 103
    assert ledger.steps(kind=Kind.XP) == ledger.steps(kind="XP") == 101 + 103 + 105 + 107
    assert ledger.steps(member=2, kind=Kind.SP) == 104 + 106
    assert ledger.steps(member=3) == 0
    assert ledger.episodes(member=2) == 4
    assert ledger.table() == {
        "1": {"SP": 202, "XP": 204, "total": 406},
        "2": {"SP": 210, "XP": 212, "total": 422},
        "total": {"SP": 412, "XP": 416, "total": 828},
    }


def test_a_total_is_of_training_and_an_evaluation_of_the_population() -> None:
    ledger = Ledger()
    kinds = {Kind.SP: 100, Kind.XP: 20, Kind.SIMULATED: 7000}
    for sequence, (kind, steps) in enumerate(kinds.items()):
        ledger.record(LedgerEntry("run", 1, kind, "s", sequence, steps, 1, 0.0))
    ledger.record(LedgerEntry("run", POPULATION, Kind.EVALUATION, "evaluation", 0, 300, 1, 0.0))
    assert ledger.table() == {
        "population": {"evaluation": 300, "total": 0},
        "1": {"SP": 100, "XP": 20, "simulated": 7000, "total": 120},
        "total": {"SP": 100, "XP": 20, "simulated": 7000, "evaluation": 300, "total": 120},
    }


def test_the_same_entry_counts_once(tmp_path: Path) -> None:
    ledger = filled(tmp_path / "ledger.jsonl")
    before = (tmp_path / "ledger.jsonl").read_bytes()
    assert not ledger.record(entries(1)[0])
    # As an actor would send it, with numpy numbers and the kind as text.
    again: Any = replace(entries(1)[0], steps=np.int64(100), score=np.float32(3.0), kind="SP")
    assert not ledger.record(again)
    ledger.flush()
    assert ledger.steps() == 828
    assert (tmp_path / "ledger.jsonl").read_bytes() == before


@pytest.mark.parametrize("change", [{"steps": 401}, {"episodes": 2}, {"score": 4.0}])
def test_the_same_key_with_other_figures_is_an_error(change: dict[str, Any]) -> None:
    ledger = Ledger()
    ledger.record(ENTRY)
    with pytest.raises(LedgerConflict, match="sampler0"):
        ledger.record(replace(ENTRY, **change))
    assert ledger.steps() == 400


@pytest.mark.parametrize(
    "change", [{"run": "other"}, {"member": 2}, {"kind": Kind.XP}, {"sampler": "sampler1"}, {"sequence": 1}]
)
def test_each_part_of_the_key_counts(change: dict[str, Any]) -> None:
    ledger = Ledger()
    assert ledger.record(ENTRY) and ledger.record(replace(ENTRY, **change))
    assert ledger.steps() == 800


def test_negative_steps_are_refused() -> None:
    ledger = Ledger()
    with pytest.raises(ValueError, match="negative"):
        ledger.record(replace(ENTRY, steps=-1))
    assert len(ledger) == 0 and ledger.record(ENTRY)


def test_loading_gives_the_same_ledger(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    ledger = filled(path)
    loaded = Ledger(path)
    assert list(loaded) == list(ledger) and loaded.table() == ledger.table() and loaded.note == ""
    assert not loaded.record(entries(1)[0])
    assert loaded.record(replace(ENTRY, sequence=99, score=0.1))
    loaded.flush()
    assert list(Ledger(path)) == list(loaded)


def test_nothing_is_written_before_flush(tmp_path: Path) -> None:
    path = tmp_path / "new" / "ledger.jsonl"
    ledger = Ledger(path)
    ledger.record(ENTRY)
    assert not path.exists()
    ledger.flush()
    assert len(path.read_text().splitlines()) == 1


@pytest.mark.parametrize("cut", [1, 20, 5000])
def test_a_half_written_last_line_is_dropped_and_noted(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "ledger.jsonl"
    filled(path)
    whole = path.read_bytes()
    last = whole.rstrip(b"\n").rfind(b"\n") + 1
    path.write_bytes(whole[: max(last + 1, len(whole) - cut)])
    loaded = Ledger(path)
    assert len(loaded) == 7 and "unfinished" in loaded.note
    assert path.read_bytes() == whole[:last]
    loaded.record(entries(8)[7])
    loaded.flush()
    assert path.read_bytes() == whole


@pytest.mark.parametrize("line", ["not json", "[]", '{"run": "r"}', '{"kind": "lunch"}'])
def test_a_damaged_file_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "ledger.jsonl"
    filled(path)
    lines = path.read_text().splitlines()
    if line.startswith('{"kind"'):
        line = json.dumps(json.loads(lines[2]) | json.loads(line))
    path.write_text("\n".join([*lines[:2], line, *lines[3:]]) + "\n")
    with pytest.raises(UserError, match="line 3"):
        Ledger(path)


def test_a_full_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "ledger.jsonl"
    ledger = filled(path, 4)
    before = path.read_bytes()
    for entry in entries(8)[4:]:
        ledger.record(entry)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            ledger.flush()
    assert path.read_bytes() == before
    ledger.flush()
    assert list(Ledger(path)) == entries(8)


def test_csv(tmp_path: Path) -> None:
    filled(tmp_path / "ledger.jsonl").to_csv(tmp_path / "totals.csv")
    lines = (tmp_path / "totals.csv").read_text().splitlines()
    assert lines[0] == "member,kind,steps,episodes,score"
    assert lines[1] == "1,SP,202,2,6.0" and len(lines) == 5


def test_lost_work_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    ledger = filled(path)
    with pytest.raises(ValueError, match="9 of 8"):
        ledger.cut(9)
    assert ledger.cut(8) == 0 and not (tmp_path / "ledger.lost.jsonl").exists()
    assert ledger.cut(5) == 3 and ledger.cut(5) == 0
    for kept in (ledger, Ledger(path)):
        assert list(kept) == entries(8)[:5] and kept.steps() == sum(range(100, 105))
        assert kept.steps(member=2) == 104 and kept.steps(kind=Kind.XP) == 101 + 103
    assert list(Ledger(tmp_path / "ledger.lost.jsonl")) == entries(8)[5:]
    again = replace(entries(8)[5], steps=7)  # the work is done again, with another outcome
    assert ledger.record(again)
    ledger.flush()
    assert ledger.cut(4) == 2
    lost = (tmp_path / "ledger.lost.jsonl").read_text().splitlines()
    assert [json.loads(line)["steps"] for line in lost] == [105, 106, 107, 104, 7]
