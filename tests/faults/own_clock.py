"""Runs a module in a process whose wall clock is the machine's plus the seconds in a file, read at every question:

    python -m tests.faults.own_clock FILE MODULE ARGS

The clock is that of Python (time.time, datetime.now), which is what the service and its libraries ask. The monotonic
one stays the machine's, as it does when somebody sets a real clock. Debian's libfaketime would reach further, but
makes Python's sleep fail when it is to leave the monotonic clock alone (0.9.10, Python 3.11).
"""

from __future__ import annotations

import datetime
import runpy
import sys
import time
from pathlib import Path


def install(file: Path) -> None:
    """Before anything else imports datetime."""
    real, real_ns = time.time, time.time_ns

    def offset_s() -> float:
        try:
            return float(file.read_text() or 0.0)
        except FileNotFoundError:
            return 0.0

    class Datetime(datetime.datetime):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> Datetime:
            return cls.fromtimestamp(time.time(), tz)

        @classmethod
        def utcnow(cls) -> Datetime:
            return cls.fromtimestamp(time.time(), datetime.UTC).replace(tzinfo=None)

    time.time = lambda: real() + offset_s()
    time.time_ns = lambda: real_ns() + int(offset_s() * 1e9)
    datetime.datetime = Datetime  # type: ignore[misc]


if __name__ == "__main__":
    _, own_file, module, *arguments = sys.argv
    install(Path(own_file))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
