from __future__ import annotations

import threading
from contextlib import suppress

import pytest

from loopwright.protocol.fair_lock import FairLock
from tests.unit.service.processes import until


def test_everybody_has_a_turn_in_the_order_of_asking() -> None:
    lock, order = FairLock(), []

    def ask(n: int) -> None:
        with lock.take():
            order.append(n)

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(8)]
    with lock.take():
        for waiting, thread in enumerate(threads, 1):
            thread.start()
            until(lambda count=waiting: lock.waiting >= count)
    for thread in threads:
        thread.join(60)
    assert order == list(range(8))


def test_who_asks_again_at_once_comes_after_who_waits() -> None:
    """A lock of Python's would go to who has just given it back."""
    lock, order = FairLock(), []

    def ask() -> None:
        with lock.take():
            order.append("the other")

    thread = threading.Thread(target=ask)
    with lock.take():
        thread.start()
        until(lambda: lock.waiting)
    with lock.take():
        order.append("the same again")
    thread.join(60)
    assert order == ["the other", "the same again"]


def test_what_is_urgent_goes_first() -> None:
    lock, order = FairLock(), []

    def ask(n: int, urgent: bool) -> None:
        with lock.take(urgent):
            order.append(n)

    threads = [threading.Thread(target=ask, args=(n, n % 2 == 1)) for n in range(6)]
    with lock.take():
        for waiting, thread in enumerate(threads, 1):
            thread.start()
            until(lambda count=waiting: lock.waiting >= count)
    for thread in threads:
        thread.join(60)
    assert order == [1, 3, 5, 0, 2, 4]


def test_who_waits_is_asked_again_and_again_what_else_it_has_to_do() -> None:
    lock, asked, had = FairLock(), [], []

    def ask() -> None:
        with lock.take(meanwhile=lambda: asked.append(0)):
            had.append(0)

    with lock.take():
        thread = threading.Thread(target=ask)
        thread.start()
        until(lambda: len(asked) >= 3)
    thread.join(60)
    assert had == [0]


def test_who_gives_up_while_waiting_keeps_nobody_else_from_a_turn() -> None:
    lock, seen = FairLock(), []

    def give_up() -> None:
        seen.append(0)
        raise ConnectionError

    def ask() -> None:
        with suppress(ConnectionError), lock.take(meanwhile=give_up):
            pass

    with lock.take():
        thread = threading.Thread(target=ask)
        thread.start()
        thread.join(60)
    assert seen == [0] and not lock.waiting
    with lock.take():
        pass


def test_who_gives_up_just_as_its_turn_comes_hands_it_on() -> None:
    lock = FairLock()
    turn = lock.take()
    turn.__enter__()

    def give_up() -> None:
        turn.__exit__(None, None, None)
        raise ConnectionError

    with pytest.raises(ConnectionError), lock.take(meanwhile=give_up):
        pass
    with lock.take():
        pass


def test_an_error_inside_hands_the_turn_on() -> None:
    lock = FairLock()
    with pytest.raises(ValueError), lock.take():
        raise ValueError
    with lock.take():
        pass
