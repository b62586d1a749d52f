"""The end of a command that runs processes of its own: SIGINT, SIGTERM and SIGHUP as one exception."""

from __future__ import annotations

import os
import signal
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_OUTPUT = (1, 2)


class Interrupted(KeyboardInterrupt):
    """Raised in the main thread by one of the signals."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class Interruption:
    """Raises Interrupted for each of the signals within its context, which is entered in the main thread.

    After `ignore` further signals change nothing: what is being ended is ended. They also change nothing after the
    context once a signal has come, so that a second one does not turn the end into an error.
    A closed terminal makes errors before its SIGHUP is heard: output fails, and processes of the terminal end. Where
    one comes by the end of the context, Interrupted takes the place of the error.
    SIGHUP stays ignored where this process was started to ignore it, as by nohup.
    """

    def __init__(self) -> None:
        self._held = self._ignored = self._heard = self._hung_up = False
        self._pending: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for each in _SIGNALS:
            before = signal.getsignal(each)
            if each != signal.SIGHUP or before is not signal.SIG_IGN:
                self._before[each] = before
                signal.signal(each, self._hear)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        for each, before in self._before.items():
            signal.signal(each, signal.SIG_IGN if self._heard else before)
        if self._hung_up and isinstance(error, Exception):
            raise Interrupted(signal.SIGHUP) from error

    def ignore(self) -> None:
        """Lets no signal interrupt what follows."""
        self._ignored = True

    @contextmanager
    def held(self) -> Iterator[None]:
        """Delays the exception to the end of the context: a process that is started is noted before it is raised.

        It takes the place of an error of the context: a closed terminal ends the processes that are waited for as well.
        """
        self._held = True
        try:
            yield
        finally:
            self._held = False
            if self._pending is not None and not self._ignored:
                raise Interrupted(self._pending)

    def _hear(self, number: int, _frame: FrameType | None) -> None:
        self._heard = True
        if number == signal.SIGHUP:
            self._hung_up = True
            _leave_terminal()
        if self._held:
            self._pending = number
        elif not self._ignored:
            raise Interrupted(number)


def _leave_terminal() -> None:
    """Sends what is printed from now on nowhere: the terminal is closed, and each line would be an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for output in _OUTPUT:
        if stat.S_ISCHR(os.fstat(output).st_mode):
            os.dup2(nowhere, output)
    os.close(nowhere)
