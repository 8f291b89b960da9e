"""Iteration checkpoints on disk: which are kept, and what counts after damage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.small import kitchen, random_play

from popgen.durable_files import save_state
from popgen.errors import UserError
from popgen.runs.checkpoints import Checkpoints, member_folder


def whole_buffers() -> dict[str, Any]:
    return {"replay_sp": {"rows": np.arange(3)}}


def run_of(root: Path, saves: int, long: int = 10**6) -> Checkpoints:
    """A member's checkpoints after `saves` iterations of one segment each."""
    checkpoints = Checkpoints(root, long=long)
    checkpoints.begin(None)
    segments = random_play(kitchen(2), 5)
    for number in range(saves):
        checkpoints.keep(segments, owner=1)
        checkpoints.save(1, {"iteration": number, "weights": np.full(4, number), "ledger": number}, whole_buffers)
    return checkpoints


def names(root: Path) -> set[str]:
    return {path.name for path in (root / "checkpoints").iterdir()}


def turn_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


def test_the_last_two_are_kept_with_what_they_need(tmp_path: Path) -> None:
    run_of(tmp_path, 4)
    segments = {f"segments_{number:06d}" for number in range(4)}
    assert names(tmp_path) == {"progress_000003", "progress_000004"} | segments
    run_of(tmp_path, 4, long=20)  # each segment has ten rows: every second save writes the buffers
    kept = {"progress_000003", "progress_000004", "base_000002", "base_000004", "segments_000002", "segments_000003"}
    assert names(tmp_path) == kept


@pytest.mark.parametrize("file", ["arrays.safetensors", "values.json"])
def test_the_one_before_counts_if_the_newest_is_damaged(tmp_path: Path, file: str) -> None:
    run_of(tmp_path, 3)
    turn_a_bit(tmp_path / "checkpoints" / "progress_000003" / file)
    again = Checkpoints(tmp_path, long=10**6)
    state = again.load(1)
    assert state is not None and state["iteration"] == 1 and again.count == 2 and len(list(again.log())) == 2
    assert "progress_000003" in again.note and "\n" not in again.note
    again.keep(random_play(kitchen(2), 5), owner=1)
    again.save(1, {"iteration": 2, "ledger": 2}, whole_buffers)
    fresh = Checkpoints(tmp_path, long=10**6)
    assert fresh.load(1)["iteration"] == 2 and not fresh.note  # type: ignore[index]
    assert {"progress_000002", "progress_000003"} <= names(tmp_path)


def test_one_line_if_all_are_damaged(tmp_path: Path) -> None:
    run_of(tmp_path, 3)
    for number in (2, 3):
        turn_a_bit(tmp_path / "checkpoints" / f"progress_{number:06d}" / "arrays.safetensors")
    with pytest.raises(UserError, match="progress_000003") as caught:
        Checkpoints(tmp_path, long=10**6).load(1)
    assert "\n" not in str(caught.value)


def test_damaged_segments_are_noticed(tmp_path: Path) -> None:
    run_of(tmp_path, 2)
    turn_a_bit(tmp_path / "checkpoints" / "segments_000001")
    again = Checkpoints(tmp_path, long=10**6)
    again.load(1)
    with pytest.raises(UserError, match="segments_000001: unreadable"):
        list(again.log())


def test_another_member_begins_anew(tmp_path: Path) -> None:
    checkpoints = run_of(tmp_path, 2)
    assert Checkpoints(tmp_path, long=10**6).load(2) is None
    folder = member_folder(tmp_path, 1)
    save_state(folder, whole_buffers())
    checkpoints.begin(folder)
    assert names(tmp_path) == {"member_001"} and checkpoints.base == "member_001"
    moved = tmp_path.with_name(tmp_path.name + "_moved")
    tmp_path.rename(moved)
    try:
        checkpoints.folder = moved / "checkpoints"
        assert checkpoints.replays() is not None  # a run's folder may go on elsewhere
    finally:
        moved.rename(tmp_path)


def test_a_base_of_another_run_is_found_where_that_is(tmp_path: Path) -> None:
    save_state(member_folder(tmp_path / "other", 1), whole_buffers())
    checkpoints = run_of(tmp_path / "own", 1)
    checkpoints.begin(member_folder(tmp_path / "other", 1))
    assert checkpoints.replays() is not None and Path(str(checkpoints.base)).is_absolute()
