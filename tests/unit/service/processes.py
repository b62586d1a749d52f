"""Waits for conditions and looks at processes, for tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

PATIENCE_S = 120.0
"""Wall time after which a test gives up; a busy machine is no reason to fail."""


def until(condition: Callable[[], object], what: str = "what was waited for") -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up, f"not in {PATIENCE_S:g} s: {what}"
        time.sleep(0.01)


def gone(pid: int) -> bool:
    """It has ended, or is a zombie that nobody has waited for yet."""
    try:
        return "zombie" in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def descendants(pid: int) -> list[int]:
    """The processes that this one has made, and theirs."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (FileNotFoundError, ProcessLookupError):
                continue
    found: list[int] = []
    of = [pid]
    while of:
        of = [child for child, parent in parents.items() if parent in of]
        found += of
    return found
