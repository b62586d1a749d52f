"""The tables of a new SQLite file are made by the migrations once in a process; each later file gets a copy of them."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from unittest.mock import patch

from sqlalchemy import Engine

from loopwright.service.store import store
from loopwright.service.store.database import migrate, revision

_ONE = threading.Lock()


@contextmanager
def migrated_once() -> Iterator[None]:
    """Whatever has tables already, and PostgreSQL, is left to the migrations."""
    with (
        closing(sqlite3.connect(":memory:", check_same_thread=False)) as made,
        patch.object(store, "migrate", lambda engine: _migrate(engine, made)),
    ):
        yield


def _migrate(engine: Engine, made: sqlite3.Connection) -> None:
    new = engine.dialect.name == "sqlite" and revision(engine) is None
    if not new:
        migrate(engine)
        return
    connection = engine.raw_connection()
    try:
        file = connection.driver_connection
        assert isinstance(file, sqlite3.Connection)
        if file.execute("SELECT count(*) FROM sqlite_master").fetchone() != (0,):
            migrate(engine)
            return
        with _ONE:
            if not made.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                migrate(engine)
                file.backup(made)
            else:
                made.backup(file)
    finally:
        connection.close()
