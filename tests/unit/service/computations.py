"""What the tests compute in other processes, which have little to load for it."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from loopwright.tuning.reasons import Reason, Refused


def refuse() -> None:
    raise Refused(Reason.NOT_ROBUST, "Ms 3")


def die_once(mark: Path) -> int:
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 7


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def burn(mark: Path | None = None) -> None:
    """Until somebody ends it. mark: of what runs the process ID is written there."""
    if mark is not None:
        mark.write_text(str(os.getpid()))
    while True:
        pass


def count(ticks: Path, over: Path) -> str:
    """Counts for as long as it may run."""
    n = 0
    while not over.exists():
        n += 1
        ticks.write_text(str(n))
    return "counted"


def ask_for(megabytes: int) -> int:
    return len(bytearray(megabytes << 20))


def tell_numbers(to: int, report: Callable[[int], None]) -> str:
    for n in range(to):
        report(n)
    return "told"


def tell_and_die(report: Callable[[int], None]) -> None:
    report(1)
    die()


def modules() -> set[str]:
    return set(sys.modules)


def own_files() -> list[str]:
    found = []
    for entry in os.listdir("/proc/self/fd"):
        try:
            found.append(os.readlink(f"/proc/self/fd/{entry}"))
        except OSError:
            continue  # the folder itself
    return found
