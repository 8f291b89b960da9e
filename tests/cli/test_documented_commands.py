"""Commands as the README and the pages print them are commands that the parser takes, and runs that can be composed."""

from __future__ import annotations

import re
import shlex

import pytest
from conftest import ROOT

from popgen.cli.compose import compose
from popgen.cli.parser import parse
from popgen.config.run_config import RunConfig

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
REPLACED = re.compile(r"METHOD|NAME|FAMILY|VARIANT|LAYOUT|KEY=VALUE|alcove|my_|seed=S|\[|<|\.\.\.|\$|\|")
"""What a reader replaces: such lines are forms, not commands."""


def list_commands() -> list[str]:
    found = []
    for page in PAGES:
        for block in re.findall(r"^```[a-z]*\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                if line.startswith("popgen ") and not REPLACED.search(line.partition("#")[0]):
                    found.append(line.partition("  #")[0].strip())
    return list(dict.fromkeys(found))


def test_there_are_commands() -> None:
    assert len(list_commands()) >= 10


@pytest.mark.parametrize("line", list_commands())
def test_a_command_works_as_printed(line: str) -> None:
    args = parse(shlex.split(line)[1:])
    if args.command.__name__ == "run" and not getattr(args, "origin", None):
        RunConfig.parse(compose(args.overrides))
