"""A function that a thread of its own calls again and again, until it is closed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from loopwright.service.store.lock import FolderInUse

log = logging.getLogger(__name__)

_STOP_S = 5.0
"""Wall time for which the end of a turn is waited for, s: it may be waiting for a database that is not reached."""


class Repeated:
    """Calls `turn` until it is closed, or until another service has taken the name of this host and does it instead.

    every_s: wall time from the end of one turn to the next, s.
    name: the name of the thread.
    failed: what could not be done, for the log; the next turn tries it again.
    at_once: whether the first turn begins at once; else it begins after every_s.
    """

    def __init__(
        self, turn: Callable[[], object], every_s: float, name: str, failed: str, at_once: bool = True
    ) -> None:
        self._turn, self._every_s, self._failed = turn, every_s, failed
        self._at_once = at_once
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def closed(self) -> bool:
        """Whether the present turn is the last one."""
        return self._over.is_set()

    def start(self) -> None:
        self._thread.start()

    def request_stop(self) -> None:
        """Begins no other turn; returns at once."""
        self._over.set()

    def close(self) -> None:
        """Begins no other turn, and waits for the present one."""
        self.request_stop()
        self.join(_STOP_S)

    def join(self, timeout_s: float) -> None:
        """Waits for the end of the present turn after `request_stop`."""
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        if not self._at_once:
            self._over.wait(self._every_s)
        while not self._over.is_set():
            try:
                self._turn()
            except FolderInUse:
                return
            except SQLAlchemyError as error:
                log.warning("%s, this is tried again: %s", self._failed, error)
            except Exception:  # whatever it was, the next turn may succeed
                log.exception("%s, by a defect; this is tried again", self._failed)
            self._over.wait(self._every_s)
