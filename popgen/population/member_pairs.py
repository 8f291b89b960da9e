"""Members that were trained in pairs: who is whose mate.

The members of a pair (HSP, BP, BRDiv) learned beside each other and never with themselves. What self-play is to other
members, play with the mate is to them. `pair` and `role` in a member's `extra` tell the pair.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

from popgen.population.manifest import MemberInfo


def read_pair(extra: Mapping[str, Any]) -> int:
    """Number of the pair that a member was trained in, 0 for one that was trained with itself."""
    pair = extra.get("pair", 0)
    return pair if type(pair) is int and "role" in extra else 0


def match_pairs(pairs: Sequence[Hashable]) -> tuple[int, ...]:
    """Place of each one's mate, the first other of the same pair.

    Args:
        pairs: what names the pair of each; whatever is false is nobody's.

    Returns:
        One place for each, from 0; its own where it has no pair, or where nobody else is of it.
    """
    return tuple(
        next((other for other, theirs in enumerate(pairs) if own and theirs == own and other != place), place)
        for place, own in enumerate(pairs)
    )


def find_mates(members: Sequence[MemberInfo]) -> tuple[int, ...]:
    """Number of each member's mate, from 1; its own where it has none among them."""
    return tuple(place + 1 for place in match_pairs([read_pair(info.extra) for info in members]))


def read_mates(folder: Path) -> tuple[int, ...]:
    """`find_mates` of a population's folder, read from its members' records alone.

    Raises:
        OSError, ValueError: a record cannot be read.
    """
    records = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("member_*/member.json"))]
    return tuple(place + 1 for place in match_pairs([read_pair(record.get("extra", {})) for record in records]))
