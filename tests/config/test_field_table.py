from __future__ import annotations

from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, StrictBool

from popgen.config.field_table import describe_fields, range_text
from popgen.config.run_config import field_names
from popgen.config.schema import Fraction, NonNegative, Positive, Rate, Schema, Weight, _Int
from popgen.methods.registry import METHODS


class Inner(Schema):
    """A section."""

    share: Fraction = 0.5
    """Of the whole."""


class Outer(Schema):
    """A schema with every kind of range."""

    inner: Inner = Inner(share=0.25)
    """A section."""
    name: str = "x"
    """Any text."""


RANGES: list[tuple[Any, str]] = [
    (Fraction, "[0, 1]"),
    (Rate, "(0, 1]"),
    (Weight, ">= 0"),
    (Positive, ">= 1"),
    (NonNegative, ">= 0"),
    (StrictBool, "true | false"),
    (str, ""),
    (str | None, "text | null"),
    (Positive | None, ">= 1 | null"),
    (Literal["sync", "async"], "sync | async"),
    (tuple[Fraction, ...], "list of [0, 1]"),
    (Annotated[_Int, Field(ge=2, le=100, multiple_of=2)], "[2, 100], a multiple of 2"),
    (dict[str, Any], ""),
]


@pytest.mark.parametrize(("annotation", "text"), RANGES, ids=[text or "anything" for _, text in RANGES])
def test_ranges_are_read_from_the_types(annotation: Any, text: str) -> None:
    assert range_text(annotation) == text


def test_fields_of_sections_have_dotted_names_the_outer_schemas_default_and_their_sentence() -> None:
    found = describe_fields(Outer)
    assert [(field.name, field.default, field.meaning) for field in found] == [
        ("inner.share", 0.25, "Of the whole."),
        ("name", "x", "Any text."),
    ]


@pytest.mark.parametrize("method", METHODS)
def test_every_field_of_every_method_is_described_once(method: str) -> None:
    schema = METHODS[method].config
    names = list(field_names(schema))
    leaves = [name for name in names if not any(other.startswith(f"{name}.") for other in names)]
    found = describe_fields(schema)
    assert [field.name for field in found] == leaves
    assert [field.name for field in found if not field.meaning.strip()] == []
