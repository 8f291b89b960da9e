"""Legend of the dimensions in every docstring, and the assert that holds them at module borders.

B batch            T time               P players (2)        E events per player
S state numbers    F features of a view A actions            M members
D deterministic    G latent groups      C classes of a group L length of a replay window
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def check(array: Any, shape: Sequence[int | None], name: str) -> None:
    """Raise ValueError unless `array.shape` equals `shape` (None matches any size)."""
    got = tuple(array.shape)
    if len(got) != len(shape) or any(want is not None and want != have for want, have in zip(shape, got, strict=True)):
        raise ValueError(f"{name}: expected shape {tuple(shape)}, got {got}")
