"""Proof of recordings: every game is played again, the person's actions as recorded and the ego's anew.

An action of the person that changed nothing (interact before nothing) follows from no state: what was written of a
game that is over is compared with the digest that was taken at its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from popgen.study.game_records import FINISHED, VOID, digest_steps
from popgen.study.hosted_game import HostedGame, PartnerShelf, open_shelves
from popgen.study.study_definition import Study
from popgen.study.study_tables import Database, games, ticks


@dataclass(frozen=True)
class CheckedGame:
    """What playing a game again showed.

    Attributes:
        game: row of `games`.
        status: open, finished or void.
        steps: recorded.
        problem: what is wrong, None for a proven recording.
    """

    game: int
    status: str
    steps: int
    problem: str | None


def check_recordings(study: Study, database: Database) -> list[CheckedGame]:
    """Play every recorded game again.

    Raises:
        UserError: an ego is missing or has other weights.
    """
    shelves = open_shelves(study)
    with database.read() as connection:
        rows = connection.execute(sa.select(games).order_by(games.c.id)).all()
        return [_check_game(connection, row, shelves.get((row.layout, row.ego))) for row in rows]


def _check_game(connection: Connection, row: sa.Row, shelf: PartnerShelf | None) -> CheckedGame:
    steps = connection.execute(sa.select(ticks).where(ticks.c.game == row.id).order_by(ticks.c.step)).all()
    problem = f"there is no ego {row.ego!r} in {row.layout!r}" if shelf is None else _find_problem(row, steps, shelf)
    return CheckedGame(row.id, row.status, len(steps), problem)


def _find_problem(row: sa.Row, steps: Sequence[sa.Row], shelf: PartnerShelf) -> str | None:
    policy = shelf.take()
    try:
        game = HostedGame(shelf.env, policy, row.seat, row.seed)
        for number, step in enumerate(steps):
            if step.step != number:
                return f"step {number} is missing"
            if step.state != game.state.tobytes():
                return f"step {number}: the state is not the simulator's"
            recorded = (step.action_0, step.action_1)
            if not all(0 <= action < shelf.env.spec.num_actions for action in recorded):
                return f"step {number}: there is no such action"
            played = game.advance(recorded[row.seat])
            if played.actions != recorded:
                return f"step {number}: the ego does not act so"
            if not np.isclose(played.score, step.score):
                return f"step {number}: it scores {played.score:g}, recorded is {step.score:g}"
        if row.status in (FINISHED, VOID) and not np.isclose(game.score, row.score):
            return f"the score is {game.score:g}, recorded is {row.score:g}"
        if row.status == FINISHED and len(steps) != row.steps:
            return f"{len(steps)} steps are recorded of a game of {row.steps}"
        if row.status in (FINISHED, VOID) and digest_steps(steps) != row.digest:
            return "a step was changed after the end of the game"
        return None
    finally:
        shelf.give_back(policy)
