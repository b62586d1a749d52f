"""The program of one computation's process: it keeps to its limits, pauses on request, and ends with the service.

Messages to the service are pairs of a `MessageKind` and a value; messages from the service are PAUSE or GO_ON.
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

from loopwright.service.execution.computing.limits import MB

PAUSE, GO_ON = b"pause", b"go on"
_FIRST_TO_DIE = "500"
"""Value of oom_score_adj: when the system has no memory left, it ends a computation before the service."""


class MessageKind(Enum):
    """The meaning of the value in a message of a computation."""

    REPORT = auto()
    RESULT = auto()
    ERROR = auto()
    NO_MEMORY = auto()


def compute(
    connection: Connection, work: Callable[..., object], reports: bool, cpu_s: float, memory_mb: int, niceness: int
) -> None:
    """Runs a computation; it is the main function of the process.

    reports: whether `work` is called with a function that takes intermediate reports.
    cpu_s, memory_mb, niceness: limits of processor time (s) and memory (MB), and the priority.
    """
    _keep_to(cpu_s, memory_mb, niceness)
    warnings.simplefilter("ignore")  # overflows and the like show in the result
    attendant = _Attendant(connection)
    attendant.start()
    try:
        value = work(lambda report: attendant.send(MessageKind.REPORT, report)) if reports else work()
        message: tuple[MessageKind, object] = (MessageKind.RESULT, value)
    except (MemoryError, SystemError):  # the interpreter raises SystemError where memory was refused
        message = (MessageKind.NO_MEMORY, None)
    except BaseException as error:
        message = (MessageKind.ERROR, error)
    with suppress(BrokenPipeError):
        try:
            attendant.send(*message)
        except BrokenPipeError:
            raise
        except Exception as error:  # a result or an error that cannot be pickled
            attendant.send(MessageKind.ERROR, RuntimeError(f"{type(error).__name__}: {error}"))


def _keep_to(cpu_s: float, memory_mb: int, niceness: int) -> None:
    """Sets the limits: the kernel ends the process by SIGXCPU at the end of its processor time, and refuses memory
    beyond the limit.

    RLIMIT_DATA counts all private memory that is requested, in use or not. RLIMIT_AS would also count memory that is
    only mapped (libraries, reserved stacks); a measured RSS would be checked only when the machine has no memory left.
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
    """Returns the memory of this process that RLIMIT_DATA counts, bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData:"))


class _Attendant(threading.Thread):
    """Listens to the service while the main thread computes; a signal handler pauses the main thread.

    SIGSTOP would stop this thread too, and a stopped process could not end with a service that is killed.
    """

    def __init__(self, connection: Connection) -> None:
        super().__init__(daemon=True)
        self._connection = connection
        self._may_run = threading.Event()
        self._may_run.set()
        self._sending = False
        signal.signal(signal.SIGUSR1, self._hold)

    def send(self, message_kind: MessageKind, value: object) -> None:
        """Sends a message, in the main thread. A pause falls before or after a message, never within one: the receiver
        would wait for the rest."""
        self._sending = True
        try:
            self._connection.send((message_kind, value))
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
            os._exit(0)  # the service is gone, or no longer needs the result

    def _hold(self, _signal: int, _frame: FrameType | None) -> None:
        if not self._sending:
            self._may_run.wait()
