"""The handling of SIGTERM and SIGINT, from the start of the service until all of it has ended."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable
from queue import SimpleQueue
from types import FrameType
from typing import Any, Self

_log = logging.getLogger(__name__)


class Signals:
    """Handles the signals: the first asks the service to end. A further one does not shorten the end, because loops are
    being restored; the log says what the service waits for. Once everything has ended, a further one ends the process,
    with success."""

    def __init__(self) -> None:
        self._asked = False
        self._end: Callable[[], None] = lambda: None
        self._awaited: Callable[[], str] = lambda: "it has not started yet"
        # A signal may interrupt any code: logging uses locks, this queue uses none.
        self._heard: SimpleQueue[tuple[int, str] | None] = SimpleQueue()
        self._reporter: threading.Thread | None = None

    def __enter__(self) -> Self:
        self._before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._before = {each: signal.signal(each, self._hear) for each in (signal.SIGTERM, signal.SIGINT)}
        return self

    def __exit__(self, *_: object) -> None:
        if self._reporter is not None:
            self._heard.put(None)
            self._reporter.join()
        for each, handler in self._before.items():
            signal.signal(each, _leave if self._asked else handler)

    def tell(self, end: Callable[[], None], awaited: Callable[[], str]) -> None:
        """Calls `end` when a signal comes, or has come already.

        awaited: returns what the end of the service waits for, in words, and takes no lock. It is asked before `end` is
        called, as what is under test may be restored a moment later.
        """
        self._end, self._awaited = end, awaited
        self._reporter = threading.Thread(target=self._report, name="signals", daemon=True)
        self._reporter.start()
        if self._asked:
            end()

    def _hear(self, number: int, _frame: FrameType | None) -> None:
        self._heard.put((number, self._awaited()))
        if not self._asked:
            self._asked = True
            self._end()

    def _report(self) -> None:
        first = True
        while (heard := self._heard.get()) is not None:
            number, awaited = heard
            name = signal.Signals(number).name
            if first:
                _log.info("%s: the service ends; %s", name, awaited)
            else:
                _log.warning("%s again: the service is ending, and is not cut short; %s", name, awaited)
            first = False


def _leave(_signal: int, _frame: FrameType | None) -> None:
    """Ends the process at once: the service has ended, whatever may still delay the interpreter."""
    os._exit(0)
