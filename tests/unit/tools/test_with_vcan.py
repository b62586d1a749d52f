"""The watchdog of tools/with-vcan: a guest that has stalled is ended, and one that computes or waits is not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[3]
IDLE = 0.0018
"""What a guest in which everything sleeps takes of the processor."""


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Loaded as a module; it has no .py in its name."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = SourceFileLoader("with_vcan", str(ROOT / "tools/with-vcan"))
    spec = spec_from_loader("with_vcan", loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield module
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("share", "patience_s", "stalls"),
    [(0.0, 300.0, True), (IDLE / 5, 300.0, False), (IDLE, 300.0, False), (IDLE, 30.0, False), (0.0, 0.0, False)],
)
def test_a_guest_has_stalled_when_it_takes_far_less_than_one_that_only_waits(
    tool: ModuleType, share: float, patience_s: float, stalls: bool
) -> None:
    watch = tool.Stall(patience_s, 1000.0)
    seen = [watch.seen(1000.0 + s, 40.0 + share * s) for s in range(5, 3600, 5)]
    assert any(seen) == stalls
    assert not any(seen[: int(patience_s / 5) - 1])  # nobody is ended before the patience is over


def test_one_that_stalls_later_is_seen_then(tool: ModuleType) -> None:
    watch = tool.Stall(300.0, 0.0)
    assert not any(watch.seen(float(s), 0.5 * s) for s in range(5, 1001, 5))
    assert not watch.seen(1295.0, 500.0) and watch.seen(1300.0, 500.0)


def test_the_processor_time_is_that_of_the_whole_family(tool: ModuleType) -> None:
    burn = "import time\nwhile time.process_time() < 0.3: pass\n"
    tree = f"import subprocess, sys, time\n{burn}subprocess.run([sys.executable, '-c', {burn + 'time.sleep(100)'!r}])"
    with subprocess.Popen([sys.executable, "-c", tree], start_new_session=True) as process:
        try:
            until = time.monotonic() + 100.0
            while tool.processor_s(process.pid) < 0.55:
                assert time.monotonic() < until
                time.sleep(0.05)
        finally:
            tool.os.killpg(process.pid, signal.SIGKILL)


def test_a_guest_that_stalls_is_ended_with_a_sentence(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tool, "LOOK_S", 0.05)
    guest = subprocess.Popen(["sleep", "1000"], start_new_session=True)
    assert tool.wait(guest, 100.0, stall=0.3) == tool.STALLED == 123
    assert guest.poll() == -signal.SIGKILL
    assert "user-mode Linux has stalled: it has used no processor time for 0.3 s" in capsys.readouterr().err


def test_other_ends_are_as_they_were(tool: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool, "LOOK_S", 0.05)

    def status(script: str, timeout: float) -> int:
        guest = subprocess.Popen(["sh", "-c", script], start_new_session=True)
        return int(tool.wait(guest, timeout, stall=90.0))

    assert status("exit 7", 100.0) == 7
    assert status("sleep 0.2; exit 0", 100.0) == 0
    assert status("kill -TERM $$", 100.0) == 128 + signal.SIGTERM
    assert status("sleep 1000", 0.2) == tool.TIME_IS_UP


@pytest.mark.parametrize(
    ("options", "ends", "status", "runs"),
    [
        (["--again"], [123, 0], 0, 2),
        (["--again"], [123, 1], 1, 2),
        (["--again"], [123, 123], 123, 2),
        (["--again"], [1], 1, 1),
        ([], [123], 123, 1),
    ],
)
def test_it_is_started_again_once_where_that_was_asked_for(
    tool: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    ends: list[int],
    status: int,
    runs: int,
) -> None:
    commands: list[list[str]] = []

    def guest(command: list[str], timeout: float, memory_mib: int, stall: float, first: bool) -> int:
        commands.append(command)
        return ends[len(commands) - 1]

    monkeypatch.setattr(tool, "vcan_is_up", lambda: False)
    monkeypatch.setattr(tool, "works", lambda command: False)
    monkeypatch.setattr(tool, "run_in_uml", guest)
    monkeypatch.setattr(sys, "argv", ["with-vcan", *options, "--", "true"])
    assert tool.main() == status
    assert commands == [["true"]] * runs
    assert ("ONCE MORE, from the beginning" in capsys.readouterr().err) == (runs == 2)


@pytest.mark.parametrize("permitted", [True, False])
def test_the_guest_goes_first_where_the_user_may_do_that(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch, permitted: bool
) -> None:
    asked: list[tuple[int, int, int]] = []

    def scheduled(process: int, policy: int, parameter: os.sched_param) -> None:
        asked.append((process, policy, parameter.sched_priority))
        if not permitted:
            raise PermissionError

    monkeypatch.setattr(tool, "one_processor", lambda: None)
    monkeypatch.setattr(os, "sched_setscheduler", scheduled)
    tool.first_on_one_processor()
    assert asked == [(0, os.SCHED_RR, 1)]
