"""Long computations that run while a loop is stepped."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from typing import Protocol, TypeVar

from loopwright.service.execution.computing.limits import ComputationKind
from loopwright.service.execution.computing.pool import NoProcess, NotWanted
from loopwright.service.loops.loop import Loop, Restored
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Command, Sample, Work
from loopwright.tuning.reasons import Reason

T = TypeVar("T")

HELD_S = 0.3
"""Longest wall time for which a computation may delay a step, s: a fraction of the heartbeat time."""

_SWITCH_S = 0.0005
"""Interpreter switch interval during a computation, s. Python's 5 ms, twice for each SDO, would add up to seconds where
many loops are under test. It is set during computations only: waiting threads wake as often, and with fifty of them
that costs more than it saves."""

_log = logging.getLogger(__name__)
_turn = threading.Lock()


@contextmanager
def _alone() -> Iterator[None]:
    """Admits one computation at a time: in parallel they would not finish sooner, and each would keep the interpreter
    from loops that have a sample or an answer."""
    with _turn:
        usual = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        try:
            yield
        finally:
            sys.setswitchinterval(usual)


class Workers(Protocol):
    """Computes in other processes, as a `Pool` does."""

    def submit(self, kind: ComputationKind, work: Callable[[], T], unwanted: Callable[[], bool]) -> Future[T]: ...


class ComputingLoop:
    """A loop with the computation that runs for it; calls other than `step` are passed on to the loop.

    A real plant continues during a computation. A plant that waits for the service, in memory or run in blocks, is held
    from sample to sample: at full speed a second of arithmetic would be minutes of its time under the relay.
    workers: other processes that compute; None for a thread of this process.
    """

    def __init__(self, loop: Loop, workers: Workers | None = None) -> None:
        self._loop, self._workers = loop, workers
        self.idle = threading.Event()
        self.idle.set()
        self._over = False

    def start(self, work: Work[T]) -> None:
        """Starts a computation; it is the `start_work` of the runner."""
        self.idle.clear()
        if self._workers is None:
            self._beside(work)
            return
        future = self._workers.submit(ComputationKind.LIVE, work.compute, lambda: self._over)
        future.add_done_callback(partial(self._came, work))

    def step(self, commands: Sequence[Command]) -> Sample:
        if not self.idle.is_set() and self._loop.waits:
            self.idle.wait(HELD_S)
        return self._loop.step(commands)

    @property
    def waits(self) -> bool:
        return self._loop.waits

    def read(self, beside_tests: bool = False) -> LoopState:
        return self._loop.read(beside_tests)

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        note_session: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        return self._loop.begin(stop, note_session)

    def hold(self) -> None:
        self._loop.hold()

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        self._over = True  # a computation that runs or waits is not needed any more
        return self._loop.restore(home, session)

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        return self._loop.accept(gains, instead_of)

    def close(self) -> None:
        self._loop.close()

    def _came(self, work: Work[T], future: Future[T]) -> None:
        """Takes the result of the workers; it is called in one of their threads."""
        error = future.exception()
        if isinstance(error, NoProcess):
            _log.warning("%s; the service computes in its own process", error.detail)
            self._beside(work)
            return
        if error is None:
            work.finish(future.result())
        elif not isinstance(error, NotWanted):
            work.fail(error)
        self.idle.set()

    def _beside(self, work: Work[T]) -> None:
        threading.Thread(target=self._do, args=(work,), daemon=True, name="computation").start()

    def _do(self, work: Work[T]) -> None:
        try:
            with _alone():
                if not self._over:
                    work.run()
        finally:
            self.idle.set()
