"""One service per data folder, and one per host name on a shared database: two would drive the same loops."""

from __future__ import annotations

import fcntl
import hashlib
import os
import socket
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session


class FolderInUse(Exception):
    """Another service works in this data folder, or under this host name."""


def ourselves() -> str:
    """This process, for whoever finds the lock held."""
    return f"process {os.getpid()} on {socket.gethostname()}"


class FolderLock:
    """An exclusive lock on FOLDER/lock, whose text says who holds it. The system frees it when the process ends."""

    def __init__(self, folder: Path) -> None:
        self._file = open(folder / "lock", "a+")  # noqa: SIM115 - held until close
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.seek(0)
            holder = self._file.read().strip() or "another service"
            self._file.close()
            raise FolderInUse(f"the data folder {folder} is in use: {holder}") from error
        self._file.truncate(0)
        self._file.write(f"{ourselves()}, since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class HostLock:
    """An advisory lock on a PostgreSQL server, held by a connection of its own."""

    def __init__(self, engine: Engine, host: str) -> None:
        self._engine = engine
        self._host = host
        self._key = _key(host)
        self._connection: Connection | None = None
        self._take()

    @staticmethod
    def free(session: Session, host: str) -> bool:
        """True when no service runs under this name; until the end of the transaction none can be started."""
        return bool(session.scalar(text("SELECT pg_try_advisory_xact_lock(:key)"), {"key": _key(host)}))

    def check(self) -> None:
        """Takes the lock again after the server was away. Raises FolderInUse when another was faster.

        A server that is still away is no reason to end: nobody else can take the lock there.
        """
        try:
            if self._connection is not None:
                self._connection.execute(text("SELECT 1"))
                return
        except SQLAlchemyError:
            self.close()
        try:
            self._take()
        except SQLAlchemyError:
            return

    def _take(self) -> None:
        connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        if not connection.scalar(text("SELECT pg_try_advisory_lock(:key)"), {"key": self._key}):
            holder = connection.scalar(_HOLDER, {"high": self._key >> 32 & 0xFFFFFFFF, "low": self._key & 0xFFFFFFFF})
            connection.close()
            raise FolderInUse(f"host {self._host!r} is served already: {holder or 'by another service'}")
        self._connection = connection

    def close(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            # Not given back to the pool: the lock lives as long as its connection.
            connection.invalidate()
            connection.close()


def _key(host: str) -> int:
    return int.from_bytes(hashlib.sha256(f"loopwright host {host}".encode()).digest()[:8], signed=True)


_HOLDER = text(
    "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid)"
    " WHERE l.locktype = 'advisory' AND l.granted AND l.objsubid = 1"
    " AND l.classid = CAST(:high AS bigint)::oid AND l.objid = CAST(:low AS bigint)::oid"
)
