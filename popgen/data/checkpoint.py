"""Nested state (dictionaries of arrays and plain values) as one safetensors and one JSON file; never pickled."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save

from popgen.errors import UserError

ARRAYS, VALUES = "arrays.safetensors", "values.json"


def save_state(folder: str | Path, state: dict[str, Any]) -> None:
    """Write `state` so that `load_state` finds either the old contents or the new, whatever interrupts it.

    Raises:
        OSError: it cannot be written, the disk being full for one; the old contents are there.
    """
    folder = Path(folder)
    fresh = folder.with_name(folder.name + ".writing")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    arrays: dict[str, np.ndarray] = {}
    values = _split(state, "", arrays)
    try:
        # Not safetensors' own writer, whose errors tell nothing of the disk.
        for name, data in ((ARRAYS, save(arrays)), (VALUES, json.dumps(values).encode())):
            with open(fresh / name, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
    except OSError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    old = _old(folder)
    if folder.exists():
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    fresh.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


def load_state(folder: str | Path) -> dict[str, Any]:
    """Read what `save_state` wrote.

    Raises:
        UserError: missing or damaged files.
    """
    folder = Path(folder)
    whole = folder if folder.exists() else _old(folder)
    try:
        arrays = load_file(str(whole / ARRAYS))
        state = _merge(json.loads((whole / VALUES).read_text()), arrays)
        if not isinstance(state, dict):
            raise ValueError(f"{VALUES} holds no dictionary")
        return state
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(str(folder), f"unreadable checkpoint ({error})", "remove it or start a new run") from None
    except Exception as error:  # safetensors raises its own type, which it does not export in all versions
        if type(error).__module__.startswith("safetensors"):
            raise UserError(str(folder), f"damaged checkpoint ({error})", "remove it or start a new run") from None
        raise


def _old(folder: Path) -> Path:
    """Where the old contents are for the moment between the two renames of `save_state`."""
    return folder.with_name(folder.name + ".old")


def _split(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        arrays[path] = np.asarray(value, order="C")
        return {"__array__": path}
    if isinstance(value, dict):
        return {str(key): _split(item, f"{path}/{key}", arrays) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_split(item, f"{path}/{index}", arrays) for index, item in enumerate(value)]
    return value


def _merge(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        if set(value) == {"__array__"}:
            return arrays[value["__array__"]]
        return {key: _merge(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_merge(item, arrays) for item in value]
    return value
