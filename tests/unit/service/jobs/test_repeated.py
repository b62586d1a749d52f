"""A turn that is taken again and again, whatever becomes of one of them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator

import pytest
from sqlalchemy.exc import OperationalError

from loopwright.service.jobs.repeated import Repeated
from loopwright.service.store.lock import FolderInUse
from tests.unit.service.processes import until

NAME = "a thread of this test"


class Turns:
    """ends: how the turns end, one after the other; later ones end well."""

    def __init__(self, *ends: Exception) -> None:
        self.taken, self._ends = 0, iter(ends)

    def __call__(self) -> None:
        self.taken += 1
        for end in self._ends:
            raise end


def alive() -> bool:
    return any(thread.name == NAME for thread in threading.enumerate())


@pytest.fixture(autouse=True)
def nothing_is_left() -> Iterator[None]:
    yield
    assert not alive()


def test_each_turn_is_followed_by_another_until_it_is_closed(caplog: pytest.LogCaptureFixture) -> None:
    away = OperationalError("SELECT", {}, Exception("the server is gone"))
    turns = Turns(away, ValueError("a defect"))
    repeated = Repeated(turns, 0.001, NAME, "the loops were not looked at")
    with caplog.at_level(logging.WARNING):
        repeated.start()
        until(lambda: turns.taken > 4)
    assert not repeated.closed
    repeated.close()
    assert repeated.closed and not alive()
    first, second = caplog.records
    assert first.getMessage().startswith("the loops were not looked at, this is tried again: ") and not first.exc_info
    assert second.getMessage() == "the loops were not looked at, by a defect; this is tried again" and second.exc_info


def test_another_service_does_it_instead() -> None:
    turns = Turns(FolderInUse("another service has this name"))
    repeated = Repeated(turns, 0.001, NAME, "")
    repeated.start()
    until(lambda: not alive())
    assert turns.taken == 1
    repeated.close()


def test_the_first_turn_may_be_waited_for() -> None:
    turns = Turns()
    repeated = Repeated(turns, 3600.0, NAME, "", at_once=False)
    repeated.start()
    until(alive)
    repeated.close()
    assert turns.taken == 0


def test_one_that_was_never_started_is_closed_at_once() -> None:
    turns = Turns()
    Repeated(turns, 0.0, NAME, "").close()
    assert turns.taken == 0
