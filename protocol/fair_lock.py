"""A lock that is granted in the order of the requests, urgent ones first.

Python's locks are not fair: a thread that releases one and requests it again at once gets it again. Of fifty loops that
begin together, some would wait for seconds and lose their leases.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_SLICE_S = 0.05
"""Longest single wait, s: short enough to send heartbeats in time."""


class FairLock:
    """A lock that is held by `with lock.take(): ...`; its holder must not take it again."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._taken = False
        self._waiting: deque[threading.Lock] = deque()
        self._urgent: deque[threading.Lock] = deque()

    @property
    def waiting(self) -> int:
        """How many wait for the lock."""
        return len(self._waiting) + len(self._urgent)

    @contextmanager
    def take(self, urgent: bool = False, meanwhile: Callable[[], object] = lambda: None) -> Iterator[None]:
        """Waits for the lock and holds it.

        urgent: whether this request goes before those that are not urgent.
        meanwhile: called again and again while other threads hold the lock.
        """
        self._enter(self._urgent if urgent else self._waiting, meanwhile)
        try:
            yield
        finally:
            self._leave()

    def _enter(self, queue: deque[threading.Lock], meanwhile: Callable[[], object]) -> None:
        with self._guard:
            if not self._taken:
                self._taken = True
                return
            own = threading.Lock()
            own.acquire()
            queue.append(own)
        try:
            while not own.acquire(timeout=_SLICE_S):  # until the previous holder releases it to this thread
                meanwhile()
        except BaseException:
            with self._guard:
                has_turn = own not in queue
                if not has_turn:
                    queue.remove(own)
            if has_turn:
                self._leave()
            raise

    def _leave(self) -> None:
        with self._guard:
            queue = self._urgent or self._waiting
            if queue:
                queue.popleft().release()
            else:
                self._taken = False
