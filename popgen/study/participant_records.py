"""Participants in the database: sessions, stations, answers, slots, withdrawal.

Every change is one transaction, and moves a participant on only from the station that it saw: what arrives twice,
from two tabs or after a crash, is done once.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from popgen.study.counterbalance import choose_slot
from popgen.study.participant_path import Station, list_questions, list_stations
from popgen.study.study_definition import Study
from popgen.study.study_tables import Database, answers, participants, slots

ACTIVE, COMPLETED, DECLINED, INACTIVE, AWAY, WITHDRAWN = (
    *("active", "completed", "declined", "inactive", "away", "withdrawn"),
)


class Refused(Exception):
    """A request that cannot be met.

    Attributes:
        reason: for the page, one word.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True)
class Participant:
    """A row of `participants`, with its station.

    Attributes:
        id, code, status, slot, completion: see study_tables.
        place: index of the station.
        station: where the participant is.
    """

    id: int
    code: str
    status: str
    slot: int | None
    completion: str | None
    place: int
    station: Station


def hash_token(token: str) -> str:
    """What the database keeps of a session's token."""
    return hashlib.sha256(token.encode()).hexdigest()


class ParticipantRecords:
    """All that happens to participants.

    Args:
        study: its definition.
        database: its records.
        secret: of this study; without it, digests of recruiting numbers cannot be made.
        clock: seconds since 1970.
    """

    def __init__(self, study: Study, database: Database, secret: bytes, clock: Callable[[], float] = time.time) -> None:
        self.study, self.database = study, database
        self.stations = list_stations(study.definition)
        self._secret, self._clock = secret, clock
        kinds = [station.kind == "game" and station.number >= study.definition.tutorials for station in self.stations]
        self._first_pair = kinds.index(True)

    def begin_session(self, recruit: str | None = None) -> str:
        """A new participant; gives the token that the browser keeps.

        Args:
            recruit: a recruiting platform's number, of which a keyed digest is kept.

        Raises:
            Refused: `taken`, this number has begun already; `full`, there are no places left.
        """
        token, row = secrets.token_urlsafe(32), self._describe_recruit(recruit)
        with self.database.write() as connection:
            known = connection.scalar(sa.select(sa.func.count()).select_from(participants)) or 0
            if known >= self.study.definition.places:
                raise Refused("full")
            if row and connection.execute(sa.select(participants.c.id).where(participants.c.recruit == row)).first():
                raise Refused("taken")
            connection.execute(
                participants.insert().values(
                    session=hash_token(token),
                    code=secrets.token_hex(10),
                    recruit=row,
                    status=ACTIVE,
                    station=0,
                    seen_ms=self.now(),
                )
            )
        return token

    def _describe_recruit(self, recruit: str | None) -> str | None:
        return hmac.new(self._secret, recruit.encode(), hashlib.sha256).hexdigest() if recruit else None

    def now(self) -> int:
        """Milliseconds since 1970."""
        return int(self._clock() * 1000)

    def find(self, token: str | None) -> Participant | None:
        """Whose token this is; None for nobody's."""
        if not token:
            return None
        with self.database.read() as connection:
            row = connection.execute(sa.select(participants).where(participants.c.session == hash_token(token))).first()
        return None if row is None else self._as_participant(row)

    def _as_participant(self, row: Any) -> Participant:
        station = self.stations[row.station]
        return Participant(row.id, row.code, row.status, row.slot, row.completion, row.station, station)

    def touch(self, participant: int) -> None:
        """A sign of life."""
        with self.database.write() as connection:
            connection.execute(participants.update().where(participants.c.id == participant).values(seen_ms=self.now()))

    def consent(self, who: Participant, *, agreed: bool, version: str) -> None:
        """Take or refuse part; raises Refused for another version of the text, or at another station."""
        self._expect_station(who, "consent")
        if version != self.study.definition.consent_version:
            raise Refused("outdated")
        with self.database.write() as connection:
            if not agreed:
                self.end(connection, who.id, DECLINED)
                return
            told = {
                "consent_version": version,
                "consent_digest": hashlib.sha256(self.study.consent.encode()).hexdigest(),
            }
            self.move_on(connection, who.id, who.place, consented_ms=self.now(), **told)

    def read_instructions(self, who: Participant) -> None:
        """Go on to the comprehension check."""
        self._expect_station(who, "instructions")
        with self.database.write() as connection:
            self.move_on(connection, who.id, who.place)

    def answer(self, who: Participant, form: str, given: Mapping[str, str]) -> bool:
        """Record a form's answers and go on; False where the comprehension check was not passed.

        Raises:
            Refused: another form is due, or these are no answers to it.
        """
        questions = list_questions(self.study.definition, who.station)
        if who.status != ACTIVE or not questions or form != who.station.form:
            raise Refused("elsewhere")
        if set(given) != {q.key for q in questions} or any(given[q.key] not in q.options for q in questions):
            raise Refused("answers")
        with self.database.write() as connection:
            if any(q.answer is not None and q.answer != given[q.key] for q in questions):
                failed = participants.c.check_failures + 1
                chosen = participants.update().where(participants.c.id == who.id)
                connection.execute(chosen.values(check_failures=failed, seen_ms=self.now()))
                return False
            if self.move_on(connection, who.id, who.place):
                rows = [{"participant": who.id, "form": form, "item": key, "value": v} for key, v in given.items()]
                connection.execute(answers.insert(), rows)
        return True

    def move_on(self, connection: Connection, participant: int, place: int, **values: Any) -> bool:
        """From station `place` to the next one; False where the participant is elsewhere by now."""
        changes = {"station": place + 1, "seen_ms": self.now(), **values}
        here = (
            (participants.c.id == participant) & (participants.c.station == place) & (participants.c.status == ACTIVE)
        )
        moved = connection.execute(participants.update().where(here).values(**changes)).rowcount == 1
        if moved and place + 1 == self._first_pair:
            self._take_slot(connection, participant)
        if moved and self.stations[place + 1].kind == "end":
            self.end(connection, participant, COMPLETED)
        return moved

    def _take_slot(self, connection: Connection, participant: int) -> None:
        """A slot for a participant whose pairs begin; those of participants who went away come back before."""
        before = self.now() - int(self.study.definition.away_minutes * 60_000)
        gone = (participants.c.status == ACTIVE) & participants.c.slot.is_not(None) & (participants.c.seen_ms < before)
        for row in connection.execute(sa.select(participants.c.id).where(gone)).all():
            self.end(connection, row.id, AWAY)
        free = connection.scalars(sa.select(slots.c.number).where(slots.c.state == "free")).all()
        begun = connection.scalar(sa.select(sa.func.count()).select_from(slots)) or 0
        slot = choose_slot(free, begun)
        if slot == begun:
            connection.execute(slots.insert().values(number=slot, state="held"))
        else:
            connection.execute(slots.update().where(slots.c.number == slot).values(state="held"))
        connection.execute(participants.update().where(participants.c.id == participant).values(slot=slot))

    def end(self, connection: Connection, participant: int, status: str) -> None:
        """The participant plays no more; a slot that is not finished returns."""
        row = connection.execute(sa.select(participants).where(participants.c.id == participant)).one()
        if row.status != ACTIVE:
            return
        completion = secrets.token_hex(5).upper() if row.consented_ms is not None else None
        changes = {"status": status, "ended_ms": self.now(), "completion": completion}
        connection.execute(participants.update().where(participants.c.id == participant).values(**changes))
        if row.slot is not None:
            state = "done" if status == COMPLETED else "free"
            connection.execute(slots.update().where(slots.c.number == row.slot).values(state=state))

    def withdraw(self, who: Participant) -> None:
        """Stop; what was recorded stays."""
        with self.database.write() as connection:
            self.end(connection, who.id, WITHDRAWN)

    def delete(self, code: str) -> bool:
        """Delete every row of the participant with this code; False where there is none."""
        with self.database.write() as connection:
            row = connection.execute(sa.select(participants).where(participants.c.code == code)).first()
            if row is None:
                return False
            if row.slot is not None and row.status in (ACTIVE, COMPLETED):
                connection.execute(slots.update().where(slots.c.number == row.slot).values(state="free"))
            connection.execute(participants.delete().where(participants.c.id == row.id))
        self.database.wipe_log()
        return True

    def _expect_station(self, who: Participant, kind: str) -> None:
        if who.status != ACTIVE or who.station.kind != kind:
            raise Refused("elsewhere")
