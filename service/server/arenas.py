"""The C library's memory of a process with many threads."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress

ARENAS = 2
"""Number of arenas of the C library: of the threads of this process, one runs at a time."""
_M_ARENA_MAX = -8
VARIABLE = "MALLOC_ARENA_MAX"


def limit_arenas() -> None:
    """Limits the number of arenas from which glibc serves the threads of this process.

    glibc gives each new thread an arena of its own, up to eight for each processor, and keeps what was freed in it: the
    memory of a service whose requests and tests come and go then grows for hours. The number that is in the environment
    stays. Where the C library is another one, this function does nothing.
    """
    if VARIABLE in os.environ:
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, ARENAS)
