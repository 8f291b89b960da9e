"""The bars of the house that are reached: see `python tests/house/figures.py`."""

from __future__ import annotations

from pathlib import Path

import pytest

from house.figures import BARS, ROOT, Bar, find_import_cycles, find_late_attributes, judge, measure_short_helpers
from house.round_files import MOST, find_round_files

OPEN: set[str] = set()
"""Bars that are not reached yet; a name leaves this list for good."""


@pytest.mark.parametrize("bar", [bar for bar in BARS if bar.name not in OPEN], ids=lambda bar: bar.name)
def test_the_bar_holds(bar: Bar) -> None:
    figure, lines = judge(bar, ROOT)
    assert figure <= bar.most, "\n".join([f"{figure:g}, at most {bar.most:g}", *lines])


@pytest.mark.end_to_end
def test_a_round_of_a_later_member_goes_through_few_files() -> None:
    """`python tests/house/round_files.py` prints them."""
    files = find_round_files()
    assert len(files) <= MOST, "\n".join(files)
    assert any("xpm_wm/train.py" in line for line in files)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Two modules of a small package that break three rules."""
    folder = tmp_path / "popgen"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "first.py").write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from popgen.second import Two\n"
        "class One:\n    def __init__(self):\n        self.a = 1\n    def later(self):\n        self.a, self.b = 2, 3\n"
        "class Child(One):\n    def _act(self):\n        self.a = 2\n        self.c = 1\n"
    )
    (folder / "second.py").write_text("def _read_all(): ...\ndef f():\n    from .first import One\nclass Two: ...\n")
    return tmp_path


def test_a_late_attribute_is_seen_also_in_a_tuple_and_in_a_child(tree: Path) -> None:
    names = [line.partition(" ")[2] for line in find_late_attributes(tree)]
    assert names == ["One.b in later", "Child.c in _act"]


def test_a_cycle_is_seen_through_type_checking_and_functions(tree: Path) -> None:
    assert find_import_cycles(tree) == ["popgen.first <-> popgen.second"]


def test_short_helpers_are_private_names_of_one_word(tree: Path) -> None:
    share = measure_short_helpers(tree)
    assert share.total == 5 and [line.rpartition(" ")[2] for line in share.lines] == ["_act"]
