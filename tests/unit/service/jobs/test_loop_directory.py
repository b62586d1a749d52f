from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import pytest

from loopwright.service.jobs.active_job import Running
from loopwright.service.jobs.loop_directory import LoopDirectory
from loopwright.service.jobs.machine import Machine
from loopwright.service.jobs.registry import Registry
from loopwright.service.loops.observed_loop import ObservedLoop
from loopwright.tuning.plan import SetSetpoint
from tests.unit.service.fakes import TAG, FakeLoop, Service
from tests.unit.service.processes import until


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


def test_what_a_job_knows_of_its_loop_has_the_time_at_which_it_learnt_it(service: Service) -> None:
    wall = iter((10.0, 20.0, 30.0, 40.0))
    loop = ObservedLoop(FakeLoop(service.controller), lambda: next(wall))
    registry, running = Registry(), Running("J", TAG, service.jobs.journal)
    running.loop = loop
    registry.enter(running)
    directory = LoopDirectory(service.loops, service.store, lambda config: loop, registry, Machine())
    assert directory.in_effect(TAG) is None
    home, found = loop.read(), []
    for do in (lambda: loop.begin(), lambda: loop.step([SetSetpoint(51.0)]), lambda: loop.restore(home)):
        found.append(directory.in_effect(TAG))
        do()
    found.append(directory.in_effect(TAG))
    known = [each and (each.began_s, each.sp) for each in found]
    assert known == [(10.0, 50.0), (20.0, 50.0), (30.0, 51.0), (40.0, 50.0)]


def test_a_loop_whose_job_has_ended_is_read_while_the_end_waits_for_the_database(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = service.jobs.running(service.under_test())
    assert running is not None
    with monkeypatch.context() as away:
        away.setattr(service.jobs.journal, "flush", lambda patience_s: False)
        service.tune.hold.set()
        until(lambda: not service.controller.session, "the end of the session")
        service.controller.state = replace(service.controller.state, sp=53.0)
        until(lambda: (found := service.jobs.directory.in_effect(TAG)) and found.sp == 53.0, "the set-point")
        assert not running.over.is_set()
    service.wait(running.job_id)
