"""The listening process as the service keeps it: a slow beginning is waited for, one that hangs is replaced."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from loopwright.service.listening.messages import Report
from loopwright.service.listening.process import ListeningProcess
from tests.unit.service.processes import until

HANGS_S = 5.0


class Kept:
    """A process that listens to nothing, and its reports."""

    def __init__(self) -> None:
        self.reports: list[Report] = []
        self.process = ListeningProcess({}, self.reports.append, first_pause_s=0.1)
        self.process.start()
        until(lambda: self.process.pid is not None)

    @property
    def pid(self) -> int:
        assert self.process.pid is not None
        return self.process.pid


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> Iterator[Kept]:
    monkeypatch.setattr("loopwright.service.listening.process._HANGS_S", HANGS_S)
    kept = Kept()
    with closing(kept.process):
        yield kept


def test_one_that_is_slow_to_begin_is_waited_for(kept: Kept) -> None:
    """On a busy machine, where its low priority gives it next to nothing, it was ended again and again as it loaded."""
    first = kept.pid
    os.kill(first, signal.SIGSTOP)
    stopped = time.monotonic()
    until(lambda: time.monotonic() - stopped > HANGS_S + 2.0)
    os.kill(first, signal.SIGCONT)
    until(lambda: kept.reports)
    assert kept.pid == first


def test_one_that_hangs_is_replaced(kept: Kept) -> None:
    until(lambda: kept.reports)
    first = kept.pid
    os.kill(first, signal.SIGSTOP)
    until(lambda: kept.pid != first)
    os.kill(kept.pid, 0)  # there is another one
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
