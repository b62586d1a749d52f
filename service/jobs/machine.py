"""What the service has from the machine beside the bus: its clock, and calls that go on beside each other.

Given at the composition root, so that a simulation can run the whole service in one thread on a clock of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import TypeVar

T = TypeVar("T")


class Machine:
    """The clock and the threads of a real process. writes_beside: whether the journal has a thread of its own."""

    writes_beside = True

    def monotonic(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def lock(self) -> AbstractContextManager[object]:
        return threading.Lock()

    def event(self) -> threading.Event:
        return threading.Event()

    def thread(self, run: Callable[[], None], name: str) -> threading.Thread:
        """Not started yet; it ends with the process at the latest."""
        return threading.Thread(target=run, name=name, daemon=True)

    def side_by_side(self, call: Callable[[T], None], items: Iterable[T], max_workers: int) -> None:
        """Returns when the call has been made for each item, so many at a time."""
        with ThreadPoolExecutor(max_workers) as pool:
            for _ in pool.map(call, items):
                pass
