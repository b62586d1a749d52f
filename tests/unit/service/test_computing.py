from __future__ import annotations

import threading

from service.computing import Computing
from tests.unit.service.fakes import FakeController, FakeLoop


def test_what_waits_for_its_turn_is_dropped_when_the_test_ends() -> None:
    over, running, begun = threading.Event(), threading.Event(), threading.Event()

    def first() -> None:
        running.set()
        assert over.wait(5)

    Computing(FakeLoop(FakeController())).start(first)
    assert running.wait(5)
    aborted = Computing(FakeLoop(FakeController()))
    aborted.start(begun.set)
    aborted.restore(aborted.read())
    over.set()
    assert aborted._idle.wait(5)
    assert not begun.is_set()


def test_computations_of_several_loops_take_turns() -> None:
    over, running, second_began = threading.Event(), threading.Event(), threading.Event()

    def first() -> None:
        running.set()
        assert over.wait(5)

    Computing(FakeLoop(FakeController())).start(first)
    assert running.wait(5)
    Computing(FakeLoop(FakeController())).start(second_began.set)
    assert not second_began.wait(0.1)
    over.set()
    assert second_began.wait(5)
