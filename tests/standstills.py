"""How long the machine itself stood still while a test ran: a virtual one does so for a second now and then.

A process on each processor does nothing but sleep, and says when it was woken late. A test in real time that failed
meanwhile has shown nothing of the product; tests/conftest.py has it run again, twice at most, and names it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

STOOD_STILL_S = 0.25
"""Late by so much, a process that only sleeps was not let run: other processes make it late by a few milliseconds."""

_SLEEPER = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
late_s, parent = float(sys.argv[2]), os.getppid()
print("ready", flush=True)
while os.getppid() == parent:
    asked = time.monotonic()
    time.sleep(0.05)
    late = time.monotonic() - asked - 0.05
    if late > late_s:
        print(late, flush=True)
"""


class Standstills:
    """Watches from its making until `close`."""

    def __init__(self) -> None:
        self._latest: list[tuple[float, float]] = []
        """When each was heard of, on the monotonic clock, and its seconds."""
        self._sleepers = [
            subprocess.Popen(
                [sys.executable, "-c", _SLEEPER, str(processor), str(STOOD_STILL_S)], stdout=subprocess.PIPE, text=True
            )
            for processor in os.sched_getaffinity(0)
        ]
        for sleeper in self._sleepers:
            assert sleeper.stdout is not None and sleeper.stdout.readline() == "ready\n"
            threading.Thread(target=self._listen, args=(sleeper,), daemon=True).start()

    def close(self) -> None:
        for sleeper in self._sleepers:
            sleeper.kill()
            sleeper.wait()

    def longest_s(self, since: float) -> float:
        """The longest standstill that was heard of since that time on the monotonic clock; 0: there was none."""
        return max((late_s for at, late_s in list(self._latest) if at >= since), default=0.0)

    def _listen(self, sleeper: subprocess.Popen[str]) -> None:
        assert sleeper.stdout is not None
        with sleeper.stdout as lines:
            for line in lines:
                self._latest.append((time.monotonic(), float(line)))
