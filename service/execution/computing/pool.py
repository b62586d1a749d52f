"""The order of the computations, and the handling of a computation that fails.

Each computation has a process of its own, forked from a fork server that has everything loaded (about 10 ms; a spawned
process would load for more than a second, and one forked from the service would inherit its sockets and database). The
known libraries do not fit: concurrent.futures cannot end a single computation; pebble and loky have no intermediate
reports, priorities, pauses or memory limits.
"""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from typing import Generic, TypeVar

from loopwright.service.execution.computing.child import GO_ON, PAUSE, MessageKind, compute
from loopwright.service.execution.computing.limits import (
    MEMORY_OPTION,
    OPTIONS,
    WORDS,
    ComputationKind,
    ComputingLimits,
    at_once,
)
from loopwright.tuning.reasons import Failed, Reason

T = TypeVar("T")
R = TypeVar("R")

NICE = {
    ComputationKind.LIVE: 5, ComputationKind.TUNING: 10, ComputationKind.DRY_RUN: 10, ComputationKind.LOOK: 15,
}  # fmt: skip
_LOOK_S, _LOOK_WAITING_S = 0.1, 0.5
"""Wall time between two checks whether a running computation, or one that waits for its turn, is still wanted, s: fifty
loops may wait at once, and each check takes the interpreter."""
_TRIES = 2
_AGAIN_S = 0.2
_CLOSE_S = 30.0
_KEPT_AWAY = {signal.SIGINT, signal.SIGTERM}

_log = logging.getLogger(__name__)
_bookkeeping = threading.Lock()
"""Guards multiprocessing's set of processes, which is a module variable."""


class NotWanted(Exception):
    """Raised when the result is no longer wanted: the computation was ended, or not started."""


class NoProcess(Failed):
    """Raised when the system provides no process."""


class _Died(Exception):
    """Raised when the process ended without a message."""

    def __init__(self, exitcode: int | None) -> None:
        self.exitcode = exitcode


class _Place:
    """The place of a computation in the order. The pool guards all of it except `turn`."""

    def __init__(self, rank: tuple[ComputationKind, int]) -> None:
        self.rank = rank
        self.turn = threading.Event()
        self.control: Connection | None = None

    def set_turn(self, has_turn: bool) -> None:
        if has_turn == self.turn.is_set():
            return
        if has_turn:
            self.turn.set()
        else:
            self.turn.clear()
        self.tell()

    def tell(self) -> None:
        """Tells the process, if there is one, whether it may run."""
        if self.control is not None:
            with suppress(OSError):  # the process has just ended
                self.control.send_bytes(GO_ON if self.turn.is_set() else PAUSE)


