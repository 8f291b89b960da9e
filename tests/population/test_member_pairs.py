"""Who is whose mate, from members' records."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from popgen.population.member_pairs import find_mates, match_pairs, read_mates, read_pair

EXTRAS: list[dict[str, Any]] = [
    {"role": "biased", "pair": 3},
    {"role": "partner", "pair": 3},
    {"role": "confederate", "pair": 12},
    {},
    {"role": "partner", "pair": 12},
    {"role": "biased", "pair": 9},
]


def test_a_pair_is_a_number_beside_a_role() -> None:
    assert [read_pair(extra) for extra in EXTRAS] == [3, 3, 12, 0, 12, 9]
    assert read_pair({"pair": 3}) == read_pair({"pair": True, "role": "biased"}) == read_pair({"pair": "3"}) == 0


def test_mates_are_the_others_of_their_pairs() -> None:
    members: list[Any] = [type("Info", (), {"extra": extra})() for extra in EXTRAS]
    assert find_mates(members) == (2, 1, 5, 4, 3, 6), "nobody else is of pair 9"
    assert match_pairs([("a", 1), ("b", 1), None, ("a", 1), None]) == (3, 1, 2, 0, 4)
    assert find_mates([]) == ()


def test_mates_are_read_from_the_records_alone(tmp_path: Path) -> None:
    for number, extra in enumerate(EXTRAS, start=1):
        folder = tmp_path / f"member_{number:03d}"
        folder.mkdir()
        (folder / "member.json").write_text(json.dumps({"id": number, "extra": extra}))
    assert read_mates(tmp_path) == (2, 1, 5, 4, 3, 6) and read_mates(tmp_path / "nowhere") == ()
