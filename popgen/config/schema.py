"""What all schemas are made of: the base class and number types with ranges."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def _a_number(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise ValueError("should be a number")
    return value


_Int = Annotated[int, BeforeValidator(_a_number)]
_Float = Annotated[float, BeforeValidator(_a_number), Field(allow_inf_nan=False)]
Positive = Annotated[_Int, Field(ge=1, le=10**12)]
NonNegative = Annotated[_Int, Field(ge=0, le=10**12)]
Layers = Annotated[_Int, Field(ge=1, le=64)]
Width = Annotated[_Int, Field(ge=1, le=16_384)]  # of a layer
Batch = Annotated[_Int, Field(ge=1, le=100_000)]  # what is held in memory or stepped at once
Number = Annotated[_Float, Field(ge=-1e12, le=1e12)]
Rate = Annotated[_Float, Field(gt=0.0, le=1.0)]
Fraction = Annotated[_Float, Field(ge=0.0, le=1.0)]
Weight = Annotated[_Float, Field(ge=0.0, le=1e9)]
UniformShare = Annotated[_Float, Field(ge=1e-6, le=1.0)]  # mixed into probabilities, whose logarithms are taken
Text = Annotated[str, BeforeValidator(lambda value: str(value) if type(value) is int else value)]


class AddedLater:
    """Marks a field that earlier versions did not have: at its default it is left out of digests, so that a run which
    does not use it is the run that it was."""


class Schema(BaseModel):
    """Immutable, no unknown keys, no silent conversion of text to numbers.

    The sentence below a field, a string of its own, is the field's description: `popgen config` shows it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False, use_attribute_docstrings=True)
