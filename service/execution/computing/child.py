"""What runs in the process of one computation: it keeps to its limits, pauses when told to, and ends with the service.

Messages to the service are pairs of a `Said` and a value; messages from the service are one of PAUSE and GO_ON.
"""

from __future__ import annotations

import math
import os
import resource
import signal
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from enum import Enum, auto
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any

from loopwright.service.execution.computing.limits import MB

PAUSE, GO_ON = b"pause", b"go on"
_FIRST_TO_DIE = "500"
"""Of the system when it has no memory left: rather a computation than the service."""


class Said(Enum):
    """What a message of a computation says of its value."""

    REPORT = auto()
    RESULT = auto()
    ERROR = auto()
    NO_MEMORY = auto()


def compute(
    connection: Connection, work: Callable[..., Any], reports: bool, cpu_s: float, memory_mb: int, niceness: int
) -> None:
    """The process. reports: `work` is called with a function that takes what it reports on its way."""
    _keep_to(cpu_s, memory_mb, niceness)
    warnings.simplefilter("ignore")  # of overflows and the like: the result says what came of them
    attendant = _Attendant(connection)
    attendant.start()
    try:
        value = work(lambda report: attendant.send(Said.REPORT, report)) if reports else work()
        message: tuple[Said, Any] = (Said.RESULT, value)
    except (MemoryError, SystemError):  # SystemError: of the interpreter itself where memory was refused
        message = (Said.NO_MEMORY, None)
    except BaseException as error:
        message = (Said.ERROR, error)
    with suppress(BrokenPipeError):
        try:
            attendant.send(*message)
        except BrokenPipeError:
            raise
        except Exception as error:  # a result or an error that cannot be pickled
            attendant.send(Said.ERROR, RuntimeError(f"{type(error).__name__}: {error}"))


def _keep_to(cpu_s: float, memory_mb: int, niceness: int) -> None:
    """The kernel ends the process by SIGXCPU at the end of its processor time, and refuses memory beyond the limit.

    RLIMIT_DATA: all private memory that is asked for, whether it is in use yet or not. RLIMIT_AS would count what is
    only mapped too (libraries, reserved stacks); a measured RSS would be looked at when the machine has none left.
    """
    os.setpriority(os.PRIO_PROCESS, 0, max(niceness, os.getpriority(os.PRIO_PROCESS, 0)))
    _lower(resource.RLIMIT_CORE, 0)
    _lower(resource.RLIMIT_CPU, math.ceil(cpu_s))
    with suppress(FileNotFoundError):  # without /proc
        _lower(resource.RLIMIT_DATA, _data_bytes() + memory_mb * MB)
    with suppress(OSError):  # where it may not be written
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_DIE)


def _lower(which: int, limit: int) -> None:
    _, hard = resource.getrlimit(which)
    resource.setrlimit(which, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _data_bytes() -> int:
    """What this process has of what RLIMIT_DATA counts."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData:"))


class _Attendant(threading.Thread):
    """Hears the service beside the computation, which is in the main thread and is stopped there by a signal's handler.

    SIGSTOP would hold this thread, too: what is stopped could not end with a service that is killed.
    """

    def __init__(self, connection: Connection) -> None:
        super().__init__(daemon=True)
        self._connection = connection
        self._may_run = threading.Event()
        self._may_run.set()
        self._sending = False
        signal.signal(signal.SIGUSR1, self._hold)

    def send(self, said: Said, value: object) -> None:
        """In the main thread. It pauses before a message or behind it: who has half of one waits for the rest."""
        self._sending = True
        try:
            self._connection.send((said, value))
        finally:
            self._sending = False
        self._may_run.wait()

    def run(self) -> None:
        try:
            while True:
                if self._connection.recv_bytes() == PAUSE:
                    self._may_run.clear()
                    signal.raise_signal(signal.SIGUSR1)
                else:
                    self._may_run.set()
        except (EOFError, OSError):
            os._exit(0)  # the service is gone, or wants no result any more

    def _hold(self, _signal: int, _frame: FrameType | None) -> None:
        if not self._sending:
            self._may_run.wait()
