"""One service per data folder, and one per host name on a shared database: two would drive the same loops."""

from __future__ import annotations

import fcntl
import hashlib
import os
import secrets
import socket
import time
from collections.abc import Collection
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

CHECK_S = 1.0
"""Wall time between two checks of the lock on a host's name."""
PATIENCE_S = 10.0
"""So long whoever has a name may take to come for it: a check, and a connection that is not answered in between."""
_LOOK_S = 0.25
LOCK = "lock"
"""The file of a data folder that its service holds while it runs."""


class FolderInUse(Exception):
    """Another service works in this data folder, or under this host name."""


def ourselves() -> str:
    """This process, for whoever finds the lock held."""
    return f"process {os.getpid()} on {socket.gethostname()}"


class FolderLock:
    """An exclusive lock on the file LOCK of a folder, whose text says who has it. The system frees it as that ends."""

    def __init__(self, folder: Path) -> None:
        self._file = open(folder / LOCK, "a+")  # noqa: SIM115 - held until close
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
    """The name of a host on a PostgreSQL server, so that one service has it: an advisory lock, held by a connection of
    its own, and a claim, which is a row.

    The lock is gone when the server is restarted, though its holder lives: the claim says that somebody may come for
    it. Whoever finds a claim without a lock waits longer than its holder takes to come. A holder that finds another
    claim than its own has been away for too long: the name is another's.

    engine: of connections that nobody else waits for.  folder: where the last claim is kept that was made from there.
    """

    def __init__(self, engine: Engine, host: str, folder: Path) -> None:
        self._engine = engine
        self._host = host
        self._file = folder / "claim"
        self._claim = secrets.token_hex(8)
        self._connection: Connection | None = None

    @staticmethod
    def free(session: Session, host: str) -> bool:
        """True when no service runs under this name; until the end of the transaction none can be started."""
        return bool(session.scalar(text("SELECT pg_try_advisory_xact_lock(:key)"), {"key": _key(host)}))

    def refuse(self) -> None:
        """Raises FolderInUse when another has the name."""
        with self._engine.connect() as connection:
            self._refuse(connection, self._host)

    def take(self) -> None:
        """Makes the claim, after the tables are there. Raises FolderInUse when another has the name."""
        self.wait_for([self._host])
        connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        try:
            if not self._locked(connection):
                self._refuse(connection, self._host)
                raise FolderInUse(f"host {self._host!r} is served already: by another service")
            # First the file: a claim that is in no row is nobody's.
            self._file.write_text(self._claim)
            connection.execute(_MAKE_CLAIM, {"host": self._host, "claim": self._claim, "by": ourselves()})
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def wait_for(self, names: Collection[str]) -> None:
        """Waits until those who have these names have had the time to come for them. Raises FolderInUse when the name
        is this lock's own, and somebody has come."""
        give_up = time.monotonic() + PATIENCE_S
        with self._engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            while any(self._may_come(connection, name) for name in names) and time.monotonic() < give_up:
                time.sleep(_LOOK_S)
            if self._host in names:
                self._refuse(connection, self._host)

    def check(self) -> None:
        """Takes the lock again after the server was away. Raises FolderInUse when another has claimed the name.

        A server that is still away is no reason to end: nobody else can claim the name there.
        """
        try:
            if self._connection is not None:
                with suppress(SQLAlchemyError):
                    self._check_claim(self._connection)
                    return
                self.drop()
            with suppress(SQLAlchemyError):
                self._connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
                locked = self._locked(self._connection)
                self._check_claim(self._connection)
                if locked:
                    return
            # Not had, and the claim still ours: the lock is with a broken connection of our own that the server still
            # believes in, or with somebody who is about to claim the name. The next look tells.
            self.drop()
        except FolderInUse:
            self.drop()
            raise

    def check_claim(self, session: Session) -> None:
        """Raises FolderInUse when another has claimed the name: what this transaction writes is not ours to write."""
        self._check_claim(session)

    def close(self) -> None:
        """Gives the name back."""
        if self._connection is not None:
            with suppress(SQLAlchemyError):
                self._connection.execute(_GIVE_BACK, {"host": self._host, "claim": self._claim})
        self.drop()
        self._engine.dispose()

    def _check_claim(self, connection: Connection | Session) -> None:
        row = connection.execute(_CLAIM, {"host": self._host}).one_or_none()
        if row is not None and row.claim != self._claim:
            raise FolderInUse(f"{row.claimed_by} has taken the name {self._host!r} while the database was away")

    def _may_come(self, connection: Connection, name: str) -> bool:
        """Whether somebody has claimed the name who does not hold its lock at present, and may still live."""
        row = connection.execute(_CLAIM, {"host": name}).one_or_none()
        if row is None or row.claim is None or _holder(connection, name) is not None:
            return False
        # Made from this folder, whose lock is ours: who made it is dead.
        return not (self._file.exists() and self._file.read_text() == row.claim)

    def _locked(self, connection: Connection) -> bool:
        return bool(connection.scalar(text("SELECT pg_try_advisory_lock(:key)"), {"key": _key(self._host)}))

    @staticmethod
    def _refuse(connection: Connection, host: str) -> None:
        holder = _holder(connection, host)
        if holder is not None:
            raise FolderInUse(f"host {host!r} is served already: {holder}")

    def drop(self) -> None:
        """Ends the connection without giving the name back, as the end of the process does."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.invalidate()
            connection.close()


def _holder(connection: Connection, host: str) -> str | None:
    """Who has the lock."""
    key = _key(host)
    found = connection.scalar(_HOLDER, {"high": key >> 32 & 0xFFFFFFFF, "low": key & 0xFFFFFFFF})
    return None if found is None else str(found)


def _key(host: str) -> int:
    return int.from_bytes(hashlib.sha256(f"loopwright host {host}".encode()).digest()[:8], signed=True)


_HOLDER = text(
    "SELECT coalesce(a.application_name, 'another service') FROM pg_locks l JOIN pg_stat_activity a USING (pid)"
    " JOIN pg_database d ON d.oid = l.database AND d.datname = current_database()"
    " WHERE l.locktype = 'advisory' AND l.granted AND l.objsubid = 1"
    " AND l.classid = CAST(:high AS bigint)::oid AND l.objid = CAST(:low AS bigint)::oid"
)
_CLAIM = text("SELECT claim, claimed_by FROM hosts WHERE host = :host")
_MAKE_CLAIM = text(
    "INSERT INTO hosts (host, claim, claimed_by) VALUES (:host, :claim, :by)"
    " ON CONFLICT (host) DO UPDATE SET claim = :claim, claimed_by = :by"
)
_GIVE_BACK = text("UPDATE hosts SET claim = NULL WHERE host = :host AND claim = :claim")
