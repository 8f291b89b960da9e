"""A study's records as files: steps with the field's 14 columns and our own, games, participants, answers.

Participants are numbered anew in the order of their first game; neither sessions, deletion codes nor digests of
recruiting numbers leave the database. Completion codes stand in a file of their own, without the participants.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from popgen.errors import UserError
from popgen.humans.record_tables import StateWriter, write_actions
from popgen.jsonable import jsonable
from popgen.population.manifest import EnvironmentInfo
from popgen.study.hosted_game import PartnerShelf, open_shelves
from popgen.study.study_definition import Study
from popgen.study.study_tables import Database, answers, games, participants, ticks


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes:
        files: paths.
        games, steps: how many.
    """

    files: tuple[Path, ...]
    games: int
    steps: int


def export_study(study: Study, database: Database, out: Path, kind: str = "parquet") -> Exported:
    """Write all records of people who consented.

    Args:
        study: its definition.
        database: its records.
        out: folder, made if missing.
        kind: of the steps' file: `parquet` or `csv`.

    Raises:
        UserError: the folder cannot be written, or an ego is missing.
    """
    shelves, steps = open_shelves(study), 0
    path = out / f"steps.{kind}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        with database.read() as connection:
            names = _name_participants(connection)
            rows = connection.execute(sa.select(games).order_by(games.c.id)).all()
            with _TableFile(path) as file:
                for row in rows:
                    table = describe_game(connection, row, shelves[row.layout, row.ego], names[row.participant])
                    steps += len(table)
                    file.append(table)
            files = (path, *_write_rest(connection, names, out))
    except OSError as error:
        raise UserError(str(out), f"cannot be written: {error.strerror}", "choose another folder") from None
    return Exported(files, len(rows), steps)


def describe_game(connection: Connection, row: sa.Row, shelf: PartnerShelf, person: str) -> pd.DataFrame:
    """One game's rows: the 14 columns of `record_tables`, then ours."""
    steps = connection.execute(sa.select(ticks).where(ticks.c.game == row.id).order_by(ticks.c.step)).all()
    writer, env = StateWriter(shelf.env), shelf.env
    states = np.array([np.frombuffer(step.state, np.uint8) for step in steps]).reshape(-1, env.spec.state_size)
    actions = np.array([(step.action_0, step.action_1) for step in steps], np.uint8).reshape(-1, 2)
    _, results = env.simulate(states, actions)
    players = [row.ego or "tutorial", row.ego or "tutorial"]
    players[row.seat] = person
    count, seconds = np.arange(len(steps)), row.step_ms / 1000
    info = EnvironmentInfo.of(env.spec)
    return pd.DataFrame(
        {
            "state": [writer.write_state(state) for state in states],
            "joint_action": [write_actions(joint) for joint in actions],
            "reward": results.reward.astype(np.float64),
            "time_left": (row.steps - count) * seconds,
            "score": np.cumsum([step.score for step in steps], dtype=np.float64),
            "time_elapsed": [step.time_ms / 1000 for step in steps],
            "cur_gameloop": count,
            "layout": writer.layout,
            "layout_name": row.layout,
            "trial_id": f"{row.id}",
            "player_0_id": players[0],
            "player_1_id": players[1],
            "player_0_is_human": row.seat == 0,
            "player_1_is_human": row.seat == 1,
            "environment": _describe_environment(info),
            "status": row.status,
            "state_row": [step.state.hex() for step in steps],
            "keys": [step.keys for step in steps],
            "late_ms": [step.late_us / 1000 for step in steps],
            "latency_ms": np.array([step.latency_ms for step in steps], np.float64),
        }
    )


def _describe_environment(info: EnvironmentInfo) -> str:
    return json.dumps({"name": info.name, "params": jsonable(info.params)}, sort_keys=True)


def _name_participants(connection: Connection) -> dict[int, str]:
    found = connection.scalars(sa.select(participants.c.id).where(participants.c.consented_ms.is_not(None)))
    return {number: f"p{place:04}" for place, number in enumerate(sorted(found), start=1)}


def _write_rest(connection: Connection, names: dict[int, str], out: Path) -> Iterator[Path]:
    """Games, participants, answers and completion codes as CSV."""
    told: dict[str, list[dict[str, Any]]] = {"games": [], "participants": [], "answers": [], "completions": []}
    for row in connection.execute(sa.select(games).order_by(games.c.id)).mappings():
        told["games"].append({**row, "participant": names[row["participant"]]})
    kept = ("status", "slot", "voids", "check_failures", "consent_version", "consent_digest")
    for row in connection.execute(sa.select(participants).order_by(participants.c.id)).mappings():
        if row["id"] in names:
            seconds = None if row["ended_ms"] is None else (row["ended_ms"] - row["consented_ms"]) / 1000
            about = {"participant": names[row["id"]], **{name: row[name] for name in kept}, "seconds": seconds}
            told["participants"].append(about)
            told["completions"].append({"completion": row["completion"], "status": row["status"]})
    for row in connection.execute(sa.select(answers)).mappings():
        if row["participant"] in names:
            told["answers"].append({**row, "participant": names[row["participant"]]})
    told["completions"] = sorted(
        (one for one in told["completions"] if one["completion"]), key=lambda one: one["completion"]
    )
    for name, rows in told.items():
        pd.DataFrame(rows).to_csv(out / f"{name}.csv", index=False)
        yield out / f"{name}.csv"


class _TableFile:
    """A table that grows game by game.

    Args:
        path: .parquet or .csv.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._writer, self._begun = path, None, False

    def __enter__(self) -> _TableFile:
        self._path.unlink(missing_ok=True)
        return self

    def append(self, table: pd.DataFrame) -> None:
        """Add rows of the same columns."""
        if not len(table):
            return
        if self._path.suffix == ".csv":
            table.to_csv(self._path, mode="a", header=not self._begun, index=False)
            self._begun = True
            return
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows = pa.Table.from_pandas(table, preserve_index=False)
        if self._writer is None:
            self._writer = pq.ParquetWriter(self._path, rows.schema)
        self._writer.write_table(rows)

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()
