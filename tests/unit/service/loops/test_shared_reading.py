from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context

import pytest

from loopwright.service.loops.shared_reading import SharedReading, asked_at
from loopwright.tuning.reasons import Ended, Failed, Reason

PATIENCE_S = 60.0


def asked(reading: SharedReading[str], at: float) -> Callable[[], str]:
    def ask() -> str:
        asked_at.set(at)
        return reading.of("L")

    context = copy_context()
    return lambda: context.run(ask)


@pytest.mark.parametrize("silent", [False, True])
def test_one_reading_answers_all_who_asked_before_it_began(silent: bool) -> None:
    clock, begun, over, reads = [10.0], threading.Event(), threading.Event(), list[float]()

    def read(name: str) -> str:
        reads.append(clock[0])
        begun.set()
        assert over.wait(PATIENCE_S)
        if silent:
            raise Failed(Reason.NODE_LOST, f"{name} at {reads[-1]:g}")
        return f"{name} at {reads[-1]:g}"

    reading = SharedReading(read, lambda: clock[0])
    with ThreadPoolExecutor(20) as threads:
        first = [threads.submit(asked(reading, 9.0)) for _ in range(10)]
        assert begun.wait(PATIENCE_S)
        later = [threads.submit(asked(reading, 10.5)) for _ in range(10)]  # has to be read anew, for all ten
        clock[0] = 11.0
        over.set()
        told = [str(each.exception() or each.result()) for each in (*first, *later)]
    found = [text.removeprefix("node_lost: ") for text in told]
    assert set(found[:10]) <= {"L at 10", "L at 11"} and found[10:] == 10 * ["L at 11"]
    assert reads == [10.0, 11.0]


def test_whoever_asks_now_gets_what_is_there_now() -> None:
    found = iter(["one", "two"])
    reading = SharedReading(lambda name: next(found))
    assert [reading.of("L"), reading.of("L")] == ["one", "two"]


def test_what_is_no_end_of_a_reading_is_whose_it_is() -> None:
    """A loop that is not there, or a database that is away: the next one tries."""
    errors = iter([LookupError("none"), None])

    def read(name: str) -> str:
        if error := next(errors):
            raise error
        return name

    reading = SharedReading(read, lambda: 1.0)
    with pytest.raises(LookupError):
        asked(reading, 0.0)()
    assert asked(reading, 0.0)() == "L"


def test_each_has_an_error_of_their_own() -> None:
    def read(name: str) -> str:
        raise Failed(Reason.NODE_LOST, "node 32 does not answer")

    reading = SharedReading(read, lambda: 1.0)
    caught = []
    for _ in range(2):
        with pytest.raises(Ended) as one:
            asked(reading, 0.5)()
        caught.append(one.value)
    assert caught[0] is not caught[1] and str(caught[0]) == str(caught[1])
