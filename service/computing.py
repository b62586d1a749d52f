"""Long computations beside a loop that is pumped meanwhile."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from service.loop import Loop, LoopState
from tuning.gains import Gains
from tuning.plan import Command, Sample
from tuning.reasons import Reason

HELD_S = 0.3
"""Wall time for which a step may be held up: a part of the heartbeat time."""

_SWITCH_S = 0.0005
"""How long a computation keeps the interpreter from a thread that has an answer of the bus: Python's 5 ms, twice for
each SDO, are seconds where many loops are under test. Only meanwhile, for threads that wait look as often, and of fifty
that takes more than it brings."""

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


class Computing:
    """A loop, and what is being computed for it: steps of the loop go through here, all else to the loop itself.

    A real plant goes on while we compute. One that waits for us, in memory or run in blocks, is held from sample to
    sample: at full speed a second of arithmetic would be minutes of its time under the relay.
    """

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._idle = threading.Event()
        self._idle.set()
        self._over = False

    def start(self, work: Callable[[], None]) -> None:
        """For `start_work` of the runner."""
        self._idle.clear()
        threading.Thread(target=self._do, args=(work,), daemon=True, name="computation").start()

    def step(self, commands: Sequence[Command]) -> Sample:
        if not self._idle.is_set() and self._loop.waits:
            self._idle.wait(HELD_S)
        return self._loop.step(commands)

    @property
    def waits(self) -> bool:
        return self._loop.waits

    def read(self) -> LoopState:
        return self._loop.read()

    def begin(self, stop: Callable[[], Reason | None] = lambda: None) -> LoopState:
        return self._loop.begin(stop)

    def restore(self, state: LoopState) -> LoopState:
        self._over = True  # what still waits for its turn nobody wants any more
        return self._loop.restore(state)

    def accept(self, gains: Gains) -> LoopState:
        return self._loop.accept(gains)

    def close(self) -> None:
        self._loop.close()

    def _do(self, work: Callable[[], None]) -> None:
        try:
            with _alone():
                if not self._over:
                    work()
        finally:
            self._idle.set()
