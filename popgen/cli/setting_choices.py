"""`popgen config --list`: the methods and the presets that there are."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap
from typing import Any

from popgen.cli.compose import group_options
from popgen.methods.registry import list_working

GROUPS = ("env", "cluster", "tracking")
"""Groups whose options are listed by their names alone; scales belong to a method."""


def list_choices(folder: Path | None) -> dict[str, Any]:
    """Keys: methods (name -> title, summary, scales), presets (group -> options, with those of a user's folder)."""
    own = set(group_options("scale", folder)) - set(group_options("scale"))
    methods = {
        name: {"title": method.title, "summary": method.summary, "scales": [*method.recipes, *sorted(own)]}
        for name, method in list_working()
    }
    return {"methods": methods, "presets": {group: group_options(group, folder) for group in GROUPS}}


def describe_choices(choices: dict[str, Any], width: int) -> list[str]:
    """Lines for the terminal: a word of the command line, and below it what it means."""
    lines = []
    for name, one in choices["methods"].items():
        lines += [f"method={name}"]
        told = f"{one['title']}: {one['summary']} scale={'|'.join(one['scales'])}"
        lines += wrap(told, width, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    for group, options in choices["presets"].items():
        lines += ["", f"{group}="]
        lines += wrap(" ".join(options), width, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    return lines
