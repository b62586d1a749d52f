"""One reading of a loop, shared by all requests that arrived before it began: otherwise sixty requests for a silent
node would each wait for its time-outs, one after the other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Generic, TypeVar

from loopwright.tuning.reasons import Ended

T = TypeVar("T")

asked_at: ContextVar[float | None] = ContextVar("asked_at", default=None)
"""Arrival time of the request being answered, monotonic seconds; None for just now."""


@dataclass(frozen=True)
class _Reading(Generic[T]):
    began: float
    outcome: T | Ended


class SharedReading(Generic[T]):
    """Shares the results of `read`, which takes a name, may take long and raises Ended; for use from any thread."""

    def __init__(self, read: Callable[[str], T], wall: Callable[[], float] = time.monotonic) -> None:
        self._read, self._wall = read, wall
        self._last: dict[str, _Reading[T]] = {}
        self._under_way: set[str] = set()
        self._changed = threading.Condition()

    def of(self, name: str) -> T:
        """Returns a reading that was begun after this call, by any thread. Raises what `read` raises."""
        asked = asked_at.get()
        asked = self._wall() if asked is None else asked
        with self._changed:
            self._changed.wait_for(lambda: name not in self._under_way or self._fresh(name, asked))
            last = self._fresh(name, asked)
            if last is None:
                self._under_way.add(name)
        if last is None:
            last = self._anew(name)
        if isinstance(last.outcome, Ended):
            raise type(last.outcome)(last.outcome.reason, last.outcome.detail)
        return last.outcome

    def _fresh(self, name: str, asked: float) -> _Reading[T] | None:
        last = self._last.get(name)
        return last if last is not None and last.began >= asked else None

    def _anew(self, name: str) -> _Reading[T]:
        began, reading = self._wall(), None
        try:
            try:
                reading = _Reading[T](began, self._read(name))
            except Ended as ended:
                reading = _Reading[T](began, ended.with_traceback(None))
            return reading
        finally:
            with self._changed:
                self._under_way.discard(name)
                if reading is not None:
                    self._last[name] = reading
                self._changed.notify_all()
