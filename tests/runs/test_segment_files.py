from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from support.small import kitchen, random_play

from popgen.errors import UserError
from popgen.runs.checkpoints import load_segments, save_segments
from popgen.types import Segment


def test_segments_come_back_as_they_were(tmp_path: Path) -> None:
    segments = random_play(kitchen(3), 25) + random_play(kitchen(2), 7, seed=1)
    save_segments(tmp_path / "s", segments, owner=4)
    loaded, owner = load_segments(tmp_path / "s")
    assert owner == 4 and len(loaded) == 2
    for one, two in zip(segments, loaded, strict=True):
        for field in fields(Segment):
            ours, theirs = getattr(one, field.name), getattr(two, field.name)
            assert np.array_equal(ours, theirs) and type(ours) is type(theirs)
            assert not isinstance(ours, np.ndarray) or ours.dtype == theirs.dtype


@pytest.mark.parametrize("damage", ["cut", "header", "empty", "gone"])
def test_a_damaged_file_is_one_line(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "segments_000003"
    save_segments(path, random_play(kitchen(1), 5), owner=1)
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes({"cut": data[:-9], "header": b"\xff" * 8 + data[8:], "empty": b""}[damage])
    with pytest.raises(UserError, match="segments_000003") as caught:
        load_segments(path)
    assert "\n" not in str(caught.value)
