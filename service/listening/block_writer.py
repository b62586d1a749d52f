"""Writes finished blocks of history to the database, in one thread. What the database does not take in time is lost,
and nothing else is."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterable

from loopwright.service.store import history
from loopwright.service.store.history import HistoryBlock
from loopwright.service.store.store import Store
from loopwright.service.telemetry.metrics import HISTORY_BLOCKS_LOST

log = logging.getLogger(__name__)

MAX_WAITING = 10_000
"""Blocks that wait for the database in memory: half a kilobyte each."""
_AT_ONCE = 100
_AGAIN_S = 5.0
_SAY_AGAIN_S = 60.0
_STOP_S = 6.0


class BlockWriter:
    """Holds the blocks until they are written, or too many."""

    def __init__(self, store: Store, max_waiting: int = MAX_WAITING, again_s: float = _AGAIN_S) -> None:
        self._store, self._max_waiting, self._again_s = store, max_waiting, again_s
        self._waiting: deque[HistoryBlock] = deque()
        self._changed = threading.Condition()
        self._over = False
        self._said_at: float | None = None
        self._thread = threading.Thread(target=self._run, name="history writer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def put(self, blocks: Iterable[HistoryBlock]) -> None:
        """Queues blocks, and returns at once; the oldest are dropped where too many wait."""
        with self._changed:
            self._waiting.extend(blocks)
            lost = max(0, len(self._waiting) - self._max_waiting)
            for _ in range(lost):
                self._waiting.popleft()
            self._changed.notify_all()
        if lost:
            HISTORY_BLOCKS_LOST.inc(lost)

    def close(self) -> None:
        """Tries once more to write what waits."""
        with self._changed:
            self._over = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(_STOP_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._over)
                batch = [self._waiting.popleft() for _ in range(min(_AT_ONCE, len(self._waiting)))]
            if not batch:
                return
            try:
                history.write(self._store, batch)
            except Exception as error:  # whatever is wrong with the database, the rest of the service goes on
                self._failed(batch, error)
                with self._changed:
                    if self._over:
                        HISTORY_BLOCKS_LOST.inc(len(self._waiting))
                        return
                    self._changed.wait_for(lambda: self._over, self._again_s)

    def _failed(self, batch: list[HistoryBlock], error: Exception) -> None:
        with self._changed:
            self._waiting.extendleft(reversed(batch))
            waiting = len(self._waiting)
        now = time.monotonic()
        if self._said_at is None or now - self._said_at >= _SAY_AGAIN_S:
            self._said_at = now
            reason = getattr(error, "orig", None) or error
            log.warning("the history is not stored, %d blocks wait, everything else goes on: %s", waiting, reason)
