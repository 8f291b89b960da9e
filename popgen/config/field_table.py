"""The fields of a schema as they are shown: default, range and meaning of each."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MultipleOf
from pydantic import BaseModel
from pydantic.fields import FieldInfo

LARGE = 10**9
"""Bounds from here on are there to keep arithmetic safe, and say nothing to a reader."""


@dataclass(frozen=True)
class FieldDescription:
    """A field that holds a value.

    Attributes:
        name: dotted.
        default: of the schema, JSON-able.
        range: the values it takes, as `[0, 1]`, `>= 1` or `sync | async`; "" where any text will do.
        meaning: the schema's sentence.
    """

    name: str
    default: Any
    range: str
    meaning: str


def describe_fields(schema: type[BaseModel]) -> list[FieldDescription]:
    """All fields of a schema, those of sections by their dotted names."""
    return list(_iterate_fields(schema, schema.model_validate({}).model_dump(mode="json"), ""))


def _iterate_fields(schema: type[BaseModel], defaults: Mapping[str, Any], prefix: str) -> Iterator[FieldDescription]:
    for name, info in schema.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            yield from _iterate_fields(info.annotation, defaults[name], f"{prefix}{name}.")
        else:
            values = range_text(info.annotation, info.metadata)
            yield FieldDescription(prefix + name, defaults[name], values, " ".join((info.description or "").split()))


def range_text(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """What a field takes, from its type and what is annotated on it."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return range_text(parts[0], [*_unfold_fields(parts[1:]), *metadata])
    if origin is Literal:
        return " | ".join(str(value) for value in parts)
    if origin in (Union, types.UnionType):
        texts = ("null" if part is type(None) else range_text(part) or "text" for part in parts)
        return " | ".join(texts)
    if origin in (tuple, list):
        inner = range_text(parts[0])
        return f"list of {inner}" if inner else "list"
    if annotation is bool:
        return "true | false"
    return _bounds_text(metadata) if annotation in (int, float) else ""


def _unfold_fields(metadata: Sequence[Any]) -> list[Any]:
    """Bounds stand in a `Field(...)` of their own within nested annotations."""
    parts = ((entry.metadata if isinstance(entry, FieldInfo) else [entry]) for entry in metadata)
    return [entry for part in parts for entry in part]


def _bounds_text(metadata: Sequence[Any]) -> str:
    """`[0, 1]`, or `>= 0` where the other bound is large."""
    low, high, step = "", "", ""
    for entry in metadata:
        match entry:
            case Ge(ge=bound) | Gt(gt=bound) if abs(bound) < LARGE:  # type: ignore[operator]
                low = f"{'[' if isinstance(entry, Ge) else '('}{_short_number(bound)}"
            case Le(le=bound) | Lt(lt=bound) if abs(bound) < LARGE:  # type: ignore[operator]
                high = f"{_short_number(bound)}{']' if isinstance(entry, Le) else ')'}"
            case MultipleOf(multiple_of=number):
                step = f", a multiple of {number}"
    if low and high:
        return f"{low}, {high}{step}"
    signs = {"[": ">= ", "(": "> ", "]": "<= ", ")": "< "}
    if low:
        return f"{signs[low[0]]}{low[1:]}{step}"
    return f"{signs[high[-1]]}{high[:-1]}{step}" if high else f"any number{step}"


def _short_number(bound: Any) -> str:
    return str(int(bound)) if bound == int(bound) else f"{bound:g}"
