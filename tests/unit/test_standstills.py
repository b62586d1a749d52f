"""A test that fails while the machine stands still is repeated; one that fails on a machine that runs is not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from tests.standstills import STOOD_STILL_S, Standstills

FAILS_ONCE = """
from pathlib import Path
from tests.conftest import *
from tests.unit.test_standstills import children, stopped

def test_that_fails_the_first_time():
    tries = Path({tries!r})
    first = not tries.exists()
    with tries.open("a") as file:
        file.write("x")
    if {stands_still}:
        stopped(children())
    assert not first
"""


def children() -> set[int]:
    """Process-IDs of this process's children."""
    found: set[int] = set()
    for task in Path("/proc/self/task").iterdir():
        with suppress(FileNotFoundError):  # a thread that has just ended
            found |= {int(pid) for pid in (task / "children").read_text().split()}
    return found


def stopped(processes: set[int]) -> None:
    """Lets these processes stand still, and then say that they did."""
    for pid in processes:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(2 * STOOD_STILL_S)
    for pid in processes:
        os.kill(pid, signal.SIGCONT)
    time.sleep(0.5)


def test_a_process_that_is_not_let_run_is_a_standstill() -> None:
    before = children()
    watch = Standstills()
    try:
        began = time.monotonic()
        stopped(children() - before)
        give_up = time.monotonic() + 30.0
        while not watch.longest_s(began) and time.monotonic() < give_up:
            time.sleep(0.01)
        assert watch.longest_s(began) > STOOD_STILL_S
        assert watch.longest_s(time.monotonic()) == 0.0
    finally:
        watch.close()
    assert children() <= before


@pytest.mark.parametrize(("stands_still", "status", "tries"), [(True, 0, 2), (False, 1, 1)])
def test_it_is_repeated_where_the_machine_stood_still(
    tmp_path: Path, stands_still: bool, status: int, tries: int
) -> None:
    file = tmp_path / "tries"
    (tmp_path / "test_it.py").write_text(FAILS_ONCE.format(tries=str(file), stands_still=stands_still))
    command = [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-p", "no:cacheprovider", "-q", "-raR"]
    ran = subprocess.run([*command, str(tmp_path / "test_it.py")], capture_output=True, text=True)
    assert (ran.returncode, len(file.read_text())) == (status, tries), ran.stdout + ran.stderr
    assert ("RERUN" in ran.stdout) == stands_still
