from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.registry import Registry
from tests.unit.service.fakes import TAG, FakeLoop, Service


class Interrupted(Machine):
    """Another thread asks for the lock of the same loop just as it is being made."""

    def __init__(self) -> None:
        self.directory: LoopDirectory | None = None
        self.others: list[AbstractContextManager[Any]] = []

    def lock(self) -> AbstractContextManager[Any]:
        if not self.others and self.directory is not None:
            self.others.append(super().lock())
            self.others[0] = self.directory.alone_with(TAG)
        return super().lock()


def test_a_loop_has_one_lock_also_for_two_who_ask_at_the_same_time(service: Service) -> None:
    machine = Interrupted()
    machine.directory = LoopDirectory(
        service.loops, service.store, lambda config: FakeLoop(service.controller), Registry(), machine
    )
    lock = machine.directory.alone_with(TAG)
    assert machine.others == [lock] and machine.directory.alone_with(TAG) is lock
    assert machine.directory.alone_with("FIC-2") is not lock
