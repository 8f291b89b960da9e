"""What other installed distributions offer by entry points; docs/adding.md says how."""

from __future__ import annotations

from collections.abc import Container
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from popgen.errors import UserError

T = TypeVar("T")


def find_entries(group: str, taken: Container[str]) -> dict[str, EntryPoint]:
    """Entry points of a group by name; a name that is `taken` cannot be offered."""
    return {entry.name: entry for entry in entry_points(group=group) if entry.name not in taken}


def load_record(entry: EntryPoint, kind: type[T], field: str) -> T:
    """The record of type `kind` behind an entry point; its attribute `name` is the entry's.

    Raises:
        UserError: on `field`, the package cannot be imported, or offers something else.
    """
    try:
        record = entry.load()
    except Exception as error:  # whatever a package of others raises when it is imported
        problem = f"{entry.name} ({entry.value}) cannot be imported: {error}"
        raise UserError(field, problem, "repair its package") from None
    if not isinstance(record, kind) or getattr(record, "name", None) != entry.name:
        problem = f"{entry.value} is no {kind.__module__}.{kind.__qualname__} with the name {entry.name!r}"
        raise UserError(field, problem, "repair its package")
    return record
