"""The arenas of the C library, counted by the C library itself in a process with many threads."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from loopwright.service.server.arenas import ARENAS, VARIABLE

_THREADS_THAT_ALLOCATE = """
import ctypes, threading
from loopwright.service.server.arenas import limit_arenas

if {limited}:
    limit_arenas()
library = ctypes.CDLL(None)
library.malloc.restype = library.fdopen.restype = ctypes.c_void_p
all_there = threading.Barrier(6)

def allocate():
    all_there.wait()  # each thread lives while the others allocate, so that none takes over the arena of another
    library.malloc(5000)
    all_there.wait()

threads = [threading.Thread(target=allocate) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
out = library.fdopen(1, b"w")
library.malloc_info(0, ctypes.c_void_p(out))
library.fflush(ctypes.c_void_p(out))
"""


def arenas(limited: bool, **environment: str) -> int:
    code = _THREADS_THAT_ALLOCATE.format(limited=limited)
    clean = {name: value for name, value in os.environ.items() if name != VARIABLE}
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=clean | environment
    )
    return ran.stdout.count("<heap nr=")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
class TestArenas:
    def test_are_two_for_any_number_of_threads(self) -> None:
        assert arenas(limited=False) > ARENAS
        assert arenas(limited=True) == ARENAS

    def test_are_those_of_the_environment_where_it_says_so(self) -> None:
        assert arenas(limited=True, MALLOC_ARENA_MAX="3") == 3
