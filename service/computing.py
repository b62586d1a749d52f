"""Long computations beside a loop that is pumped meanwhile."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from typing import Any

from service.loop import Loop, LoopState, Restored
from tuning.gains import Gains
from tuning.plan import Command, Sample, Work
from tuning.reasons import Reason

HELD_S = 0.3
"""Wall time for which a step may be held up: a part of the heartbeat time."""
MOST_WORKERS = 4
NICE = 5

_SWITCH_S = 0.0005
"""How long a computation keeps the interpreter from a thread that has an answer of the bus: Python's 5 ms, twice for
each SDO, are seconds where many loops are under test. Only meanwhile, for threads that wait look as often, and of fifty
that takes more than it brings."""

_log = logging.getLogger(__name__)
_turn = threading.Lock()


@contextmanager
def _alone() -> Iterator[None]:
    """One computation at a time: side by side they would not be ready sooner, and each would keep the interpreter from
    loops that have a sample or an answer."""
    with _turn:
        usual = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        try:
            yield
        finally:
            sys.setswitchinterval(usual)


class Workers:
    """Processes that compute for the loops of this one, which needs its interpreter for the bus.

    To be made before the process has threads: they are forked, and so have loaded what they need. What has killed one
    ends them all; from then on computations are done here.
    """

    def __init__(self, count: int | None = None) -> None:
        # before the fork, so that the first computation does not wait for it
        import tuning.fast.procedure
        import tuning.five_stage  # noqa: F401

        count = count or max(1, min(MOST_WORKERS, (os.cpu_count() or 1) - 1))
        self._pool = ProcessPoolExecutor(count, multiprocessing.get_context("fork"), _begin)
        self._pool.submit(os.getpid).result()
        # When one has died the pool ends the others by SIGTERM, which they do not heed, and (from Python 3.12 on) waits
        # for them with a lock that `submit` needs.
        for process in self._pool._processes.values():
            process.terminate = process.kill  # type: ignore[method-assign]

    def submit(self, compute: Callable[[], Any]) -> Future[Any]:
        """Raises BrokenExecutor."""
        return self._pool.submit(compute)

    def close(self) -> None:
        """At once: what is being computed nobody wants any more."""
        processes = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()


def _begin() -> None:
    """In the worker: it ends with the service, whatever ends that, and by nothing else."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICE)

    def outlive() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        wait([parent.sentinel])
        os._exit(0)

    threading.Thread(target=outlive, daemon=True).start()


class Computing:
    """A loop, and what is being computed for it: steps of the loop go through here, all else to the loop itself.

    A real plant goes on while we compute. One that waits for us, in memory or run in blocks, is held from sample to
    sample: at full speed a second of arithmetic would be minutes of its time under the relay.
    workers: who computes; None: a thread of this process.
    """

    def __init__(self, loop: Loop, workers: Workers | None = None) -> None:
        self._loop, self._workers = loop, workers
        self._idle = threading.Event()
        self._idle.set()
        self._over = False

    def start(self, work: Work[Any]) -> None:
        """For `start_work` of the runner."""
        self._idle.clear()
        if self._workers is None:
            self._beside(work)
            return
        try:
            future = self._workers.submit(work.compute)
        except BrokenExecutor:
            self._beside(work)
        else:
            future.add_done_callback(partial(self._came, work))

    def step(self, commands: Sequence[Command]) -> Sample:
        if not self._idle.is_set() and self._loop.waits:
            self._idle.wait(HELD_S)
        return self._loop.step(commands)

    @property
    def waits(self) -> bool:
        return self._loop.waits

    def read(self, beside_tests: bool = False) -> LoopState:
        return self._loop.read(beside_tests)

    def begin(
        self,
        stop: Callable[[], Reason | None] = lambda: None,
        remember: Callable[[int], None] = lambda session: None,
    ) -> LoopState:
        return self._loop.begin(stop, remember)

    def restore(self, home: LoopState, session: int | None = None) -> Restored:
        # What still waits for its turn nobody wants any more. In a worker it is computed in vain: a pool that breaks
        # with a cancelled future in its queue gives no word of what is behind it.
        self._over = True
        return self._loop.restore(home, session)

    def accept(self, gains: Gains, instead_of: Gains) -> LoopState:
        return self._loop.accept(gains, instead_of)

    def close(self) -> None:
        self._loop.close()

    def _came(self, work: Work[Any], future: Future[Any]) -> None:
        """From the workers; called in a thread of theirs."""
        if future.cancelled():  # the service ends
            self._idle.set()
        elif isinstance(error := future.exception(), BrokenExecutor):
            _log.warning("a worker has died; computations are done in the service from now on")
            self._beside(work)
        else:
            if error is not None:
                work.fail(error)
            else:
                work.finish(future.result())
            self._idle.set()

    def _beside(self, work: Work[Any]) -> None:
        threading.Thread(target=self._do, args=(work,), daemon=True, name="computation").start()

    def _do(self, work: Work[Any]) -> None:
        try:
            with _alone():
                if not self._over:
                    work.run()
        finally:
            self._idle.set()
