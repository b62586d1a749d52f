"""How a session ends: every cause, every mode of home, every hand, and the output that is left."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.controller.channel import Channel, Mode
from loopwright.protocol.profile import Cause, Order, OutsideChange
from tests.unit.controller.sessions import (
    CAUSES,
    HOMES,
    ORDERS,
    PI,
    RELAY,
    TRIED,
    TUNER,
    WITHOUT_PV,
    Bench,
)

EACH_CAUSE = pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause.name.lower())
LONG = (TUNER, 40, 60_000, 1000, 1000)
HOME_OUTPUTS = {Mode.OFF: 5.0, Mode.MANUAL: 45.0}


def in_test(mode: Mode, relay: bool = False, **limits: float) -> Bench:
    """A session that has moved everything."""
    bench = Bench(mode, **limits)
    bench.samples(5)
    bench.open(*LONG)
    for order, values in ORDERS.items():
        if order not in (Order.ACCEPT, Order.RELAY):
            assert bench.order(order, *values) is None
    bench.samples(3)
    if relay:
        bench.order(Order.RELAY, *RELAY)
        bench.samples(3)
    return bench


@EACH_CAUSE
@HOMES
@pytest.mark.parametrize("relay", [False, True], ids=["", "relay"])
def test_everything_goes_home(cause: Cause, mode: Mode, relay: bool) -> None:
    bench = in_test(mode, relay)
    home = bench.session.home
    bench.end_by(cause)
    assert bench.is_home(home) and bench.channel.accepted == PI
    assert bench.session.retained == bench.channel.home


@EACH_CAUSE
@HOMES
@pytest.mark.parametrize("relay", [False, True], ids=["", "relay"])
def test_the_output_is_that_of_home(cause: Cause, mode: Mode, relay: bool) -> None:
    """Manual and off: what they stand for. Automatic: on from where it is, from the working output of a relay; home's
    MV where no PV comes."""
    bench = in_test(mode, relay)
    under_test, home = bench.channel.mv, bench.session.home.mv
    has_relay = relay or cause in (Cause.PV_LIMIT, Cause.RELAY_SAMPLES)
    bench.end_by(cause)
    pv = 55.1 if cause is Cause.PV_LIMIT else 49.2
    if cause in WITHOUT_PV:
        assert bench.session.unasked and bench.channel.mv == HOME_OUTPUTS.get(mode, home)
    else:
        assert not bench.session.unasked
        left = 50.0 if has_relay else under_test
        assert bench.samples(1, pv) == pytest.approx(HOME_OUTPUTS.get(mode, left), abs=0.4)


@pytest.mark.parametrize("cause", sorted({*CAUSES} - {Cause.PV_LIMIT}), ids=lambda cause: cause.name.lower())
@HOMES
def test_an_end_while_pv_is_no_number_leaves_the_output_of_home(cause: Cause, mode: Mode) -> None:
    """A PV that is no number is out of no limits."""
    bench = in_test(mode, relay=True)
    home = bench.session.home.mv
    bench.samples(1, math.nan)
    if cause is Cause.NO_PV:
        for _ in range(12):
            bench.session.heard(TUNER, bench.now)
            bench.samples(1, math.nan)
    elif cause in (Cause.LEASE, Cause.HEARTBEAT, Cause.RELAY_SAMPLES):
        bench.session.end(cause)
    else:
        bench.end_by(cause)
    assert not bench.session.is_open
    bench.samples(1, math.nan)
    assert bench.channel.mv == HOME_OUTPUTS.get(mode, home)


def test_a_pv_far_outside_its_span_ends_the_relay_at_homes_output() -> None:
    bench = in_test(Mode.AUTOMATIC, relay=True)
    home = bench.session.home.mv
    assert bench.samples(1, 1e30) == home
    assert bench.session.cause is Cause.PV_LIMIT


def test_a_pv_that_stops_right_after_the_end_leaves_homes_output() -> None:
    """The end had trusted the PV of before; no sample came that could carry its output."""
    bench = in_test(Mode.AUTOMATIC, relay=True)
    home = bench.session.home.mv
    bench.order(Order.CLOSE)
    bench.silence(0.9)
    assert not bench.session.unasked
    bench.silence(0.2)
    assert (bench.session.unasked, bench.channel.mv) == (True, home)


def test_once_a_sample_has_carried_the_end_silence_holds_the_output() -> None:
    bench = in_test(Mode.AUTOMATIC)
    bench.order(Order.CLOSE)
    mv = bench.samples(1)
    bench.silence(5.0)
    assert (bench.session.unasked, bench.channel.mv) == (False, mv)


def test_a_pv_that_comes_back_is_taken_over_from_homes_output() -> None:
    bench = in_test(Mode.AUTOMATIC, relay=True)
    home = bench.session.home.mv
    bench.silence(1.2)
    assert bench.samples(1, 47.0) == pytest.approx(home, abs=0.1)


def test_a_home_in_manual_is_reached_within_the_rate_limit_while_pv_comes_and_at_once_without() -> None:
    bench = in_test(Mode.MANUAL, rate_limit_per_s=20.0)
    side = bench.channel.mv
    bench.order(Order.CLOSE)
    assert bench.samples(1) == pytest.approx(max(45.0, side - 2.0))
    bench = in_test(Mode.MANUAL, rate_limit_per_s=20.0)
    bench.silence(1.2)
    assert bench.channel.mv == 45.0


def test_limits_hold_on_the_way_home() -> None:
    bench = in_test(Mode.AUTOMATIC)
    bench.hand(OutsideChange.LIMITS).settings = type(bench.channel.settings)(mv_low=60.0, mv_high=65.0)
    bench.session.settle()
    assert bench.samples(1) in (60.0, 65.0)


def test_gains_accepted_in_the_session_are_those_of_home() -> None:
    bench = in_test(Mode.AUTOMATIC)
    bench.order(Order.ACCEPT, *TRIED)
    accepted = bench.channel.accepted
    bench.end_by(Cause.HEARTBEAT)
    assert (bench.channel.in_effect, accepted.Kp, bench.session.home_gains) == (accepted, 4.0, PI)


def _set(name: str, value: float) -> Callable[[Channel], None]:
    return lambda channel: setattr(channel, name, value)


HANDS: dict[str, tuple[OutsideChange, Callable[[Channel], None], dict[str, object]]] = {
    "off": (OutsideChange.MODE, lambda channel: channel.command_mode(Mode.OFF), {"mode": Mode.OFF}),
    "manual": (OutsideChange.MODE, lambda channel: channel.command_mode(Mode.MANUAL), {"mode": Mode.MANUAL}),
    "automatic": (OutsideChange.MODE, lambda channel: channel.command_mode(Mode.AUTOMATIC), {"mode": Mode.AUTOMATIC}),
    "set-point": (OutsideChange.SETPOINT, _set("setpoint", 47.0), {"setpoint": 47.0}),
    "output": (OutsideChange.OUTPUT, _set("manual_output", 33.0), {"manual_output": 33.0}),
}


@HOMES
@pytest.mark.parametrize("relay", [False, True], ids=["", "relay"])
@pytest.mark.parametrize("hand", HANDS)
def test_a_hands_choice_stands_and_all_else_goes_home(hand: str, relay: bool, mode: Mode) -> None:
    what, act, chosen = HANDS[hand]
    bench = in_test(mode, relay)
    home = bench.session.home
    act(bench.hand(what))
    bench.session.settle()
    channel = bench.channel
    assert (bench.session.cause, bench.session.outside_changes, bench.session.is_open) == (
        Cause.OUTSIDE_CHANGE,
        what,
        False,
    )
    assert {name: getattr(channel, name) for name in chosen} == chosen
    assert (channel.in_effect, channel.on_trial, channel.relay) == (PI, False, None)
    if "mode" not in chosen:
        assert channel.mode is home.mode
    if "setpoint" not in chosen:
        assert channel.setpoint == home.setpoint
    if "manual_output" not in chosen and (channel.mode is home.mode or channel.mode is not Mode.MANUAL):
        assert channel.manual_output == home.manual_output


@pytest.mark.parametrize("home", [Mode.OFF, Mode.AUTOMATIC], ids=str)
@pytest.mark.parametrize("pv", [49.2, math.nan], ids=["measured", "no number"])
def test_a_hands_manual_during_a_relay_takes_the_working_output(home: Mode, pv: float) -> None:
    bench = in_test(home, relay=True)
    assert bench.channel.mv in (40.0, 60.0)
    bench.samples(1, pv)
    bench.hand(OutsideChange.MODE).command_mode(Mode.MANUAL)
    bench.session.settle()
    assert bench.channel.manual_output == 50.0
    assert bench.samples(1, pv) == 50.0


def test_a_hands_off_is_the_safe_output_also_without_pv() -> None:
    bench = in_test(Mode.AUTOMATIC, relay=True)
    bench.samples(1, math.nan)
    bench.hand(OutsideChange.MODE).command_mode(Mode.OFF)
    bench.session.settle()
    assert (bench.session.unasked, bench.channel.mv) == (True, 5.0)


def test_hands_add_up_until_the_next_opening() -> None:
    bench = in_test(Mode.AUTOMATIC)
    for what in (OutsideChange.MODE, OutsideChange.SETPOINT):
        bench.hand(what)
    assert bench.session.outside_changes == OutsideChange.MODE | OutsideChange.SETPOINT
    bench.session.settle()
    bench.open()
    assert bench.session.outside_changes is OutsideChange.NONE


def test_a_hand_after_the_end_is_noted_and_leaves_the_cause() -> None:
    bench = in_test(Mode.AUTOMATIC)
    bench.order(Order.CLOSE)
    bench.hand(OutsideChange.MODE).command_mode(Mode.OFF)
    bench.session.settle()
    assert (bench.session.cause, bench.session.outside_changes, bench.channel.mode) == (
        Cause.CLOSED,
        OutsideChange.MODE,
        Mode.OFF,
    )


ACTS: list[Callable[[Bench], object]] = [
    *(lambda bench, order=order, values=values: bench.order(order, *values) for order, values in ORDERS.items()),
    lambda bench: bench.open() if not bench.session.is_open and not bench.channel.on_trial else None,
    lambda bench: bench.order(Order.CLOSE),
    lambda bench: bench.samples(1, 40.0),
    lambda bench: bench.samples(3, 58.0),
    lambda bench: bench.samples(1, math.nan),
    lambda bench: bench.silence(0.5),
    lambda bench: bench.silence(1.2, beating=False),
    lambda bench: bench.session.end(Cause.NMT, operational=False),
    lambda bench: (bench.hand(OutsideChange.MODE).command_mode(Mode.OFF), bench.session.settle()),
    lambda bench: (bench.hand(OutsideChange.MODE).command_mode(Mode.MANUAL), bench.session.settle()),
    lambda bench: (setattr(bench.hand(OutsideChange.SETPOINT), "setpoint", 47.0), bench.session.settle()),
]


@settings(deadline=None, max_examples=300)
@given(st.lists(st.sampled_from(range(len(ACTS))), max_size=40), st.sampled_from([Mode.MANUAL, Mode.AUTOMATIC]))
def test_whatever_happens_without_a_session_nothing_of_a_test_is_left(acts: list[int], mode: Mode) -> None:
    bench = Bench(mode)
    bench.samples(3)
    for index in acts:
        ACTS[index](bench)
        channel = bench.channel
        assert 0.0 <= channel.mv <= 100.0
        if not bench.session.is_open:
            assert not channel.on_trial and channel.in_effect == channel.accepted
            assert channel.relay is None and channel.mode is not Mode.EXPERIMENT
            assert channel.setpoint in (50.0, 47.0), "home's, or a hand's"
            assert channel.accepted == PI or bench.stored
    bench.silence(70.0, beating=False)
    assert not bench.session.is_open


def test_a_session_opened_right_after_a_relay_has_its_working_output_for_home() -> None:
    """Before a sample has carried it to the plant: MV is still on the relay's side."""
    bench = in_test(Mode.AUTOMATIC, relay=True)
    side = bench.channel.mv
    assert bench.order(Order.CLOSE) is None
    bench.open(*LONG)
    assert bench.session.home.mv == RELAY[2] != side


def test_automatic_while_pv_is_away_goes_on_from_the_output_that_a_hand_has_left() -> None:
    """The session is over: its home is nobody's choice any more."""
    bench = in_test(Mode.AUTOMATIC, relay=True)
    bench.silence(1.5)
    home = bench.channel.mv
    for mode, output in ((Mode.OFF, 5.0), (Mode.AUTOMATIC, 5.0)):
        bench.session.on_outside_change(OutsideChange.MODE)
        bench.channel.command_mode(mode)
        bench.session.settle()
        assert bench.channel.mv == output != home
