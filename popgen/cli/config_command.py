"""`popgen config`: every setting of a run, what it means, and where its value comes from."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

from popgen.cli.arguments import add_command, add_config_dir
from popgen.cli.compose import Composed, compose_sources
from popgen.cli.preset_files import find_preset_folder
from popgen.cli.printing import OK, WIDTH, print_json
from popgen.errors import UserError
from popgen.methods.recipe import Setting, SourcedSetting

PIPE_WIDTH = 100
"""Columns where the output is no terminal and COLUMNS says nothing."""

GENERAL = "general"
"""Heading of the fields that belong to no section."""


@dataclass(frozen=True)
class FieldRow:
    """A setting as the table shows it.

    Attributes:
        name: dotted.
        value, default: of this run and of the schema, JSON-able.
        range, meaning: from the schema.
        source: schema, recipe NAME, layout row of NAME, preset GROUP=NAME, or command line.
        reason: why the recipe sets it so; "" without one.
        ours: the paper does not give it.
    """

    name: str
    value: Any
    default: Any
    range: str
    meaning: str
    source: str
    reason: str = ""
    ours: bool = False


def add(commands: Any) -> None:
    """`config`."""
    parser = add_command(
        commands,
        "config",
        show_config,
        "every setting: value, range, meaning, and where the value comes from",
        "METHOD stands for method=METHOD; overrides are those of `popgen run`, so that the table shows what the same "
        "words would start. A value comes from the schema (its default), the recipe (scale=), the recipe's row of the "
        "layout (env=), a preset file, or the command line; each of these wins over those before it. Keys of --json: "
        "method, scale, env, fields (name, value, default, range, meaning, source, reason, ours); with --list methods "
        "and presets.",
    )
    parser.add_argument("overrides", nargs="*", metavar="[METHOD] [KEY=VALUE]", help="of which run")
    parser.add_argument("--changed", action="store_true", help="only values that are not the schema's defaults")
    parser.add_argument("--section", default=None, metavar="NAME", help="only this one, such as agent or phase1")
    parser.add_argument("--list", action="store_true", help="the methods and presets that there are, and no table")
    add_config_dir(parser)


def show_config(args: argparse.Namespace) -> int:
    """Print the table, or the same as JSON."""
    from popgen.config.run_config import RunConfig

    if args.list:
        return _list_choices(args)
    words = list(args.overrides)
    if words and "=" not in words[0] and not words[0].startswith("~"):
        words[0] = f"method={words[0]}"
    composed = compose_sources(words, args.config_dir)
    config = RunConfig.parse(composed.values)
    rows = choose_section(list_rows(composed, config.as_dict()), args.section)
    if args.changed:
        rows = [row for row in rows if row.value != row.default]
    head = {"method": config.method, "scale": config.scale, "env": config.env.name}
    if args.json:
        print_json({**head, "fields": [asdict(row) for row in rows]})
    else:
        _print_rows(rows, ", ".join(f"{name}={value}" for name, value in head.items()))
    return OK


def _list_choices(args: argparse.Namespace) -> int:
    from popgen.cli.setting_choices import describe_choices, list_choices

    choices = list_choices(None if args.config_dir is None else find_preset_folder(args.config_dir))
    if args.json:
        print_json(choices)
    else:
        print("\n".join(describe_choices(choices, WIDTH)))
    return OK


def list_rows(composed: Composed, values: Mapping[str, Any]) -> list[FieldRow]:
    """A row for each field of the method's schema; `values` are the checked ones."""
    from popgen.config.field_table import describe_fields

    rows = []
    for field in describe_fields(composed.schema):
        value: Any = values
        for part in field.name.split("."):
            value = value[part]
        found = find_source(field.name, composed)
        told = (found.source, found.setting.reason, found.setting.ours)
        rows.append(FieldRow(field.name, value, field.default, field.range, field.meaning, *told))
    return rows


def find_source(name: str, composed: Composed) -> SourcedSetting:
    """The last of those that set a field; a dictionary's is that of its last entry."""

    def sets(key: str) -> bool:
        return key == name or key.startswith(f"{name}.")

    if any(sets(key) for key in composed.overridden):
        return SourcedSetting(Setting(None), "command line")
    if presets := [preset.option for key, preset in composed.presets.items() if sets(key)]:
        return SourcedSetting(Setting(None), f"preset {presets[-1]}")
    return composed.recipe.get(name, SourcedSetting(Setting(None), "schema"))


def choose_section(rows: list[FieldRow], section: str | None) -> list[FieldRow]:
    """The rows of a section, or all.

    Raises:
        UserError: there is no such section.
    """
    if section is None:
        return rows
    chosen = [row for row in rows if _section_of(row) == section or f"{row.name}.".startswith(f"{section}.")]
    if not chosen:
        names = dict.fromkeys(_section_of(row) for row in rows)
        raise UserError("--section", f"there is no section {section!r}", f"choose one of {', '.join(names)}")
    return chosen


def _section_of(row: FieldRow) -> str:
    return row.name.rpartition(".")[0] or GENERAL


def _print_rows(rows: list[FieldRow], title: str) -> None:
    from rich.console import Console

    width = None if sys.stdout.isatty() else int(os.environ.get("COLUMNS", "") or PIPE_WIDTH)
    console = Console(width=width, highlight=False)
    console.print(title, markup=False)
    for section, group in groupby(rows, key=_section_of):
        console.print(_make_table(section, list(group)))


def _make_table(section: str, rows: list[FieldRow]) -> Any:
    """Name, value, and one below the other: meaning, then range, default and source with its reason."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=section, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("field", no_wrap=True)
    table.add_column("value", overflow="fold", max_width=16)
    table.add_column("meaning / range; default; where the value comes from")
    for row in rows:
        differs = row.value != row.default
        told = Text(row.meaning)
        told.append(f"\n{origin_text(row)}", style="cyan" if differs else "dim")
        table.add_row(row.name.rpartition(".")[2], Text(value_text(row.value), style="bold" if differs else ""), told)
    return table


def origin_text(row: FieldRow) -> str:
    """Range, default where the value is another one, source and reason."""
    parts = [row.range] * bool(row.range)
    parts += [f"default {value_text(row.default)}"] * (row.value != row.default)
    reason = f": {row.reason}" if row.reason else ""
    return "; ".join([*parts, f"{row.source}{reason}{' (not in the paper)' if row.ours else ''}"])


def value_text(value: Any) -> str:
    """As one would write it on the command line."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{','.join(value_text(one) for one in value)}]"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={value_text(one)}" for key, one in value.items()) or "{}"
    if isinstance(value, int | float):
        return f"{value:g}" if isinstance(value, float) and abs(value) < 1e15 else f"{value:,}"
    return str(value)
