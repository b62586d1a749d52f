from __future__ import annotations

import threading
import time

import pytest

from protocol.turns import Turns


def test_everybody_has_a_turn_in_the_order_of_asking() -> None:
    turns, order = Turns(), []

    def ask(n: int) -> None:
        with turns.take():
            order.append(n)

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(8)]
    with turns.take():
        for waiting, thread in enumerate(threads, 1):
            thread.start()
            deadline = time.monotonic() + 60
            while len(turns._waiting) < waiting and time.monotonic() < deadline:
                time.sleep(0.001)
    for thread in threads:
        thread.join(60)
    assert order == list(range(8))


def test_who_asks_again_at_once_comes_after_who_waits() -> None:
    """A lock of Python's would go to who has just given it back."""
    turns, order = Turns(), []

    def ask() -> None:
        with turns.take():
            order.append("the other")

    thread = threading.Thread(target=ask)
    with turns.take():
        thread.start()
        deadline = time.monotonic() + 60
        while not turns._waiting and time.monotonic() < deadline:
            time.sleep(0.001)
    with turns.take():
        order.append("the same again")
    thread.join(60)
    assert order == ["the other", "the same again"]


def test_what_is_urgent_goes_first() -> None:
    turns, order = Turns(), []

    def ask(n: int, urgent: bool) -> None:
        with turns.take(urgent):
            order.append(n)

    threads = [threading.Thread(target=ask, args=(n, n % 2 == 1)) for n in range(6)]
    with turns.take():
        for waiting, thread in enumerate(threads, 1):
            thread.start()
            deadline = time.monotonic() + 60
            while len(turns._waiting) + len(turns._urgent) < waiting and time.monotonic() < deadline:
                time.sleep(0.001)
    for thread in threads:
        thread.join(60)
    assert order == [1, 3, 5, 0, 2, 4]


def test_an_error_inside_hands_the_turn_on() -> None:
    turns = Turns()
    with pytest.raises(ValueError), turns.take():
        raise ValueError
    with turns.take():
        pass
