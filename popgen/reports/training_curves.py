"""Reads `metrics.jsonl`: how members did in training."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from popgen.errors import UserError


@dataclass(frozen=True)
class Point:
    """Real play of a member in training: own environment steps so far, self-play, and its strongest cross-play.

    `xp` is None where the member had no partner, or none was played yet. `simulated` are its steps so far in an exact
    simulator used as dynamics model.
    """

    step: int
    sp: float
    xp: float | None
    simulated: int = 0


def read_curves(path: Path) -> dict[int, tuple[Point, ...]]:
    """Real play during training by member, from metrics.jsonl; empty where there is no such file.

    A point's cross-play, the strongest partner's, is the latest that was measured. Steps only grow: a resumed run
    repeats points, and the last ones count.

    Raises:
        UserError: the file holds something else.
    """
    if not path.exists():
        return {}
    curves: dict[int, list[Point]] = {}
    latest: dict[int, float] = {}
    for number, line in enumerate(read_lines(path), start=1):
        try:
            row = json.loads(line)
            member, step = int(row["member"]), int(row["step"])
            sp, xp = row.get("real_sp"), row.get("real_xp_max", row.get("real_xp"))
            simulated = int(row.get("simulated_steps") or 0)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise UserError(str(path), f"line {number} is no point of metrics ({error})", "restore it") from None
        if xp is not None:
            latest[member] = float(xp)
        if sp is not None:
            points = curves.setdefault(member, [])
            while points and (points[-1].step, points[-1].simulated) >= (step, simulated):
                points.pop()
            points.append(Point(step, float(sp), latest.get(member), simulated))
    return {member: tuple(points) for member, points in curves.items()}


def read_lines(path: Path) -> list[str]:
    """Lines of a text file of a run.

    Raises:
        UserError: it is missing or cannot be read.
    """
    fix = "restore the run from a good copy"
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise UserError(str(path), "is missing", fix) from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(str(path), f"cannot be read ({error})", fix) from None
