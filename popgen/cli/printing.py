"""Results on stdout, and exit codes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from popgen.jsonable import jsonable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from popgen.reports.frames import Sheet

OK, ERROR, WEAK, INTERRUPTED = 0, 2, 3, 130

WIDTH = 80
"""Columns of a plain terminal, which sentences are wrapped at."""


def short(text: str, length: int = 100) -> str:
    """The text, cut to `length` characters."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


def print_json(value: Mapping[str, Any]) -> None:
    """Exactly one JSON object; numbers that are not finite become null."""
    print(json.dumps(jsonable(value), allow_nan=False))


def print_table(table: Any, width: int | None = None) -> None:
    """One of rich's, `width` columns wide: by default the terminal's."""
    console = _open_console(width)
    with console.capture() as captured:  # rich ends the process where the reader went away
        console.print(table)
    print(captured.get(), end="")


def _open_console(width: int | None) -> Console:
    from rich.console import Console

    # Piped output has no width of its own; tables of many members must not be cut.
    return Console(width=width or (None if sys.stdout.isatty() else 200))


def print_sheet(sheet: Sheet, width: int | None = None) -> None:
    """As one table, or as several below each other where its figures would be cut."""
    room = _open_console(width).width
    for part in sheet.split(room):
        print_table(part.to_rich(room), width)


def print_report(
    tables: Iterable[Sheet | Table], lines: Iterable[str], out: str, files: Iterable[str], width: int | None = None
) -> None:
    """Tables, sentences of WIDTH columns, and where the report's files are.

    Args:
        tables: `width` columns wide, by default as wide as the terminal.
        lines: sentences.
        out: folder of the report.
        files: their names.
    """
    from rich.table import Table

    for table in tables:
        if isinstance(table, Table):
            print_table(table, width)
        else:
            print_sheet(table, width)
    told = [*lines, f"report: {out} ({', '.join(files)})"]
    print("\n".join(part for line in told for part in wrap_line(line)))


def wrap_line(line: str) -> list[str]:
    """A sentence as lines of at most WIDTH columns; paths and options stay whole."""
    return wrap(line, WIDTH, break_long_words=False, break_on_hyphens=False)


def tell_unfinished(populations: Iterable[str]) -> None:
    """A note for each population whose run has not finished: what is said of it is said of the members so far.

    Args:
        populations: PATH or PATH:1,3; what is no folder is passed over.
    """
    from popgen.population.chosen_members import split_members
    from popgen.runs.directory import describe_unfinished

    paths = dict.fromkeys(Path(split_members(text)[0]) for text in populations)
    tell_notes(told for path in paths if (told := describe_unfinished(path)) is not None)


def tell_notes(notes: Iterable[str]) -> None:
    """Lines for the user on stderr, which stay beside results on stdout."""
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
