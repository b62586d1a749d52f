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
        # A signal may interrupt any code: logging uses locks, this queue uses none.
        self._heard: SimpleQueue[int | None] = SimpleQueue()
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
        """Has `end` called by a thread of its own at each signal; where one has come already, before this returns.

        end: may be called several times.
        awaited: returns what the end of the service waits for, in words, at once. A signal that comes later has it
        called before `end`: what was under test when the signal came may be restored a moment later.
        """
        if self._asked:
            end()
        self._reporter = threading.Thread(target=self._report, args=(end, awaited), name="signals", daemon=True)
        self._reporter.start()

    def _hear(self, number: int, _frame: FrameType | None) -> None:
        self._asked = True
        self._heard.put(number)

    def _report(self, end: Callable[[], None], awaited: Callable[[], str]) -> None:
        first = True
        while (number := self._heard.get()) is not None:
            name = signal.Signals(number).name
            words = "what it waits for is not known"
            try:
                words = awaited()
            except Exception:
                _log.exception("%s: what the end of the service waits for could not be found out", name)
            try:
                end()
            except Exception:
                _log.exception("%s: the end of the service could not be begun; a further signal tries again", name)
                continue
            if first:
                _log.info("%s: the service ends; %s", name, words)
            else:
                _log.warning("%s again: the service is ending, and is not cut short; %s", name, words)
            first = False


def _leave(_signal: int, _frame: FrameType | None) -> None:
    """Ends the process at once: the service has ended, whatever may still delay the interpreter."""
    os._exit(0)
