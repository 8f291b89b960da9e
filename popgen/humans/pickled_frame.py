"""Columns of a pickled pandas table, read from its opcodes: nothing is imported, called or executed.

The recorded games are pickles of a pandas of 2019, which no current pandas loads and which would run code if they
were not what they claim to be. This reader interprets the few opcodes that such a file has into a tree of plain
values. A class or function is only a name in it, and only the eight names that a table needs are accepted.
"""

from __future__ import annotations

import io
import pickletools
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

GLOBALS = frozenset(
    {
        ("pandas.core.frame", "DataFrame"),
        ("pandas.core.internals.managers", "BlockManager"),
        ("pandas.core.indexes.base", "_new_Index"),
        ("pandas.core.indexes.base", "Index"),
        ("pandas.core.indexes.numeric", "Int64Index"),
        ("numpy.core.multiarray", "_reconstruct"),
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
    }
)
"""Module and name of everything that a table may refer to."""

DTYPES = {"b1": np.dtype(np.bool_), "i8": np.dtype("<i8"), "f8": np.dtype("<f8")}
"""Numbers that columns may hold, by numpy's code; "O8" is text."""

MAX_ENTRIES = 2**24
"""Entries of an array: a damaged shape must not ask for all memory."""


class FrameError(ValueError):
    """The bytes are not such a table."""


@dataclass(frozen=True)
class Name:
    """A class or function of the file, as a name."""

    module: str
    name: str


@dataclass
class Made:
    """What the file would make by calling `maker` with `arguments`, then `state` put into it."""

    maker: Name
    arguments: tuple[Any, ...]
    state: Any = None


_MARK = object()
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_LITERALS = frozenset({"BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES", "BININT", "BININT1", "BININT2"})
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


_ACTIONS = frozenset(
    {
        *("PROTO", "FRAME", "STOP", "MEMOIZE", "BINGET", "LONG_BINGET", "MARK", "TUPLE", "EMPTY_LIST", "EMPTY_DICT"),
        *("APPEND", "APPENDS", "SETITEM", "SETITEMS", "STACK_GLOBAL", "REDUCE", "NEWOBJ", "BUILD"),
    }
)
_OPCODES = {
    ord(opcode.code): opcode
    for opcode in pickletools.opcodes
    if opcode.name in _LITERALS | _ACTIONS | _CONSTANTS.keys() | _TUPLES.keys()
}


def _read_opcodes(data: bytes) -> Iterator[tuple[str, Any]]:
    """(name, argument) of each opcode until the last byte; one that tables do not need is not even decoded."""
    stream = io.BytesIO(data)
    while byte := stream.read(1):
        opcode = _OPCODES.get(byte[0])
        if opcode is None:
            raise FrameError(f"holds opcode {byte[0]}, which a table does not need")
        yield opcode.name, opcode.arg.reader(stream) if opcode.arg is not None else None


