"""Compiled functions, kept on disk where there is a place for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit as numba_njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])
njit = cast("Callable[..., Callable[[Any], Any]]", numba_njit)  # numba's stubs do not know `_nrt`


def compile_helper(function: Kernel) -> Kernel:
    """What kernels call. They allocate nothing, hence no counted references (`_nrt`): with these, at every call of a
    helper, encoding was six times slower."""
    return njit(_nrt=False)(function)


def compile_kernel(function: Kernel) -> Kernel:
    """numba's `njit` without counted references (`_nrt`), its machine code kept on disk for the next process.

    Without a place to keep it (neither the code's folder, nor a home, nor NUMBA_CACHE_DIR can be written to) each
    process compiles anew, which takes seconds. A folder that others can write to is no place: what is kept is executed.
    """
    try:
        return njit(cache=True, _nrt=False)(function)
    except RuntimeError as error:
        if "locator" not in str(error):
            raise
        return njit(_nrt=False)(function)
