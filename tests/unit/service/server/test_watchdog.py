"""systemd hears that all is well while the event loop turns and the jobs are watched, and else nothing."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
import time
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.cli.child_process import ChildProcess
from loopwright.service.server import watchdog
from loopwright.service.server.watchdog import Watchdog, interval_s
from tests.unit.service.fakes import TAG, Service


@pytest.mark.parametrize(
    ("environment", "found"),
    [
        ({}, None), ({"WATCHDOG_USEC": "90000000"}, 30.0), ({"WATCHDOG_USEC": "90000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 1.0), ({"WATCHDOG_USEC": "x"}, None),
    ],
)  # fmt: skip
def test_how_often(environment: dict[str, str], found: float | None) -> None:
    assert interval_s(environment) == found


def well(late_s: float, ping: object) -> bool:
    def answer() -> None:
        if isinstance(ping, Exception):
            raise ping
        if isinstance(ping, threading.Event):
            ping.wait(60)

    return asyncio.run(Watchdog(lambda: late_s, answer, lambda state: None).well())


def test_jobs_that_are_watched_are_well_whatever_the_database_does() -> None:
    assert well(1.0, OperationalError("", {}, Exception("away")))


def test_jobs_that_are_not_watched_are_well_only_while_the_database_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not well(watchdog.LATE_S + 1, None)
    assert well(watchdog.LATE_S + 1, OperationalError("", {}, Exception("away")))
    monkeypatch.setattr(watchdog, "PING_S", 0.05)
    never = threading.Event()
    threading.Timer(1.0, never.set).start()
    assert not well(watchdog.LATE_S + 1, never)


def test_a_watcher_that_hangs_is_told_by_silence(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "LATE_S", 1.0)
    told: list[str] = []
    hangs = threading.Event()
    dog = Watchdog(service.jobs.unwatched_s, service.store.ping, told.append)
    assert asyncio.run(dog.well())
    monkeypatch.setattr(service.store, "stop_requests", lambda: hangs.wait(60) and {})
    deadline = time.monotonic() + 30
    while asyncio.run(dog.well()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not asyncio.run(dog.well())

    async def a_while() -> None:
        turns = asyncio.create_task(dog.run(0.01))
        await asyncio.sleep(0.2)
        turns.cancel()

    asyncio.run(a_while())
    assert told == []
    hangs.set()
    while not asyncio.run(dog.well()) and time.monotonic() < deadline:
        time.sleep(0.05)
    asyncio.run(a_while())
    assert set(told) == {"WATCHDOG=1"}


@pytest.mark.timeout(300)
def test_a_service_says_so_again_and_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(120)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "300000")
        process = ChildProcess(
            "gateway", ("tests.unit.service.gateway", str(tmp_path), f"--tag={TAG}"), tmp_path / "log"
        )
        try:
            assert [systemd.recv(100) for _ in range(4)] == [b"READY=1", *[b"WATCHDOG=1"] * 3]
        finally:
            process.stop()
