"""HOLD: PV is false, so the session goes to manual at the MV before the test, now and whatever ends it afterwards."""

from __future__ import annotations

import math

import pytest

from loopwright.controller.channel import Mode, RelayState
from loopwright.protocol.profile import Abort, Cause, Order, OutsideChange
from tests.unit.controller.sessions import CAUSES, HOMES, ORDERS, PI, RELAY, TRIED, TUNER, Bench

FALSE = 12.0
"""A PV that automatic would answer with another MV."""


def held(mode: Mode = Mode.AUTOMATIC, *before: Order) -> tuple[Bench, float]:
    """A session in which HOLD was ordered, after these orders, and the MV before it."""
    bench = Bench(mode)
    rest = bench.samples(3)
    bench.open()
    for order in before:
        assert bench.order(order, *ORDERS[order]) is None
    bench.samples(3, 51.0)
    assert bench.order(Order.HOLD) is None
    return bench, rest


@pytest.mark.parametrize("before", ORDERS, ids=lambda order: order.name.lower())
def test_the_MV_before_the_test_is_back_at_once(before: Order) -> None:
    bench, rest = held(Mode.AUTOMATIC, before)
    assert bench.session.is_open, "the tuner closes it"
    assert [bench.samples(1, FALSE) for _ in range(5)] == [rest] * 5
    c = bench.channel
    assert (c.mode, c.manual_output, c.setpoint, c.relay, c.on_trial) == (Mode.MANUAL, rest, 50.0, None, False)


@pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause.name.lower())
def test_whatever_ends_the_session_the_loop_stays_in_manual(cause: Cause) -> None:
    """The tuner may die after HOLD, PV may go away altogether, the node may be stopped."""
    bench, rest = held(Mode.AUTOMATIC, Order.TRY, Order.WATCH)
    session, number = bench.session, bench.session.number
    match cause:
        case Cause.PV_LIMIT:
            session.end(Cause.PV_LIMIT)
        case Cause.RELAY_SAMPLES:
            session.end(Cause.RELAY_SAMPLES)
        case Cause.LEASE:
            while session.is_open:
                session.heard(TUNER, bench.now)
                bench.samples(1, FALSE)
        case Cause.HEARTBEAT:
            bench.samples(12, FALSE)
        case Cause.NO_PV:
            bench.silence(1.2)
        case Cause.NMT:
            session.end(Cause.NMT, operational=False)
        case Cause.OUTSIDE_CHANGE:
            bench.hand(OutsideChange.LIMITS)
            session.settle()
        case _:
            assert bench.order(Order.CLOSE) is None
    assert (session.is_open, session.last, session.cause) == (False, number, Cause.HELD)
    assert [bench.samples(1, FALSE) for _ in range(5)] == [rest] * 5
    assert (bench.channel.mode, bench.channel.accepted, bench.channel.in_effect) == (Mode.MANUAL, PI, PI)
    assert (session.home.mode, session.home.manual_output) == (Mode.MANUAL, rest), "what a reader is told of home"


@pytest.mark.parametrize("what", [OutsideChange.MODE, OutsideChange.OUTPUT, OutsideChange.SETPOINT], ids=str)
@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
def test_anothers_hand_after_it_has_the_last_word(what: OutsideChange, closed: bool) -> None:
    bench, rest = held()
    if closed:
        bench.order(Order.CLOSE)
    channel = bench.hand(what)
    match what:
        case OutsideChange.MODE:
            channel.command_mode(Mode.AUTOMATIC)
        case OutsideChange.OUTPUT:
            channel.manual_output = 33.0
        case _:
            channel.setpoint = 44.0
    bench.session.settle()
    bench.samples(3)
    assert bench.order(Order.CLOSE) in (None, Abort.DEVICE_STATE)
    mode, output, setpoint = channel.mode, channel.manual_output, channel.setpoint
    assert mode is (Mode.AUTOMATIC if what is OutsideChange.MODE else Mode.MANUAL)
    assert output == (33.0 if what is OutsideChange.OUTPUT else rest)
    assert setpoint == (44.0 if what is OutsideChange.SETPOINT else 50.0)
    assert bench.session.outside_changes == what


def test_anothers_hand_before_it_has_the_last_word() -> None:
    bench = Bench()
    bench.samples(3)
    bench.open()
    bench.hand(OutsideChange.SETPOINT).setpoint = 44.0
    bench.session.settle()
    assert bench.order(Order.HOLD) is Abort.DEVICE_STATE
    assert (bench.channel.mode, bench.channel.setpoint) == (Mode.AUTOMATIC, 44.0)
    assert bench.session.cause is Cause.OUTSIDE_CHANGE


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: order.name.lower())
def test_no_order_moves_a_held_loop(order: Order) -> None:
    bench, _ = held()
    before = bench.look()
    assert bench.order(order, *ORDERS[order]) is Abort.DEVICE_STATE
    assert bench.look() == before


def test_it_may_be_ordered_again() -> None:
    """By a tuner that has not got the answer."""
    bench, rest = held()
    assert bench.order(Order.HOLD) is None
    assert bench.samples(2, FALSE) == rest


@HOMES
def test_a_home_in_manual_or_off_is_the_home_that_it_was(mode: Mode) -> None:
    bench = Bench(mode)
    rest = bench.samples(3)
    home = bench.channel.home
    bench.open()
    bench.order(Order.RELAY, *RELAY)
    bench.samples(2)
    bench.order(Order.HOLD)
    bench.order(Order.CLOSE)
    assert bench.samples(2, FALSE) == rest
    if mode is not Mode.AUTOMATIC:
        assert bench.is_home(home)
    assert bench.channel.relay_state is RelayState.DONE


def test_a_restart_goes_on_in_manual_from_the_order_on() -> None:
    bench, rest = held()
    for end in (False, True):
        if end:
            bench.order(Order.CLOSE)
        assert (bench.session.retained.mode, bench.session.retained.manual_output) == (Mode.MANUAL, rest)


def test_without_a_PV_the_MV_is_set_at_once() -> None:
    bench = Bench()
    rest = bench.samples(3)
    bench.open()
    bench.order(Order.OUTPUT, 70.0)
    bench.order(Order.MODE, Mode.MANUAL)
    bench.samples(1, math.nan)
    bench.order(Order.HOLD)
    assert (bench.channel.mv, bench.session.unasked) == (rest, True)


def test_the_next_session_is_an_ordinary_one() -> None:
    bench, rest = held()
    bench.order(Order.CLOSE)
    bench.open()
    assert bench.order(Order.TRY, *TRIED) is None
    bench.order(Order.CLOSE)
    assert (bench.session.cause, bench.session.home.manual_output) == (Cause.CLOSED, rest)
