from __future__ import annotations

import os
import subprocess
import sys

import pytest
from conftest import ROOT

from popgen.envs.overcooked import compiled_kernel

PROGRAM = """
from numba.core import caching

caching.CacheImpl._locator_classes = []  # as where neither the code nor a home can be written to
from popgen.envs import make_env

env = make_env("overcooked/cramped_room")
print(env.observe().shape[:2], env.kitchen is not None)
"""


def test_without_a_place_to_keep_it_code_is_compiled_anew() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "HOME": "/nonexistent"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.stdout == "(1, 2) True\n", done.stderr


def test_another_error_of_numba_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> object:
        raise RuntimeError("something else")

    monkeypatch.setattr(compiled_kernel, "njit", refuse)
    with pytest.raises(RuntimeError, match="something else"):
        compiled_kernel.compile_kernel(test_another_error_of_numba_is_not_hidden)
