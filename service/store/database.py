"""Opening the database: a file in the data folder, or a PostgreSQL server shared by several hosts.

Nothing that waits for the database waits for ever: a request is answered with 503 instead.
"""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, create_engine, event, inspect, make_url, text
from sqlalchemy.exc import ArgumentError, SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker
from sqlalchemy.pool import ConnectionPoolEntry, NullPool

_log = logging.getLogger(__name__)

FILE = "loopwright.sqlite"
ENGINE_FILE = "engine.sqlite"
"""What the durable engine keeps for itself."""
WAIT_S = 5
"""Wall time for a connection, a lock or a locked file."""
STATEMENT_S = 10
FIRST_REVISION = "0100"
"""The revision of the first release; those before it, of which no data are kept anywhere, are not read."""
_MIGRATING = 0x4C6F6F70  # any number that hosts agree on


class BadDatabase(Exception):
    """The database setting cannot be used. The text never holds a password."""


urgent: ContextVar[bool] = ContextVar("urgent", default=False)
"""Whether what is asked of the store now goes before the rest: it has connections of its own, so that a pool that is
empty does not keep an abort waiting."""
USUAL, RESERVE = (5, 10), (1, 3)
"""Connections of a pool to a PostgreSQL server: those that are kept, and how many more there may be."""


def sessions(usual: Engine, reserve: Engine) -> sessionmaker[Session]:
    """Sessions of either engine; what is urgent has the reserve's."""

    class _Session(Session):
        def get_bind(self, *_: Any, **__: Any) -> Engine:
            return reserve if urgent.get() else usual

    return sessionmaker(class_=_Session, expire_on_commit=False)


def open_database(folder: Path, url: str | None, name: str, pool: tuple[int, int] = USUAL) -> Engine:
    """The engine for our tables. name: how a PostgreSQL server lists the connections."""
    return sqlite(folder / FILE) if url is None else postgresql(url, name, pool)


def postgresql(url: str, name: str, pool: tuple[int, int] | None) -> Engine:
    """pool: None: each connection is made when it is asked for, and waits for no other. Raises BadDatabase."""
    try:
        parsed = make_url(url)
    except ArgumentError as error:
        raise BadDatabase("the database must be given as postgresql://USER:PASSWORD@HOST:PORT/NAME") from error
    if parsed.get_backend_name() != "postgresql":
        kind = parsed.get_backend_name()
        raise BadDatabase(f"the database must be postgresql://..., not {kind}://; without one a file is used")
    parsed = parsed.set(drivername="postgresql+psycopg")
    if pool is None:
        return create_engine(parsed, poolclass=NullPool, connect_args=_server(name))
    return create_engine(
        parsed,
        pool_size=pool[0],
        max_overflow=pool[1],
        pool_timeout=WAIT_S,
        # A connection that died while it lay idle is noticed before a transaction begins on it.
        pool_pre_ping=True,
        connect_args=_server(name),
    )


def _server(name: str) -> dict[str, str | int]:
    return {
        "connect_timeout": WAIT_S,
        "application_name": name,
        "options": f"-c statement_timeout={STATEMENT_S}s -c lock_timeout={WAIT_S}s",
        "keepalives_idle": WAIT_S,
        "keepalives_interval": 1,
        "keepalives_count": 5,
        "tcp_user_timeout": 1000 * STATEMENT_S,
    }


def sqlite(file: Path) -> Engine:
    """A file that keeps what was committed through a power cut, and whose readers never wait for its writer."""
    engine = create_engine(f"sqlite:///{file}", connect_args={"timeout": float(WAIT_S)})
    event.listen(engine, "connect", pragmas)
    return engine


def close_database(engine: Engine) -> None:
    """Closes the connections, and each that a thread still has as soon as the thread gives it back."""
    event.listen(engine, "checkin", _closed_at_once)
    engine.dispose()


def _closed_at_once(_: object, record: ConnectionPoolEntry) -> None:
    record.invalidate()


def checkpoint(engine: Engine) -> None:
    """Before the end: what SQLite keeps in a -wal beside its file goes into the file. Where that fails nothing is lost:
    the next start reads both."""
    if engine.dialect.name != "sqlite":
        return
    try:
        with engine.connect() as connection:
            busy, *_ = connection.execute(text("PRAGMA wal_checkpoint(TRUNCATE)")).one()
    except SQLAlchemyError as error:
        _log.error("%s: its -wal could not be emptied, the next start reads it: %s", engine.url.database, error)
    else:
        if busy:
            _log.warning("%s: another process is reading, the next start reads the -wal", engine.url.database)


def migrate(engine: Engine) -> None:
    """Makes the tables, or brings them to the present revision. Raises BadDatabase, with nothing written, when they are
    of a later one or of one from before the first release."""
    found = revision(engine)
    if found == present_revision():
        return
    if (refused := never_released(found)) is not None:
        raise BadDatabase(f"the database {refused}")
    from alembic import command  # 0.1 s of processor time, which no start on a present database pays
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config()
    config.set_main_option("script_location", "loopwright.service.store:migrations")
    with engine.begin() as connection:
        if engine.dialect.name != "sqlite":
            connection.execute(text("SET LOCAL lock_timeout = 0"))
            connection.execute(text("SET LOCAL statement_timeout = 0"))
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _MIGRATING})
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, "head")
        except CommandError as error:
            raise BadDatabase(
                f"the database was made by a newer version of Loopwright ({error}): install that version again, or "
                "restore a back-up from before it (docs/operations.md)"
            ) from error


def present_revision() -> str:
    """Returns the revision that the last migration makes, by the names of their files."""
    return max(file.name[1:5] for file in (Path(__file__).parent / "migrations" / "versions").glob("m*.py"))


def never_released(found: str | None) -> str | None:
    """Returns what is to be done about tables of a revision from before the first release, as the predicate of a
    sentence; None of any other revision."""
    if found is None or found >= FIRST_REVISION:
        return None
    return (
        f"was made by a version of Loopwright from before 0.1.0 (revision {found}), which this version does not read "
        "and has left as it was: keep it aside, and start with a new data folder or an empty database "
        "(docs/operations.md)"
    )


def revision(engine: Engine) -> str | None:
    """Returns the revision of the tables; None where there are none. A file is opened to be read only: what is refused
    is left as it was."""
    if engine.dialect.name == "sqlite" and engine.url.database:
        try:
            return revision_of(Path(engine.url.database))
        except sqlite3.Error:
            pass  # asked again below, by those who know what to say of a file that cannot be read
    with engine.connect() as connection:
        if not inspect(connection).has_table("alembic_version"):
            return None
        return connection.execute(text("SELECT version_num FROM alembic_version")).scalar()


def revision_of(file: Path) -> str | None:
    """Returns the revision of the tables in a file, which is opened to be read only; None where there are none. Raises
    sqlite3.Error."""
    if not file.exists():
        return None
    with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, timeout=float(WAIT_S))) as opened:
        if opened.execute("SELECT count(*) FROM sqlite_master WHERE name = 'alembic_version'").fetchone() == (0,):
            return None
        row = opened.execute("SELECT version_num FROM alembic_version").fetchone()
        return None if row is None else str(row[0])


def pragmas(connection: sqlite3.Connection, _record: object) -> None:
    # A transaction that writes takes the lock as it begins: one that read first could not wait for it later.
    connection.isolation_level = "IMMEDIATE"
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
