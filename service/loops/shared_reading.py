"""One reading of a loop for all who asked before it began: of sixty who ask at once for a node that is silent, each
would wait for its time-outs behind the others."""

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
"""When the request that is answered had arrived, monotonic seconds; None: it has just now."""


@dataclass(frozen=True)
class _Reading(Generic[T]):
    began: float
    found: T | Ended


class SharedReading(Generic[T]):
    """`read` of a name, which may take long and raises Ended; may be called from any thread."""

    def __init__(self, read: Callable[[str], T], wall: Callable[[], float] = time.monotonic) -> None:
        self._read, self._wall = read, wall
        self._last: dict[str, _Reading[T]] = {}
        self._under_way: set[str] = set()
        self._changed = threading.Condition()

    def of(self, name: str) -> T:
        """What was read after the asking, by whomever. Raises what `read` does."""
        asked = asked_at.get()
        asked = self._wall() if asked is None else asked
        with self._changed:
            self._changed.wait_for(lambda: name not in self._under_way or self._fresh(name, asked))
            last = self._fresh(name, asked)
            if last is None:
                self._under_way.add(name)
        if last is None:
            last = self._anew(name)
        if isinstance(last.found, Ended):
            raise type(last.found)(last.found.reason, last.found.detail)
        return last.found

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
