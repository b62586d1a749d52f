"""Signals as one exception, and what they no longer do once the end has begun."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from loopwright.service.cli.interruption import Interrupted, Interruption

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """The handlers are those of a command in a terminal, also where the tests run under nohup; those of the test run
    come back."""
    before = {each: signal.getsignal(each) for each in SIGNALS}
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for each, handler in before.items():
        signal.signal(each, handler)


def send(number: int) -> None:
    signal.raise_signal(number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_an_exception_with_its_number(number: int) -> None:
    with pytest.raises(Interrupted) as raised, Interruption():
        send(number)
    assert raised.value.number == number and str(raised.value) == signal.Signals(number).name


def test_one_that_comes_while_a_process_is_started_waits_until_it_is_noted() -> None:
    noted = []
    with pytest.raises(Interrupted), Interruption() as interruption:
        with interruption.held():
            send(signal.SIGTERM)
            noted.append("started")
        noted.append("gone on")
    assert noted == ["started"]


def test_it_takes_the_place_of_an_error_that_it_has_caused() -> None:
    with pytest.raises(Interrupted), Interruption() as interruption, interruption.held():
        send(signal.SIGHUP)
        raise OSError("the process that is waited for has ended by the same signal")


def test_an_error_of_a_closed_terminal_is_its_signal_although_that_comes_later() -> None:
    with pytest.raises(Interrupted) as raised, Interruption() as interruption:
        try:
            raise OSError("the terminal does not take what is printed")
        finally:
            interruption.ignore()
            send(signal.SIGHUP)
    assert raised.value.number == signal.SIGHUP


def test_an_error_before_ctrl_c_stays_the_error() -> None:
    with pytest.raises(OSError, match="the port"), Interruption() as interruption:
        try:
            raise OSError("the port is taken")
        finally:
            interruption.ignore()
            send(signal.SIGINT)


def test_nothing_interrupts_the_end_nor_what_follows_it() -> None:
    with Interruption() as interruption:
        interruption.ignore()
        send(signal.SIGINT)
        with interruption.held():
            send(signal.SIGTERM)
    for each in (signal.SIGINT, signal.SIGTERM):
        send(each)


def test_without_a_signal_everything_is_as_before() -> None:
    before = [signal.getsignal(each) for each in SIGNALS]
    with Interruption():
        assert signal.getsignal(signal.SIGINT) not in before
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_a_closed_terminal_is_ignored_by_whoever_was_started_so_and_ctrl_c_is_not() -> None:
    for each in (signal.SIGHUP, signal.SIGINT):
        signal.signal(each, signal.SIG_IGN)
    with pytest.raises(Interrupted), Interruption():
        os.kill(os.getpid(), signal.SIGHUP)
        send(signal.SIGINT)
