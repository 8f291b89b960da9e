"""The writer of checkpoints: handles are resolved where files are written, and what is large is read behind handles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.small import kitchen, random_play

from popgen.durable_files import load_state
from popgen.methods.training import Ready, Segments
from popgen.methods.xpm_wm.world_model import Starts
from popgen.runs.checkpoints import CheckpointFiles, resolve_handles
from popgen.types import Kind


def files(root: Path, long: int = 1000) -> CheckpointFiles:
    return CheckpointFiles(root, long=long, seconds=0.0)


def played(sequence: int) -> Segments:
    """Ten steps of three environments: random play, and the same as cross-play."""
    (random,) = random_play(kitchen(3), 10)
    cross = replace(random, kind=Kind.XP, members=(1, 2), sequence=sequence + 1)
    return {Kind.RANDOM: Ready([replace(random, sequence=sequence)]), Kind.XP: Ready([cross])}


def test_handles_are_resolved_however_deep_and_records_become_dictionaries() -> None:
    starts = Starts(*(np.full(2, float(column)) for column in range(4)))
    state = resolve_handles({"a": Ready({"b": [Ready(1), Ready(Ready(2))]}), "starts": Ready(starts), "n": None})
    assert state["a"] == {"b": [1, 2]} and state["n"] is None
    assert set(state["starts"]) == {"h", "z", "pool", "partner"} and state["starts"]["z"].tolist() == [1.0, 1.0]


def test_a_checkpoint_is_read_as_it_was_written(tmp_path: Path) -> None:
    checkpoints = files(tmp_path)
    checkpoints.begin(None)
    for call in range(2):
        checkpoints.append(played(2 * call), owner=2)
    checkpoints.save(2, {"weights": Ready({"w": np.arange(3.0)}), "ledger": 4}, None)
    checkpoints.append(played(4), owner=2)  # after the checkpoint: not of it
    checkpoint = files(tmp_path).load(2)
    assert checkpoint is not None and checkpoint.buffers is None and checkpoint.state["ledger"] == 4
    assert checkpoint.state["weights"]["w"].tolist() == [0.0, 1.0, 2.0]
    log = list(checkpoint.log)
    assert [owner for _, owner in log] == [2, 2] and all(set(part) == {Kind.RANDOM, Kind.XP} for part, _ in log)
    assert [[s.sequence for part in parts.values() for s in part.result()] for parts, _ in log] == [[0, 1], [2, 3]]
    assert files(tmp_path).load(3) is None


def test_a_long_log_asks_for_a_whole_copy_which_the_next_checkpoint_starts_from(tmp_path: Path) -> None:
    checkpoints = files(tmp_path, long=100)
    checkpoints.begin(None)
    asked = []
    for call in range(3):
        checkpoints.append(played(2 * call), owner=1)  # 60 rows each
        asked.append(checkpoints.log_is_long)
        buffers = {"replay": Ready({"rows": np.arange(call)})} if checkpoints.log_is_long else None
        checkpoints.save(1, {"ledger": call}, buffers)
    assert asked == [False, True, False]
    checkpoint = files(tmp_path).load(1)
    assert checkpoint is not None and checkpoint.buffers is not None
    assert checkpoint.buffers["replay"].result()["rows"].tolist() == [0]
    assert len(list(checkpoint.log)) == 1


def test_a_finished_member_leaves_its_large_parts_behind_handles(tmp_path: Path) -> None:
    files(tmp_path).save_member(1, {"model": Ready({"w": np.ones(2)}), "ledger": 7})
    left = files(tmp_path).load_member(tmp_path, 1)
    assert left["ledger"] == 7 and left["model"].result()["w"].tolist() == [1.0, 1.0]
    assert load_state(tmp_path / "checkpoints" / "member_001")["ledger"] == 7


def test_a_checkpoint_waits_for_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoints = CheckpointFiles(tmp_path, long=10, seconds=5.0)
    now = checkpoints.last
    monkeypatch.setattr("popgen.runs.checkpoints.time.monotonic", lambda: now + 4.9)
    assert not checkpoints.due()
    monkeypatch.setattr("popgen.runs.checkpoints.time.monotonic", lambda: now + 5.0)
    assert checkpoints.due()
