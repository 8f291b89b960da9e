"""What the README and the pages print: fenced blocks, their commands, and files that the reader is to write."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "CONTRIBUTING.md"]
LANGUAGES = {"sh", "python", "text", "yaml", "toml"}
_FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
_NAMED = re.compile(r"^# this file: (\S+)$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; `line` is that of its fence."""

    page: str
    line: int
    language: str
    text: str

    @property
    def file(self) -> str | None:
        """Where the reader is to write it."""
        found = _NAMED.search(self.text)
        return found[1] if found else None

    def list_commands(self) -> list[str]:
        """Commands of a shell's block as they are printed, continued lines joined, without comments."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [shown for line in lines if (shown := re.sub(r"\s+#\s.*$", "", line).strip())]


def read_blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    name = page.relative_to(ROOT).as_posix()
    return [Block(name, text[: found.start()].count("\n") + 1, found[2], found[3]) for found in _FENCE.finditer(text)]


def list_blocks() -> list[Block]:
    """Of all pages: the README first."""
    return [block for page in PAGES for block in read_blocks(page)]


def list_inline_commands(page: Path) -> list[str]:
    """`popgen ...` in running text."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    return [" ".join(span.split()) for span in re.findall(r"`(popgen [^`]+)`", text)]


def split_words(command: str) -> list[str]:
    """As a shell does, without expansions."""
    return shlex.split(command, comments=True)
