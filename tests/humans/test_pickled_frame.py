"""The reader of pickled tables: what it reads, and that nothing it is given is ever executed."""

from __future__ import annotations

import builtins
import importlib
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

from popgen.humans.pickled_frame import GLOBALS, FrameError, read_columns
from tests.humans.frames import canary_bytes, dumps, frame_bytes, install_canary

COLUMNS = {
    "number": np.arange(6),
    "share": np.linspace(0.0, 1.0, 6),
    "flag": np.array([True, False] * 3),
    "text": np.array([f"row {i}" for i in range(6)], object),
}


class Trap:
    """Pickles as a call of anything."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.function, self.arguments


def test_a_table_comes_back() -> None:
    columns = read_columns(frame_bytes(COLUMNS))
    assert list(columns) == list(COLUMNS)
    assert all(np.array_equal(columns[name], COLUMNS[name]) for name in COLUMNS)


def test_eight_names_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    monkeypatch.setitem(sys.modules, "popgen_canary", install_canary(calls))
    assert len(GLOBALS) == 8
    traps = [
        Trap(os.system, "echo"),
        Trap(eval, "1"),
        Trap(subprocess.Popen, ["true"]),
        Trap(importlib.import_module, "os"),
    ]
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        for trap in [*traps, {"a": [traps[0]]}]:
            with pytest.raises(FrameError):
                read_columns(pickle.dumps(trap, protocol))
    pickle.loads(canary_bytes())
    assert calls == ["('boo',)"], "the canary does not sing, so that its silence would prove nothing"
    with pytest.raises(FrameError, match="popgen_canary.sing"):
        read_columns(canary_bytes())
    assert len(calls) == 1


def test_ten_thousand_mutations_execute_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes changed, cut out, doubled and swapped, and opcodes of calls of a canary put anywhere."""
    calls: list[str] = []
    monkeypatch.setitem(sys.modules, "popgen_canary", install_canary(calls))
    forbid_execution(monkeypatch, calls)
    whole, canary = bytearray(frame_bytes(COLUMNS)), canary_bytes()[2:-1]
    rng, read = np.random.default_rng(12), 0
    for _ in range(10_000):
        data = mutate(whole, canary, rng)
        try:
            columns = read_columns(bytes(data))
            assert all(isinstance(values, np.ndarray) for values in columns.values())
            read += 1
        except FrameError as error:
            assert str(error) and "\n" not in str(error) and len(str(error)) < 300
    assert not calls
    assert read < 5_000


def forbid_execution(monkeypatch: pytest.MonkeyPatch, calls: list[str]) -> None:
    """Whatever could run something notes that it was called."""

    def note(name: str) -> object:
        return lambda *arguments, **named: calls.append(name)

    for module, name in ((os, "system"), (os, "popen"), (subprocess, "Popen"), (builtins, "eval"), (builtins, "exec")):
        monkeypatch.setattr(module, name, note(name))
    for name in ("loads", "load", "Unpickler"):
        monkeypatch.setattr(pickle, name, note(name))


def mutate(whole: bytearray, canary: bytes, rng: np.random.Generator) -> bytearray:
    """One to four changes."""
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(2, len(data)))
        kind = rng.integers(5)
        if kind == 0:
            data[at] = int(rng.integers(256))
        elif kind == 1:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            del data[at : at + int(rng.integers(1, 20))]
        elif kind == 3:
            data[at:at] = data[at : at + int(rng.integers(1, 20))]
        else:
            data[at:at] = canary
        if len(data) < 4:
            break
    return data


@pytest.mark.parametrize(
    "data",
    (
        b"",
        b"\x80\x04.",
        b"\x80\x04N.N.",
        b"\x80\x04h\x09.",
        b"\x80\x04\x85.",
        b"\x80\x04(((((.",
        b"\x80\x04r\xff\xff\xff\xff.",
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f.",
        dumps([1, 2]),
        dumps({"a": 1}),
        frame_bytes(COLUMNS)[:-200],
    ),
)
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(FrameError):
        read_columns(data)
