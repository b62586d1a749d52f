"""Commands, waiting, and what is told."""

import os
import re
import subprocess
import time
from collections.abc import Callable
from typing import Any

GUEST_PATIENCE = 5.0
"""User-mode Linux starts a process that much more slowly, and has one processor for all of them."""
GUEST_LOOKS_EVERY_S = 5.0
"""Each look asks the engine by two processes there, and takes a second of its processor."""


class Wrong(Exception):
    """Something was not as expected."""


def tell(text: str) -> None:
    print(text, flush=True)


def check(what: str, holds: bool, otherwise: str = "") -> None:
    if not holds:
        raise Wrong(f"not so: {what}\n{otherwise}")
    tell(f"ok          {what}")


def expect(what: str, told: str, word: str) -> None:
    """`word` is in one of the lines told, which is shown."""
    lines = [
        re.sub(r"\x1b\[[0-9;]*m", "", line).strip() for line in told.splitlines() if not line.startswith(("Step ", "#"))
    ]
    line = next((line for line in lines if word in line), "")
    check(what, bool(line), told[-2000:])
    tell(f"            {line}")


def until(what: str, found: Callable[[], Any], patience_s: float) -> Any:
    give_up = time.monotonic() + patience_s * (GUEST_PATIENCE if in_uml() else 1.0)
    while time.monotonic() < give_up:
        if value := found():
            return value
        time.sleep(GUEST_LOOKS_EVERY_S if in_uml() else 0.3)
    raise Wrong(f"waited in vain for {what}")


def in_uml() -> bool:
    return os.environ.get("LOOPWRIGHT_VCAN") == "uml"


def works(*command: str) -> bool:
    try:
        return subprocess.run(command, capture_output=True, timeout=120, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def output(*command: str, timeout: float = 600.0) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    if done.returncode != 0:
        raise Wrong(f"{' '.join(command)}: status {done.returncode}\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    return done.stdout


def read_all(*command: str, timeout: float = 60.0) -> str:
    """Both streams, whatever the exit status."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    return done.stdout + done.stderr
