"""The imports of a process that then serves for long, done without garbage collections."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Imports without garbage collections, and keeps what was loaded out of all later ones.

    While modules are loaded next to nothing becomes garbage, and each collection goes through everything loaded so far:
    a tenth of the processor time of a start.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()
