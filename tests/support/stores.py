"""MLflow makes the tables of an empty store by dozens of migrations; in tests it does so once for each process."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any


def keep_tables(kept: Path) -> None:
    """From now on the first empty store in a file is made by MLflow and copied to `kept`; later ones are its copies."""
    from mlflow.store.db import utils

    make = utils._initialize_tables

    def initialize(engine: Any) -> None:
        if engine.dialect.name != "sqlite" or not utils._is_empty_database(engine):
            make(engine)
            return
        is_first = not kept.exists()
        if is_first:
            make(engine)
        with closing(sqlite3.connect(kept)) as copy, engine.connect() as connection:
            store = connection.connection.driver_connection
            source, target = (store, copy) if is_first else (copy, store)
            source.backup(target)

    utils._initialize_tables = initialize