class Pool:
    """Runs at most `max_workers` computations at once, ordered by kind, then by age. The others wait or pause.

    limits: limits of one computation.
    max_workers: at_once() by default.
    """

    def __init__(self, limits: ComputingLimits | None = None, max_workers: int | None = None) -> None:
        self.limits = limits or ComputingLimits()
        self._max_workers = max_workers or at_once()
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["loopwright.service.execution.computing.preload"])
        self._numbers = itertools.count()
        self._places: list[_Place] = []
        self._changed = threading.Condition()
        self._closed = False

    def run(
        self,
        kind: ComputationKind,
        work: Callable[..., T],
        *,
        on_report: Callable[[R], None] | None = None,
        unwanted: Callable[[], bool] = lambda: False,
    ) -> T:
        """Waits for the work and returns its result, or raises its error.

        on_report: receives, in this thread, each value that the work passes to the function it is called with.
        unwanted: asked several times a second; when it returns True, the computation is ended and NotWanted raised.
        Raises Failed(COMPUTATION_LIMIT | COMPUTATION_LOST), NoProcess.
        """
        with self._place(kind) as place:
            for last in range(1, _TRIES + 1):
                while not place.turn.wait(_LOOK_WAITING_S):
                    self._check(unwanted)
                self._check(unwanted)
                forwarder = _ReportForwarder(on_report)
                try:
                    return self._one(kind, work, place, forwarder, unwanted)
                except _Died as died:
                    if died.exitcode == -signal.SIGXCPU:
                        cpu_s = self.limits.cpu_s(kind)
                        text = f"{WORDS[kind]} was ended after {cpu_s:g} s of processor time ({OPTIONS[kind]})"
                        raise Failed(Reason.COMPUTATION_LIMIT, text) from None
                    if last == _TRIES or forwarder.anything:
                        text = f"the process of {WORDS[kind]} was killed (exit {died.exitcode})"
                        raise Failed(Reason.COMPUTATION_LOST, text) from None
                    _log.warning("the process of %s was killed, the computation is repeated", WORDS[kind])
        raise AssertionError("every try returns or raises")

    def submit(
        self, kind: ComputationKind, work: Callable[[], T], unwanted: Callable[[], bool] = lambda: False
    ) -> Future[T]:
        """Runs the work as `run` does, in a thread of its own, and returns its future at once."""
        future: Future[T] = Future()
        future.set_running_or_notify_cancel()  # only `unwanted` ends it

        def wait() -> None:
            try:
                future.set_result(self.run(kind, work, unwanted=unwanted))
            except BaseException as error:
                future.set_exception(error)

        threading.Thread(target=wait, name="computation", daemon=True).start()
        return future

    def close(self) -> None:
        """Ends every computation, and waits until its process has ended."""
        with self._changed:
            self._closed = True
            if not self._changed.wait_for(lambda: not self._places, _CLOSE_S):
                _log.error("%d computations have not ended in %.0f s", len(self._places), _CLOSE_S)

    # -- the order

    @contextmanager
    def _place(self, kind: ComputationKind) -> Iterator[_Place]:
        place = _Place((kind, next(self._numbers)))
        with self._changed:
            self._places.append(place)
            self._arrange()
        try:
            yield place
        finally:
            with self._changed:
                self._places.remove(place)
                self._arrange()
                self._changed.notify_all()

    def _arrange(self) -> None:
        self._places.sort(key=lambda place: place.rank)
        for n, place in reversed(list(enumerate(self._places))):  # those that have to pause first
            place.set_turn(n < self._max_workers)

    def _check(self, unwanted: Callable[[], bool]) -> None:
        if self._closed or unwanted():
            raise NotWanted

    # -- one process

    def _one(
        self,
        kind: ComputationKind,
        work: Callable[..., T],
        place: _Place,
        forwarder: _ReportForwarder[R],
        unwanted: Callable[[], bool],
    ) -> T:
        with self._process(kind, work, place, forwarder.wanted) as (process, connection):
            while True:
                while not connection.poll(_LOOK_S):
                    self._check(unwanted)
                try:
                    message_kind, value = connection.recv()
                except (EOFError, OSError):
                    with _bookkeeping:
                        process.join()
                    raise _Died(process.exitcode) from None
                if message_kind is MessageKind.REPORT:
                    forwarder.report(value)
                    self._check(unwanted)
                elif message_kind is MessageKind.RESULT:
                    result: T = value
                    return result
                elif message_kind is MessageKind.NO_MEMORY:
                    memory = self.limits.memory_mb
                    text = f"{WORDS[kind]} asked for more than {memory} MB of memory ({MEMORY_OPTION})"
                    raise Failed(Reason.COMPUTATION_LIMIT, text)
                else:
                    raise value

    @contextmanager
    def _process(
        self, kind: ComputationKind, work: Callable[..., object], place: _Place, reports: bool
    ) -> Iterator[tuple[ForkServerProcess, Connection]]:
        """Yields the process and its connection; the process is ended with the context. Raises NoProcess, and the
        errors of pickling."""
        limits = self.limits.cpu_s(kind), self.limits.memory_mb, NICE[kind]
        try:
            connection, child_end = multiprocessing.Pipe()
        except OSError as error:
            raise _no_process(kind, error) from error
        with connection:
            with child_end:
                process = self._context.Process(
                    target=compute, args=(child_end, work, reports, *limits), name="computation", daemon=True
                )
                try:
                    _start(process)
                except (OSError, EOFError) as error:
                    raise _no_process(kind, error) from error
            try:
                with self._changed:
                    place.control = connection
                    if not place.turn.is_set():  # the turn was lost while the process was started
                        place.tell()
                yield process, connection
            finally:
                with self._changed:
                    place.control = None
                with _bookkeeping:
                    if process.is_alive():
                        process.kill()
                    process.join()
                    process.close()


class _ReportForwarder(Generic[R]):
    """Passes reports on to `on_report`.

    anything: whether there was a report, so that the work cannot be repeated.
    """

    def __init__(self, on_report: Callable[[R], None] | None) -> None:
        self.wanted = on_report is not None
        self.anything = False
        self._on_report = on_report

    def report(self, value: R) -> None:
        assert self._on_report is not None
        self.anything = True
        self._on_report(value)


def _no_process(kind: ComputationKind, error: Exception) -> NoProcess:
    text = f"no process can be made for {WORDS[kind]} ({type(error).__name__}: {error})"
    return NoProcess(Reason.COMPUTATION_LOST, text)


def _start(process: ForkServerProcess) -> None:
    """Starts a process. Raises OSError, and EOFError where the fork server has died: the next start creates a new
    one."""
    for last_try in (False, False, True):
        try:
            with _bookkeeping, _signals_kept_away():
                process.start()
            return
        except (OSError, EOFError):
            if last_try:
                raise
        time.sleep(_AGAIN_S)


@contextmanager
def _signals_kept_away() -> Iterator[None]:
    """Blocks SIGINT and SIGTERM for the fork server and its children, so that a signal to the process group ends only
    the service, which then ends them. A new process inherits the mask of the thread that starts it."""
    resource_tracker.ensure_running()  # started here, because it would reset the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _KEPT_AWAY)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
