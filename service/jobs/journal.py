"""What jobs report, written in order by a thread of its own: a loop is pumped on whatever the database does.

While the database is locked, full or away, reports wait in memory (samples packed, about 10 bytes each) and are tried
again until they are written.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque

from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError, SQLAlchemyError, TimeoutError

from loopwright.service.store.store import FolderInUse, Store, Write

log = logging.getLogger(__name__)

_AT_ONCE = 100
_RETRY_S = (0.1, 2.0)


class Journal:
    """One per service, for all of its jobs: what many jobs report at the same time is one transaction.

    beside: written by a thread of its own; else by who reports, which is for a simulation.
    """

    def __init__(self, store: Store, beside: bool = True) -> None:
        self._store = store
        self._waiting: deque[Write] = deque()
        self._put = self._written = 0
        self._since: float | None = None
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True) if beside else None
        if self._thread is not None:
            self._thread.start()

    def put(self, write: Write) -> None:
        """Returns at once."""
        if self._thread is None:
            self._write([write])
            return
        with self._changed:
            self._waiting.append(write)
            self._put += 1
            self._changed.notify_all()

    def flush(self, timeout_s: float | None = None) -> bool:
        """Waits until everything put before is written; False when it is not in that time."""
        with self._changed:
            wanted = self._put
            return self._changed.wait_for(lambda: self._written >= wanted, timeout_s)

    @property
    def behind_s(self) -> float:
        """For how long the database has taken nothing although something waits, s; 0 when all is well."""
        since = self._since
        return 0.0 if since is None else time.monotonic() - since

    def close(self, timeout_s: float) -> None:
        """Writes what waits, as far as the database takes it in that time."""
        self.flush(timeout_s)
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        pause, longest = _RETRY_S
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if self._closing and (not self._waiting or self._since is not None):
                    return
                batch = [self._waiting[i] for i in range(min(_AT_ONCE, len(self._waiting)))]
            done = self._write(batch)
            if done:
                pause, self._since = _RETRY_S[0], None
                with self._changed:
                    for _ in range(done):
                        self._waiting.popleft()
                    self._written += done
                    self._changed.notify_all()
            else:
                self._since = self._since or time.monotonic()
                with self._changed:
                    self._changed.wait_for(lambda: self._closing, pause)
                pause = min(2 * pause, longest)

    def _write(self, batch: list[Write]) -> int:
        """How many of the batch are dealt with. What the database will never take is left out, with a word in the
        log; it must not keep the rest from being written."""
        try:
            with self._store.writing() as session:
                for write in batch:
                    write(session)
            return len(batch)
        except SQLAlchemyError as error:
            if temporary(error):
                if self._since is None:
                    log.warning("the database takes nothing, %d reports wait: %s", len(batch), error)
                return 0
            if len(batch) == 1:
                log.exception("a report could not be written")
                return 1
        except FolderInUse as error:
            log.error("%d reports are another's to write: %s", len(batch), error)
            return len(batch)
        except Exception:
            if len(batch) == 1:
                log.exception("a report could not be written")
                return 1
        return self._write(batch[:1])


def temporary(error: SQLAlchemyError) -> bool:
    """True for what time may heal: a locked file, a full disk, a server that is away."""
    if isinstance(error, OperationalError | InterfaceError | InternalError | TimeoutError):
        return True
    return isinstance(error, DBAPIError) and error.connection_invalidated
