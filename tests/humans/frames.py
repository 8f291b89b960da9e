"""Small tables pickled as the recorded games are: by the names of an old pandas, without pandas."""

from __future__ import annotations

import pickle
import sys
import types
from collections.abc import Mapping
from typing import Any

import numpy as np


class _Node:
    """Pickles as a call of a class that need not exist."""

    def __init__(self, module: str, name: str, arguments: tuple[Any, ...], state: Any = None) -> None:
        self.target, self.arguments, self.state = (module, name), arguments, state


class _Pickler(pickle._Pickler):  # type: ignore[name-defined]  # pure Python: a node is written by opcodes
    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, _Node):
            module, name = obj.target
            self.save(module)
            self.save(name)
            self.write(pickle.STACK_GLOBAL)
            self.save(obj.arguments)
            self.write(pickle.REDUCE)
            if obj.state is not None:
                self.save(obj.state)
                self.write(pickle.BUILD)
            return
        super().save(obj, save_persistent_id)


def dumps(value: Any) -> bytes:
    """Protocol 4 of a tree of nodes and plain values."""
    import io

    stream = io.BytesIO()
    _Pickler(stream, 4).dump(value)
    return stream.getvalue()


def _array(values: np.ndarray) -> _Node:
    code = "O8" if values.dtype == object else values.dtype.str[1:]
    dtype = _Node("numpy", "dtype", (code, 0, 1))
    content = values.reshape(-1).tolist() if values.dtype == object else values.tobytes()
    ndarray = _Node("numpy", "ndarray", ())
    return _Node(
        "numpy.core.multiarray", "_reconstruct", (ndarray, (0,), b"b"), (1, values.shape, dtype, False, content)
    )


def _index(values: np.ndarray) -> _Node:
    index = _Node("pandas.core.indexes.base", "Index", ())
    return _Node("pandas.core.indexes.base", "_new_Index", (index, {"data": _array(values), "name": "x"}))


def frame_bytes(columns: Mapping[str, np.ndarray]) -> bytes:
    """A table with one block for each column."""
    names = np.array(list(columns), object)
    rows = len(next(iter(columns.values())))
    axes = [_index(names), _index(np.arange(rows))]
    blocks = [_array(values[None]) for values in columns.values()]
    places = [_index(np.array([name], object)) for name in columns]
    manager = _Node("pandas.core.internals.managers", "BlockManager", (), (axes, blocks, places, {"0.14.1": {}}))
    return dumps(_Node("pandas.core.frame", "DataFrame", (), {"_data": manager, "_typ": "dataframe"}))


def install_canary(calls: list[str]) -> types.ModuleType:
    """A module `popgen_canary` whose function notes that it was called."""
    module = types.ModuleType("popgen_canary")
    module.sing = lambda *words: calls.append(repr(words))  # type: ignore[attr-defined]
    sys.modules["popgen_canary"] = module
    return module


def canary_bytes() -> bytes:
    """A pickle that would call the canary."""
    return dumps(_Node("popgen_canary", "sing", ("boo",)))