class _TreeReader:
    """A stack machine over pickle's opcodes whose every value is plain or a `Made`."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: list[Any] = []

    def read(self, data: bytes) -> Any:
        """The tree; raises FrameError for an opcode that tables do not need, or one that does not fit."""
        ended = False
        for name, argument in _read_opcodes(data):
            if ended:
                raise FrameError("goes on after its end")
            if name == "STOP":
                ended = True
            elif name in _LITERALS:
                self._stack.append(argument)
            elif name in ("BINGET", "LONG_BINGET"):
                if argument >= len(self._memo):
                    raise FrameError("refers to a value that it does not hold")
                self._stack.append(self._memo[argument])
            elif name == "MEMOIZE":
                self._memo.append(self._top())
            elif name not in ("PROTO", "FRAME"):
                self._apply(name)
        if not ended or len(self._stack) != 1:
            raise FrameError("does not end where its value does")
        return self._stack[0]

    def _apply(self, name: str) -> None:
        if name in _CONSTANTS:
            self._stack.append(_CONSTANTS[name])
        elif name in _TUPLES:
            self._stack.append(tuple(self._pop(_TUPLES[name])))
        elif name == "MARK":
            self._stack.append(_MARK)
        elif name == "TUPLE":
            self._stack.append(tuple(self._pop_to_mark()))
        elif name == "EMPTY_LIST":
            self._stack.append([])
        elif name == "EMPTY_DICT":
            self._stack.append({})
        elif name in ("APPEND", "APPENDS"):
            items = self._pop(1) if name == "APPEND" else self._pop_to_mark()
            self._top(list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = self._pop(2) if name == "SETITEM" else self._pop_to_mark()
            self._set_items(items)
        elif name == "STACK_GLOBAL":
            self._stack.append(_accepted(*self._pop(2)))
        elif name in ("REDUCE", "NEWOBJ"):
            self._make(*self._pop(2))
        else:
            assert name == "BUILD"
            (state,) = self._pop(1)
            self._top(Made).state = state

    def _make(self, maker: Any, arguments: Any) -> None:
        if not isinstance(maker, Name) or not isinstance(arguments, tuple):
            raise FrameError("makes something of no known class")
        self._stack.append(Made(maker, arguments))

    def _set_items(self, items: list[Any]) -> None:
        target, keys = self._top(dict), items[::2]
        if len(items) % 2 or not all(isinstance(key, str) for key in keys):
            raise FrameError("holds keys that are not text")
        target.update(zip(keys, items[1::2], strict=True))

    def _top(self, kind: type = object) -> Any:
        if not self._stack or self._stack[-1] is _MARK or not isinstance(self._stack[-1], kind):
            raise FrameError("puts a value where none fits")
        return self._stack[-1]

    def _pop(self, count: int) -> list[Any]:
        items = self._stack[len(self._stack) - count :] if count else []
        if len(items) != count or any(item is _MARK for item in items):
            raise FrameError("takes more values than there are")
        del self._stack[len(self._stack) - count :]
        return items

    def _pop_to_mark(self) -> list[Any]:
        for position in range(len(self._stack) - 1, -1, -1):
            if self._stack[position] is _MARK:
                items = self._stack[position + 1 :]
                del self._stack[position:]
                return items
        raise FrameError("takes more values than there are")


def _accepted(module: Any, name: Any) -> Name:
    if not isinstance(module, str) or not isinstance(name, str) or (module, name) not in GLOBALS:
        shown = " ".join(f"{str(module)[:60]}.{str(name)[:60]}".split())
        raise FrameError(f"refers to {shown}, which no table needs")
    return Name(module, name)


def read_columns(data: bytes) -> dict[str, np.ndarray]:
    """Column name -> values (rows,): bool, int64, float64 or objects that are all text.

    Raises:
        FrameError: the bytes are no pickled table of the known form, in one line.
    """
    try:
        return _to_columns(_TreeReader().read(data))
    except FrameError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, struct.error) as error:
        raise FrameError(f"is damaged ({' '.join(str(error).split())[:120] or type(error).__name__})") from None
    except (RecursionError, MemoryError) as error:
        raise FrameError(f"is damaged ({type(error).__name__})") from None


def _to_columns(frame: Any) -> dict[str, np.ndarray]:
    _expect(frame, "DataFrame")
    manager = frame.state["_data"]
    _expect(manager, "BlockManager")
    axes, blocks, places = manager.state[:3]
    names, rows = _to_index(axes[0]), len(_to_index(axes[1]))
    columns: dict[str, np.ndarray] = {}
    for block, place in zip(blocks, places, strict=True):
        values, block_names = _to_array(block), _to_index(place)
        if values.shape != (len(block_names), rows):
            raise FrameError("holds a block of another size than its columns")
        columns.update(zip((str(name) for name in block_names), values, strict=True))
    if set(columns) != set(names):
        raise FrameError("has columns without values")
    return columns


def _expect(value: Any, name: str) -> None:
    if not isinstance(value, Made) or value.maker.name != name:
        raise FrameError(f"holds no {name} where one belongs")


def _to_index(index: Any) -> np.ndarray:
    _expect(index, "_new_Index")
    return _to_array(index.arguments[1]["data"])


def _to_array(array: Any) -> np.ndarray:
    _expect(array, "_reconstruct")
    _version, shape, dtype, fortran, content = array.state
    _expect(dtype, "dtype")
    code = dtype.arguments[0]
    if not isinstance(shape, tuple) or not all(type(size) is int and size >= 0 for size in shape):
        raise FrameError("holds an array of no shape")
    count = 1
    for size in shape:
        count *= size
    if count > MAX_ENTRIES:
        raise FrameError("holds an array that is too large")
    if code == "O8":
        if not isinstance(content, list) or len(content) != count or not all(type(text) is str for text in content):
            raise FrameError("holds objects that are not text")
        values = np.empty(count, object)
        values[:] = content
    elif code in DTYPES and isinstance(content, bytes) and len(content) == count * DTYPES[code].itemsize:
        values = np.frombuffer(content, DTYPES[code])
    else:
        raise FrameError("holds an array of an unknown kind")
    return values.reshape(shape, order="F" if fortran is True else "C")
