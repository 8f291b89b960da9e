from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from popgen import durable_files as checkpoint
from popgen.durable_files import ARRAYS, VALUES, load_state, save_state
from popgen.errors import UserError


def state(seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {
        "replay": {
            "arrays": {"states": rng.integers(0, 255, (7, 3), np.uint8), "first": np.array([True, False])},
            "counters": {"head": 3, "rng": rng.bit_generator.state},
        },
        "model": {"w": rng.normal(size=(2, 4)).astype(np.float32), "empty": np.zeros((0, 5), np.int64)},
        "scalar": np.array(2.5),
        "transposed": rng.normal(size=(3, 4)).T,
        "plain": {"name": "x/y", "none": None, "flag": True, "number": 0.1, "list": [1, [2, "three"]]},
        "seen": [["sampler0", 1], ["sampler1", 2]],
        "arrays in a list": [np.arange(3), {"deep": np.float32([1.5])}],
    }


def same(one: Any, two: Any) -> bool:
    if isinstance(one, dict):
        return isinstance(two, dict) and one.keys() == two.keys() and all(same(one[k], two[k]) for k in one)
    if isinstance(one, list):
        return isinstance(two, list) and len(one) == len(two) and all(same(a, b) for a, b in zip(one, two, strict=True))
    if isinstance(one, np.ndarray):
        return isinstance(two, np.ndarray) and one.dtype == two.dtype and np.array_equal(one, two)
    return type(one) is type(two) and one == two


def test_nested_states_come_back(tmp_path: Path) -> None:
    save_state(tmp_path / "a" / "member_001", state())
    loaded = load_state(tmp_path / "a" / "member_001")
    assert same(loaded, state())
    rng = np.random.default_rng(99)
    rng.bit_generator.state = loaded["replay"]["counters"]["rng"]
    wanted = np.random.default_rng(0)
    wanted.bit_generator.state = state()["replay"]["counters"]["rng"]
    assert rng.random() == wanted.random()


def test_saving_again_replaces(tmp_path: Path) -> None:
    for seed in (0, 1):
        save_state(tmp_path / "c", state(seed))
    assert same(load_state(tmp_path / "c"), state(1)) and not same(state(0), state(1))
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no_such") as caught:
        load_state(tmp_path / "no_such")
    assert "\n" not in str(caught.value)


def damage(folder: Path, how: str) -> None:
    arrays, values = folder / ARRAYS, folder / VALUES
    if how == "cut arrays":
        arrays.write_bytes(arrays.read_bytes()[:-7])
    elif how == "header":
        arrays.write_bytes(b"\xff" * 8 + arrays.read_bytes()[8:])
    elif how == "empty arrays":
        arrays.write_bytes(b"")
    elif how == "no arrays":
        arrays.unlink()
    elif how == "cut values":
        values.write_text(values.read_text()[:-5])
    elif how == "no values":
        values.unlink()
    elif how == "not text":
        values.write_bytes(b"\xff\xfe\x00")
    elif how == "another array":
        values.write_text(values.read_text().replace("replay/arrays/states", "replay/arrays/stakes"))
    elif how == "a list":
        values.write_text(json.dumps([1, 2]))
    elif how == "no digests":
        values.write_text(json.dumps(json.loads(values.read_text())["values"]))
    elif how == "digests of nothing":
        values.write_text(json.dumps(json.loads(values.read_text()) | {"sha256": {}}))
    elif how == "a device":
        arrays.unlink()
        arrays.symlink_to("/dev/zero")


@pytest.mark.parametrize(
    "how",
    [
        *("cut arrays", "header", "empty arrays", "no arrays", "cut values", "no values", "not text", "another array"),
        *("a list", "no digests", "digests of nothing", "a device"),
    ],
)
def test_a_damaged_checkpoint_is_one_line(tmp_path: Path, how: str) -> None:
    folder = tmp_path / "member_001"
    save_state(folder, state())
    damage(folder, how)
    with pytest.raises(UserError, match="member_001") as caught:
        load_state(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fault", ["save", "fsync", "rename"])
def test_an_interrupted_save_leaves_the_old_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    folder = tmp_path / "c"
    save_state(folder, state(0))

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        if fault == "save":
            patch.setattr(checkpoint, "save", fail)
        elif fault == "fsync":
            patch.setattr(os, "fsync", fail)
        else:
            patch.setattr(os, "rename", fail)
        with pytest.raises(OSError, match="No space"):
            save_state(folder, state(1))
    assert same(load_state(folder), state(0))
    save_state(folder, state(1))
    assert same(load_state(folder), state(1)) and [path.name for path in tmp_path.iterdir()] == ["c"]


def test_death_between_the_two_renames_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "c"
    save_state(folder, state(0))
    rename, calls = os.rename, []

    def second_fails(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", second_fails)
        with pytest.raises(KeyboardInterrupt):
            save_state(folder, state(1))
    assert same(load_state(folder), state(0))
    save_state(folder, state(1))
    assert same(load_state(folder), state(1)) and [path.name for path in tmp_path.iterdir()] == ["c"]
