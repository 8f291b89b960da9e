from __future__ import annotations

import json
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from popgen.jsonable import jsonable


def test_numbers_arrays_and_keys_become_plain() -> None:
    value = MappingProxyType({1: np.float32(0.5), "a": (np.int64(2), np.array([[1, 2]])), "path": Path("x") / "y"})
    plain = jsonable(value)
    assert json.loads(json.dumps(plain, allow_nan=False)) == {"1": 0.5, "a": [2, [[1, 2]]], "path": "x/y"}
    assert type(plain["1"]) is float and type(plain["a"][0]) is int


def test_numbers_that_are_not_finite_become_null() -> None:
    values = [float("nan"), np.float32("inf"), np.array([1.0, -np.inf])]
    assert jsonable(values) == [None, None, [1.0, None]]


def test_what_is_plain_stays_and_what_has_no_form_is_left_to_json() -> None:
    value = {"text": "x", "truth": True, "nothing": None, "count": 3}
    assert jsonable(value) == value
    with pytest.raises(TypeError):
        json.dumps(jsonable({"object": object()}))
