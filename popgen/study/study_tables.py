"""The tables of a study's database, and how it is opened: SQLite in WAL mode, one writer at a time.

No column holds a name, an e-mail address, a network address or a recruiting platform's number. Rows of `ticks` are
written once: a trigger refuses to change them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.engine import Connection, Engine
from sqlalchemy.exc import DatabaseError

from popgen.errors import UserError
from popgen.study.study_definition import Study

SCHEMA_VERSION = "2"

metadata = sa.MetaData()

facts = sa.Table("facts", metadata, sa.Column("name", sa.Text, primary_key=True), sa.Column("value", sa.Text))

participants = sa.Table(
    "participants",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("session", sa.Text, nullable=False, unique=True),  # sha256 of the token that the browser holds
    sa.Column("code", sa.Text, nullable=False, unique=True),  # with which a participant asks for deletion
    sa.Column("recruit", sa.Text, unique=True),  # keyed digest of the platform's number
    sa.Column("status", sa.Text, nullable=False),
    sa.Column("station", sa.Integer, nullable=False),
    sa.Column("slot", sa.Integer),
    sa.Column("voids", sa.Integer, nullable=False, default=0),
    sa.Column("check_failures", sa.Integer, nullable=False, default=0),
    sa.Column("consent_version", sa.Text),
    sa.Column("consent_digest", sa.Text),
    sa.Column("consented_ms", sa.Integer),
    sa.Column("seen_ms", sa.Integer, nullable=False),
    sa.Column("ended_ms", sa.Integer),
    sa.Column("completion", sa.Text),
)

slots = sa.Table(
    "slots",
    metadata,
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("state", sa.Text, nullable=False),  # free, held or done
)

games = sa.Table(
    "games",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("participant", sa.ForeignKey("participants.id", ondelete="CASCADE"), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),  # from 0, tutorials first
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("layout", sa.Text, nullable=False),
    sa.Column("ego", sa.Text),  # None: the tutorial's
    sa.Column("position", sa.Integer, nullable=False),  # in the pair
    sa.Column("seat", sa.Integer, nullable=False),  # of the person
    sa.Column("seed", sa.Integer, nullable=False),  # of the ego's generator
    sa.Column("steps", sa.Integer, nullable=False),  # of a whole game
    sa.Column("step_ms", sa.Integer, nullable=False),
    sa.Column("status", sa.Text, nullable=False),  # open, finished or void
    sa.Column("score", sa.Float),
    sa.Column("digest", sa.Text),  # sha256 of all its steps, once it is over
    sa.Column("began_ms", sa.Integer, nullable=False),
    sa.UniqueConstraint("participant", "number", "attempt"),
)

ticks = sa.Table(
    "ticks",
    metadata,
    sa.Column("game", sa.ForeignKey("games.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("step", sa.Integer, primary_key=True),
    sa.Column("state", sa.LargeBinary, nullable=False),  # before the step
    sa.Column("action_0", sa.Integer, nullable=False),
    sa.Column("action_1", sa.Integer, nullable=False),
    sa.Column("score", sa.Float, nullable=False),  # what the step added
    sa.Column("keys", sa.Text, nullable=False),  # JSON: code, down (1) or up (0), milliseconds of the browser's clock
    sa.Column("time_ms", sa.Integer, nullable=False),  # since the game was opened
    sa.Column("late_us", sa.Integer, nullable=False),  # after the time when the step was due
    sa.Column("latency_ms", sa.Float),  # to the browser and back, where measured since the step before
    sqlite_with_rowid=False,
)

answers = sa.Table(
    "answers",
    metadata,
    sa.Column("participant", sa.ForeignKey("participants.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("form", sa.Text, primary_key=True),
    sa.Column("item", sa.Text, primary_key=True),
    sa.Column("value", sa.Text, nullable=False),
)

_TRIGGER = """
CREATE TRIGGER IF NOT EXISTS ticks_are_final BEFORE UPDATE ON ticks
BEGIN SELECT RAISE(ABORT, 'recorded steps are never changed'); END
"""


class Database:
    """One study's database.

    Args:
        path: of the file; made if missing.
        study: whose records it holds; None to take whatever is there.

    Raises:
        UserError: it is of another study or schema, or cannot be opened.
    """

    def __init__(self, path: Path, study: Study | None = None) -> None:
        self.path = path
        self._lock = threading.Lock()
        if study is None and not path.exists():
            raise UserError(str(path), "is not there: nobody has taken part yet", "start with popgen study serve")
        self._engine = _open_engine(path)
        try:
            with self.write() as connection:
                metadata.create_all(connection)
                connection.exec_driver_sql(_TRIGGER)
                self._check_facts(connection, study)
        except DatabaseError as error:
            raise UserError(str(path), f"cannot be opened: {error.orig}", "choose another folder") from None

    def _check_facts(self, connection: Connection, study: Study | None) -> None:
        known: dict[str, str] = {row.name: row.value for row in connection.execute(sa.select(facts))}
        wanted = {"schema": SCHEMA_VERSION, **({"study": study.digest} if study else {})}
        for name, value in wanted.items():
            if name not in known:
                connection.execute(facts.insert().values(name=name, value=value))
            elif known[name] != value:
                problem = "was begun with another study.json or consent.md" if name == "study" else "has another schema"
                raise UserError(str(self.path), problem, "make a new study for a changed one")

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """A transaction that sees and changes everything alone."""
        with self._lock, self._engine.begin() as connection:
            yield connection

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """A connection to look with; sees what is committed."""
        with self._engine.connect().execution_options(popgen_read=True) as connection:
            yield connection

    def wipe_log(self) -> None:
        """Bring the write-ahead log into the file and empty it, after rows were deleted for good."""
        with self._lock, self._engine.connect().execution_options(popgen_read=True) as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


def _open_engine(path: Path) -> Engine:
    engine = sa.create_engine(f"sqlite:///{path}", connect_args={"timeout": 30})

    @event.listens_for(engine, "connect")
    def prepare(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # transactions begin below, not at the driver's will
        for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON", "secure_delete=ON"):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        if not connection.get_execution_options().get("popgen_read"):
            connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine
