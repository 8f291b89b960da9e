"""Games in the database: which one is next, its steps so far, and what is added to it."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from popgen.study.participant_records import ACTIVE, INACTIVE, Participant, ParticipantRecords, Refused
from popgen.study.study_tables import games, participants, ticks

OPEN, FINISHED, VOID = "open", "finished", "void"
PartnerKey = tuple[str, str | None]
"""Layout and ego; the tutorial's is None."""


@dataclass(frozen=True)
class GameTicket:
    """A game that is to be played, or to be gone on with.

    Attributes:
        id: row of `games`.
        participant: row of `participants`.
        number: from 0, tutorials first.
        layout: name in the definition; None for the tutorial's.
        ego: its name; None for the tutorial's.
        position: in the pair, 0 or 1.
        seat: of the person.
        seed: of the ego's generator.
        steps: of a whole game.
        began_ms: when it was opened.
        actions: (T, 2) uint8, played so far.
    """

    id: int
    participant: int
    number: int
    layout: str
    ego: str | None
    position: int
    seat: int
    seed: int
    steps: int
    began_ms: int
    actions: np.ndarray


@dataclass(frozen=True)
class OpenedGame:
    """A game and the station (its place) that it is played at."""

    ticket: GameTicket
    place: int


@dataclass(frozen=True)
class Tick:
    """A row of `ticks`; see study_tables."""

    game: int
    step: int
    state: bytes
    action_0: int
    action_1: int
    score: float
    keys: str
    time_ms: int
    late_us: int
    latency_ms: float | None


@dataclass(frozen=True)
class GameEnd:
    """A game is over.

    Attributes:
        game, participant: rows.
        place: of the station that it was played at.
        status: `finished` or `void`.
        score: in all.
    """

    game: int
    participant: int
    place: int
    status: str
    score: float


class GameRecords:
    """All that happens to games.

    Args:
        people: the study's participants.
        tutorial_layout: name of the layout that tutorials are played in.
        step_ms: length of a step.
    """

    def __init__(self, people: ParticipantRecords, tutorial_layout: str, step_ms: int) -> None:
        self.people, self.definition = people, people.study.definition
        self._tutorial_layout, self._step_ms = tutorial_layout, step_ms

    def open_game(self, who: Participant) -> OpenedGame:
        """The game of the participant's station: the one that was left, or a new one.

        Raises:
            Refused: no game is due.
        """
        with self.people.database.write() as connection:
            row = connection.execute(sa.select(participants).where(participants.c.id == who.id)).first()
            if row is None or row.status != ACTIVE or self.people.stations[row.station].kind != "game":
                raise Refused("elsewhere")
            number = self.people.stations[row.station].number
            own = (games.c.participant == who.id) & (games.c.number == number)
            found = connection.execute(sa.select(games).where(own).order_by(games.c.attempt.desc())).first()
            if found is None or found.status != OPEN:
                values = self._plan_game(number, row.slot)
                values |= {"participant": who.id, "attempt": 1 + (found.attempt if found else 0)}
                key = connection.execute(games.insert().values(**values)).inserted_primary_key
                assert key is not None
                found = connection.execute(sa.select(games).where(games.c.id == key[0])).one()
            return OpenedGame(read_ticket(connection, found), row.station)

    def find_open(self, who: Participant) -> PartnerKey:
        """The partner of the game that a participant plays at present.

        Raises:
            Refused: there is none.
        """
        chosen = sa.select(games.c.layout, games.c.ego).where(games.c.participant == who.id, games.c.status == OPEN)
        with self.people.database.read() as connection:
            row = connection.execute(chosen.order_by(games.c.id.desc())).first()
        if row is None:
            raise Refused("elsewhere")
        return row.layout, row.ego

    def _plan_game(self, number: int, slot: int | None) -> dict[str, Any]:
        pair, position = divmod(number - self.definition.tutorials, 2)
        shared = {"number": number, "steps": self.definition.steps, "step_ms": self._step_ms, "status": OPEN}
        shared |= {"seed": secrets.randbits(31), "began_ms": self.people.now()}
        if number < self.definition.tutorials:
            return {**shared, "layout": self._tutorial_layout, "ego": None, "position": 0, "seat": number % 2}
        assert slot is not None
        plan = self.definition.design.plan_slot(slot)[pair]
        named = {"layout": plan.layout, "ego": plan.egos[position], "position": position, "seat": plan.seat}
        return {**shared, **named}

    def write(self, rows: Sequence[Tick | GameEnd]) -> None:
        """Append steps and ends of games, in their order, in one transaction."""
        with self.people.database.write() as connection:
            known = set(connection.scalars(sa.select(games.c.id).where(games.c.id.in_({row.game for row in rows}))))
            steps = [asdict(row) for row in rows if isinstance(row, Tick) and row.game in known]
            if steps:
                connection.execute(ticks.insert(), steps)
            for row in rows:
                if isinstance(row, GameEnd) and row.game in known:  # not deleted meanwhile
                    self._end_game(connection, row)
            seen = {"seen_ms": self.people.now()}
            playing = sa.select(games.c.participant).where(games.c.id.in_(known))
            connection.execute(participants.update().where(participants.c.id.in_(playing)).values(**seen))

    def _end_game(self, connection: Connection, end: GameEnd) -> None:
        steps = connection.execute(sa.select(ticks).where(ticks.c.game == end.game).order_by(ticks.c.step)).all()
        values = {"status": end.status, "score": end.score, "digest": digest_steps(steps)}
        still = (games.c.id == end.game) & (games.c.status == OPEN)
        if connection.execute(games.update().where(still).values(**values)).rowcount == 0:
            return
        if end.status == FINISHED:
            self.people.move_on(connection, end.participant, end.place)
            return
        own = participants.c.id == end.participant
        connection.execute(participants.update().where(own).values(voids=participants.c.voids + 1))
        if (connection.scalar(sa.select(participants.c.voids).where(own)) or 0) >= self.definition.voids:
            self.people.end(connection, end.participant, INACTIVE)


def digest_steps(steps: Sequence[sa.Row]) -> str:
    """Of rows of `ticks`, every column: an action that changed nothing in the game is told by it alone."""
    return hashlib.sha256(repr([tuple(step) for step in steps]).encode()).hexdigest()


def read_ticket(connection: Connection, row: Any) -> GameTicket:
    """A game with the actions played so far."""
    chosen = sa.select(ticks.c.action_0, ticks.c.action_1).where(ticks.c.game == row.id).order_by(ticks.c.step)
    played = connection.execute(chosen).all()
    names = ("id", "participant", "number", "layout", "ego", "position", "seat", "seed", "steps", "began_ms")
    actions = np.array([tuple(one) for one in played], np.uint8).reshape(-1, 2)
    return GameTicket(**{name: getattr(row, name) for name in names}, actions=actions)
