"""Documents say what is there: paths, links between pages, commands; one width of prose."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from conftest import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
NAMES = ("METHOD", "NAME", "FAMILY", "VARIANT", "LAYOUT", "alcove")  # what the reader of docs/adding.md replaces
WIDTH = 100
pytestmark = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())


def test_named_files_are_there(page: Path) -> None:
    named = set(re.findall(r"`((?:popgen|actors|pipelines|conf|tests|docker|docs)/[\w./-]*)`", page.read_text()))
    missing = {name for name in named if not (ROOT / name).exists() and not any(word in name for word in NAMES)}
    assert not missing, sorted(missing)


def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    local = [target.partition("#")[0] for target in targets if "://" not in target]
    missing = [name for name in local if name and not (page.parent / name).exists()]
    assert not missing, missing


def test_commands_have_options_that_exist(page: Path) -> None:
    from popgen.cli.compose import group_options

    for line in re.findall(r"^ *(?:\$ )?popgen run (.*)$", page.read_text(), re.MULTILINE):
        words = shlex.split(line.partition("#")[0].rstrip("\\ "))
        for group, option in (
            word.split("=", 1) for word in words if re.match(r"(env|method|cluster|tracking)=", word)
        ):
            assert option in group_options(group) or any(name in option for name in NAMES), f"{group}={option}"


def test_prose_has_one_width(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    lines = [line for line in text.splitlines() if not line.startswith(("|", "    ", "!", "#", "`"))]
    wide = [line for line in lines if len(line) > WIDTH and " " in line.lstrip("-* ")[:WIDTH] and "](" not in line]
    assert not wide, "\n".join(wide)
