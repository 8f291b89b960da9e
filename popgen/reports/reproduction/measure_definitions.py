"""What the measures of `popgen reproduce` mean, as numbers that go up where a meaning changes.

Figures are kept with the text of their meaning. Those of another text are not taken for today's: they are measured
anew, or left out where the run is gone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from popgen.methods.registry import METHODS
from popgen.reports.method_titles import name_of

FIRST = "1"
"""The meaning of figures that were kept before their meaning was."""

DEFINITIONS = {"diversity": 2, "acting": 2}
"""Name of a measure -> number of its meaning, where that has changed; it is 1 elsewhere."""

PAIRED = {"scores": 2, "curves": 2, "first": 2, "held": 2, "sabotage": 2, "conventions": 2}
"""The same where members were trained in pairs: they used to play with themselves."""

COMPARED = ("diversity", "acting")
"""Measures that depend on the smallest population that is compared."""


def define_measure(name: str, method: str = "", common: int = 0) -> str:
    """What the figures of a measure mean: those of another text are not comparable with it.

    Args:
        name: of the measure.
        method: of the population that is measured; "" for an ego.
        common: members of the smallest population that it is compared with, 0 where it is compared with none.
    """
    return f"{_number_of(name, method)}, of {common}" if name in COMPARED else str(_number_of(name, method))


def is_outdated(run: Mapping[str, Any], name: str) -> bool:
    """Whether a run of a record has figures of a measure that mean something else than today's."""
    text = run.get("definitions", {}).get(name, FIRST)
    return int(text.partition(",")[0]) < _number_of(name, name_of(run["method"]))


def _number_of(name: str, method: str) -> int:
    """Methods whose members come in twos train them in pairs."""
    paired = method in METHODS and METHODS[method].multiple == 2
    return max(DEFINITIONS.get(name, 1), PAIRED.get(name, 1) if paired else 1)
