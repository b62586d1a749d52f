"""Writes the reports of jobs to the database in order, in a thread of its own, so that no loop waits for the database.

While the database is locked, full or unreachable, reports wait in memory (samples packed, about 10 bytes each) and are
retried until they are written.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque

from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError, SQLAlchemyError, TimeoutError

from loopwright.service.store.journal_writes import Write
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store

log = logging.getLogger(__name__)

_AT_ONCE = 100
_RETRY_S = (0.1, 2.0)


class Journal:
    """The journal of all jobs of a service: reports of many jobs at the same time are written in one transaction.

    beside: whether a thread of its own writes; else the reporting thread writes, which is for a simulation.
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
        """Queues a report, and returns at once."""
        if self._thread is None:
            self._write([write])
            return
        with self._changed:
            self._waiting.append(write)
            self._put += 1
            self._changed.notify_all()

    def flush(self, timeout_s: float | None = None) -> bool:
        """Waits until all earlier reports are written; returns False when they are not within that time."""
        with self._changed:
            wanted = self._put
            return self._changed.wait_for(lambda: self._written >= wanted, timeout_s)

    @property
    def behind_s(self) -> float:
        """Returns for how long the database has accepted nothing although reports wait, s; 0 when it accepts them."""
        since = self._since
        return 0.0 if since is None else time.monotonic() - since

    def close(self, timeout_s: float) -> None:
        """Writes the waiting reports, as far as the database accepts them in that time."""
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
        """Returns how many reports of the batch are done. A report that the database will never accept is logged and
        left out, so that the others are written."""
        try:
            with self._store.writing() as session:
                for write in batch:
                    write(session)
            return len(batch)
        except SQLAlchemyError as error:
            if temporary(error):
                if self._since is None:
                    log.warning("the database accepts nothing, %d reports wait: %s", len(batch), error)
                return 0
            if len(batch) == 1:
                log.exception("a report could not be written")
                return 1
        except FolderInUse as error:
            log.error("another service writes %d reports: %s", len(batch), error)
            return len(batch)
        except Exception:
            if len(batch) == 1:
                log.exception("a report could not be written")
                return 1
        return self._write(batch[:1])


def temporary(error: SQLAlchemyError) -> bool:
    """Returns whether an error may pass with time: a locked file, a full disk, an unreachable server."""
    if isinstance(error, OperationalError | InterfaceError | InternalError | TimeoutError):
        return True
    return isinstance(error, DBAPIError) and error.connection_invalidated
