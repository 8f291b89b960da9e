"""Results on stdout, and exit codes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from textwrap import wrap
from typing import Any

from popgen.jsonable import jsonable

OK, ERROR, WEAK, INTERRUPTED = 0, 2, 3, 130


def short(text: str, length: int = 100) -> str:
    """The text, cut to `length` characters."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


def print_json(value: Mapping[str, Any]) -> None:
    """Exactly one JSON object; numbers that are not finite become null."""
    print(json.dumps(jsonable(value), allow_nan=False))


def print_table(table: Any, width: int | None = None) -> None:
    """One of rich's, `width` columns wide: by default the terminal's."""
    from rich.console import Console

    # Piped output has no width of its own; tables of many members must not be cut.
    console = Console(width=width or (None if sys.stdout.isatty() else 200))
    with console.capture() as captured:  # rich ends the process where the reader went away
        console.print(table)
    print(captured.get(), end="")


def print_report(
    tables: Iterable[Any], lines: Iterable[str], out: str, files: Iterable[str], width: int | None = None
) -> None:
    """Tables, sentences, and where the report's files are."""
    for table in tables:
        print_table(table, width)
    told = [part for line in lines for part in (wrap(line, width) if width else [line])]
    print("\n".join([*told, f"report: {out} ({', '.join(files)})"]))
