"""Opening, orders and what they refuse, the lease and the watches of a session."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopwright.controller.channel import Home, Mode, Parameters, RelayState
from loopwright.protocol.profile import Abort, Cause, Order, OutsideChange
from loopwright.protocol.sdo import SdoAbort
from loopwright.protocol.session import check_of
from tests.unit.controller.sessions import (
    CAUSES,
    HOMES,
    NO_NUMBERS,
    ORDERS,
    OTHER,
    PI,
    RELAY,
    TERMS,
    TRIED,
    TUNER,
    WITHOUT_PV,
    Bench,
)

EACH_ORDER = pytest.mark.parametrize("order", ORDERS, ids=lambda order: order.name.lower())


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.samples(5)
    return bench


class TestOpening:
    def test_quotes_a_fresh_number_and_notes_home(self, bench: Bench) -> None:
        offered = bench.session.next
        mv = bench.channel.mv
        assert bench.open() == offered == bench.session.number
        assert bench.session.next != offered
        assert bench.session.home == Home(Mode.AUTOMATIC, 50.0, 45.0, mv)
        assert (bench.session.home_gains, bench.session.holder, bench.session.cause) == (PI, TUNER, Cause.NONE)

    def test_before_a_sample_has_come_after_a_relay_home_is_not_the_relays_side(self, bench: Bench) -> None:
        bench.open()
        bench.order(Order.RELAY, *RELAY)
        assert bench.samples(3) == 60.0
        bench.order(Order.CLOSE)
        bench.open()
        assert bench.session.home.mv == 50.0
        bench.silence(1.5)
        assert (bench.session.cause, bench.channel.mv) == (Cause.NO_PV, 50.0)

    def test_with_another_number_is_refused(self, bench: Bench) -> None:
        before = bench.look()
        assert bench.order(Order.OPEN, *TERMS, number=bench.session.next + 1) is Abort.INVALID_VALUE
        assert bench.look() == before

    def test_a_number_opens_once(self, bench: Bench) -> None:
        number = bench.open()
        bench.order(Order.CLOSE)
        assert bench.order(Order.OPEN, *TERMS, number=number) is Abort.INVALID_VALUE
        assert not bench.session.is_open

    def test_one_at_a_time(self, bench: Bench) -> None:
        number = bench.open()
        assert bench.order(Order.OPEN, *TERMS) is Abort.DEVICE_STATE
        assert bench.order(Order.OPEN, 0x55, *TERMS[1:]) is Abort.DEVICE_STATE
        assert (bench.session.number, bench.session.holder) == (number, TUNER)

    def test_repeated_it_is_answered_as_done(self, bench: Bench) -> None:
        check = check_of(bench.session.next, 0, Order.OPEN, TERMS)
        assert [bench.give(Order.OPEN, check, *TERMS) for _ in range(3)] == [None] * 3
        assert bench.session.count == 1

    def test_is_refused_while_somebody_tries_gains_by_hand(self, bench: Bench) -> None:
        bench.channel.try_gains(OTHER)
        assert bench.order(Order.OPEN, *TERMS) is Abort.DEVICE_STATE
        assert bench.channel.in_effect == OTHER

    def test_forgets_the_hands_of_before(self, bench: Bench) -> None:
        bench.hand(OutsideChange.OUTPUT)
        bench.open()
        assert bench.session.outside_changes is OutsideChange.NONE


class TestOrders:
    @EACH_ORDER
    def test_one_takes_effect_and_counts(self, bench: Bench, order: Order) -> None:
        bench.open()
        before = bench.look()
        assert bench.order(order, *ORDERS[order]) is None
        assert bench.look() != before and bench.session.count == 2

    def test_what_each_one_does(self, bench: Bench) -> None:
        bench.open()
        channel = bench.channel
        bench.order(Order.SETPOINT, 53.0)
        bench.order(Order.TRY, *TRIED)
        assert (channel.setpoint, channel.in_effect, channel.accepted, channel.on_trial) == (53.0, OTHER, PI, True)
        bench.order(Order.MODE, Mode.MANUAL)
        bench.order(Order.OUTPUT, 70.0)
        assert (channel.mode, bench.samples(1)) == (Mode.MANUAL, 70.0)
        bench.order(Order.RELAY, *RELAY)
        assert (channel.mode, bench.samples(1)) == (Mode.EXPERIMENT, 60.0)
        bench.order(Order.MODE, Mode.AUTOMATIC)
        bench.order(Order.ACCEPT, *TRIED)
        assert (channel.accepted, channel.on_trial, bench.stored) == (OTHER, False, [OTHER])

    @EACH_ORDER
    def test_without_a_session_it_is_refused_and_without_effect(self, bench: Bench, order: Order) -> None:
        before = bench.look()
        assert bench.order(order, *ORDERS[order]) is Abort.DEVICE_STATE
        bench.open()
        bench.order(Order.CLOSE)
        closed = bench.look()
        assert bench.order(order, *ORDERS[order]) is Abort.DEVICE_STATE
        assert bench.look()[:-3] == before[:-3] and bench.look() == closed

    @EACH_ORDER
    @pytest.mark.parametrize("off", [{"count": 0}, {"count": 2}, {"number": 0x999}], ids=["old", "early", "foreign"])
    def test_with_a_wrong_count_or_number_it_is_refused_and_without_effect(
        self, bench: Bench, order: Order, off: dict[str, int]
    ) -> None:
        bench.open()
        before = bench.look()
        assert bench.order(order, *ORDERS[order], **off) is Abort.INVALID_VALUE
        assert bench.look() == before

    @EACH_ORDER
    def test_with_other_values_than_checked_it_is_refused_and_without_effect(self, bench: Bench, order: Order) -> None:
        """Another tuner has staged its own meanwhile."""
        number = bench.open()
        before, values = bench.look(), ORDERS[order]
        check = check_of(number, 1, order, values)
        assert bench.give(order, check, *values[:-1], values[-1] + 1) is Abort.INVALID_VALUE
        assert bench.look() == before

    @EACH_ORDER
    def test_of_a_session_that_has_ended_it_stays_out_of_the_next_one(self, bench: Bench, order: Order) -> None:
        old = bench.open()
        late = check_of(old, 1, order, ORDERS[order])
        bench.order(Order.CLOSE)
        bench.open()
        before = bench.look()
        assert bench.give(order, late, *ORDERS[order]) is Abort.INVALID_VALUE
        assert bench.look() == before

    @EACH_ORDER
    def test_the_last_one_repeated_is_answered_as_done_and_done_once(self, bench: Bench, order: Order) -> None:
        number = bench.open()
        check = check_of(number, 1, order, ORDERS[order])
        assert bench.give(order, check, *ORDERS[order]) is None
        done = bench.look()
        assert bench.give(order, check, *ORDERS[order]) is None
        assert bench.look() == done

    def test_one_before_the_last_repeated_is_refused(self, bench: Bench) -> None:
        number = bench.open()
        first = check_of(number, 1, Order.SETPOINT, (51.0,))
        bench.give(Order.SETPOINT, first, 51.0)
        bench.order(Order.SETPOINT, 52.0)
        assert bench.give(Order.SETPOINT, first, 51.0) is Abort.INVALID_VALUE
        assert bench.channel.setpoint == 52.0

    def test_the_closing_repeated_is_answered_as_done(self, bench: Bench) -> None:
        number = bench.open()
        check = check_of(number, 1, Order.CLOSE, ())
        assert [bench.give(Order.CLOSE, check) for _ in range(3)] == [None] * 3
        assert (bench.session.is_open, bench.session.cause) == (False, Cause.CLOSED)

    def test_one_repeated_after_a_hand_has_no_effect(self, bench: Bench) -> None:
        number = bench.open()
        check = check_of(number, 1, Order.SETPOINT, (53.0,))
        bench.give(Order.SETPOINT, check, 53.0)
        bench.hand(OutsideChange.SETPOINT).setpoint = 48.0
        bench.give(Order.SETPOINT, check, 53.0)
        assert bench.channel.setpoint == 48.0

    @pytest.mark.parametrize(
        ("order", "values"),
        [
            (Order.SETPOINT, (math.nan,)),
            (Order.MODE, (Mode.EXPERIMENT,)),
            (Order.MODE, (7,)),
            (Order.OUTPUT, (math.inf,)),
            (Order.RELAY, (0.0, *RELAY[1:])),
            (Order.RELAY, (*RELAY[:4], 60.0, 40.0, 0.0, 1)),
            (Order.TRY, (-1.0, *TRIED[1:])),
            (Order.ACCEPT, (math.nan, *TRIED[1:])),
            (Order.ACCEPT, (1.0, -1.0, *TRIED[2:])),
            (Order.WATCH, (60.0, 40.0)),
            (Order.WATCH, (math.nan, 60.0)),
        ],
    )
    def test_a_value_that_makes_no_sense_is_refused_and_the_count_stays(
        self, bench: Bench, order: Order, values: tuple[float, ...]
    ) -> None:
        bench.open()
        before = bench.look()
        assert bench.order(order, *values) is Abort.INVALID_VALUE
        assert bench.look() == before
        assert bench.order(Order.SETPOINT, 51.0) is None, "the next one has the same count"

    @pytest.mark.parametrize("order", [Order.TRY, Order.ACCEPT], ids=str)
    def test_gains_do_not_change_under_a_relay(self, bench: Bench, order: Order) -> None:
        bench.open()
        bench.order(Order.RELAY, *RELAY)
        assert bench.order(order, *TRIED) is Abort.DEVICE_STATE
        assert bench.channel.relay is not None and not bench.stored

    def test_gains_that_cannot_be_stored_are_not_accepted(self, bench: Bench) -> None:
        def full(gains: Parameters) -> None:
            raise SdoAbort(Abort.NOT_STORED)

        bench.open()
        before = bench.look()
        check = check_of(bench.session.number, 1, Order.ACCEPT, TRIED)
        with pytest.raises(SdoAbort, match="0x08000020"):
            bench.session.give(Order.ACCEPT, check, TRIED, bench.now, full)
        assert bench.look() == before
        assert bench.give(Order.ACCEPT, check, *TRIED) is None, "tried again when there is room"

    def test_gains_are_stored_before_they_are_accepted(self, bench: Bench) -> None:
        seen: list[Parameters] = []
        bench.open()
        check = check_of(bench.session.number, 1, Order.ACCEPT, TRIED)
        bench.session.give(
            Order.ACCEPT, check, TRIED, bench.now, lambda gains: seen.extend((gains, bench.channel.accepted))
        )
        assert seen == [OTHER, PI]

    @settings(deadline=None, max_examples=200)
    @given(st.data())
    def test_whatever_frames_come_only_the_next_order_of_this_session_acts(self, data: st.DataObject) -> None:
        bench = Bench()
        bench.samples(5)
        numbers = [bench.open()]
        bench.order(Order.CLOSE)
        numbers.append(bench.open())
        last: tuple[Order, int] = (Order.OPEN, check_of(numbers[1], 0, Order.OPEN, TERMS))
        for _ in range(data.draw(st.integers(1, 12))):
            order = data.draw(st.sampled_from([*ORDERS, Order.OPEN]))
            values = TERMS if order is Order.OPEN else ORDERS[order]
            number, count = data.draw(st.sampled_from([*numbers, 0])), data.draw(st.integers(0, 8))
            check, expected, before = check_of(number, count, order, values), bench.session.count, bench.look()
            answer = bench.give(order, check, *values)
            right = order is not Order.OPEN and number == numbers[1] and count == expected
            if right and answer is None:
                last = order, check
                assert bench.session.count == expected + 1
            else:
                assert bench.look() == before
                assert (answer is None) == (last == (order, check))


class TestLease:
    def test_runs_out_by_samples(self, bench: Bench) -> None:
        bench.open(TUNER, 8, 60_000, 60_000, 60_000)
        bench.order(Order.SETPOINT, 53.0)
        bench.samples(8)
        assert bench.session.is_open
        bench.samples(1)
        assert (bench.session.cause, bench.channel.setpoint) == (Cause.LEASE, 50.0)

    @pytest.mark.parametrize("bad", NO_NUMBERS)
    def test_runs_out_on_samples_that_are_no_measurements(self, bench: Bench, bad: float) -> None:
        bench.open(TUNER, 5, 60_000, 60_000, 60_000)
        bench.samples(6, bad)
        assert bench.session.cause is Cause.LEASE

    def test_runs_out_by_the_clock(self, bench: Bench) -> None:
        bench.open(TUNER, 10**6, 3000, 60_000, 60_000)
        bench.silence(2.9)
        assert bench.session.is_open
        bench.silence(0.2)
        assert bench.session.cause is Cause.LEASE

    def test_renewed_pays_for_as_much_again(self, bench: Bench) -> None:
        number = bench.open(TUNER, 8, 3000, 60_000, 60_000)
        for _ in range(20):
            bench.samples(5)
            bench.session.renew(number, bench.now)
        bench.samples(8)
        assert bench.session.is_open
        bench.samples(1)
        assert bench.session.cause is Cause.LEASE

    @pytest.mark.parametrize("which", ["none open", "another's", "ended", "number 0"])
    def test_nothing_else_is_renewed(self, bench: Bench, which: str) -> None:
        number = 0x1000
        if which != "none open":
            number = bench.open() + (1 if which == "another's" else 0)
        if which == "ended":
            bench.order(Order.CLOSE)
        with pytest.raises(SdoAbort, match="0x08000022"):
            bench.session.renew(0 if which == "number 0" else number, bench.now)


class TestWatches:
    def test_the_tuner_is_watched_from_the_opening_on(self, bench: Bench) -> None:
        bench.open()
        bench.samples(9)
        assert bench.session.is_open
        bench.samples(2)
        assert bench.session.cause is Cause.HEARTBEAT

    def test_only_its_own_heartbeat_keeps_a_session(self, bench: Bench) -> None:
        bench.open()
        for _ in range(11):
            bench.session.heard(0x7C, bench.now)
            bench.samples(1)
        assert bench.session.cause is Cause.HEARTBEAT

    def test_a_controller_that_stood_still_first_reads_what_has_come(self, bench: Bench) -> None:
        bench.open(TUNER, 10**6, 60_000, 1000, 1000)
        bench.samples(3)
        bench.now += 1.5
        bench.session.tick(bench.now)
        assert bench.session.is_open and bench.session.pv_is_valid
        bench.session.heard(TUNER, bench.now)
        bench.samples(9)
        assert bench.session.is_open

    @pytest.mark.parametrize(("beating", "cause"), [(False, Cause.HEARTBEAT), (True, Cause.NO_PV)])
    def test_what_does_not_come_then_either_is_missed(self, bench: Bench, beating: bool, cause: Cause) -> None:
        bench.open(TUNER, 10**6, 60_000, 1000, 1000)
        bench.samples(3)
        bench.now += 1.5
        bench.silence(0.48, beating)
        assert bench.session.is_open
        bench.silence(0.06, beating)
        assert bench.session.cause is cause

    def test_a_controller_that_stands_still_again_and_again_waits_once(self, bench: Bench) -> None:
        bench.open(TUNER, 10**6, 60_000, 1000, 1000)
        began_at = bench.now
        while bench.session.is_open:
            bench.now += 0.4
            bench.session.tick(bench.now)
        assert bench.session.cause is Cause.HEARTBEAT and bench.now - began_at <= 1.3

    def test_a_lease_runs_out_while_the_controller_stands_still(self, bench: Bench) -> None:
        bench.open(TUNER, 10**6, 1000, 1000, 1000)
        bench.now += 1.5
        bench.session.tick(bench.now)
        assert bench.session.cause is Cause.LEASE

    def test_a_tuner_that_beats_keeps_it(self, bench: Bench) -> None:
        bench.open(TUNER, 10**6, 60_000, 1000, 1000)
        for _ in range(50):
            bench.session.heard(TUNER, bench.now)
            bench.samples(1)
        assert bench.session.is_open

    @pytest.mark.parametrize("what", ["silent", *NO_NUMBERS])
    def test_a_session_ends_without_a_valid_pv(self, bench: Bench, what: object) -> None:
        bench.open()
        if what == "silent":
            bench.silence(1.1)
        else:
            for _ in range(11):
                bench.session.heard(TUNER, bench.now)
                bench.samples(1, float(what))  # type: ignore[arg-type]
        assert bench.session.cause is Cause.NO_PV
        assert not bench.session.pv_is_valid

    def test_a_bad_sample_now_and_then_ends_nothing(self, bench: Bench) -> None:
        bench.open(TUNER, 10**6, 60_000, 1000, 1000)
        for n in range(60):
            bench.session.heard(TUNER, bench.now)
            bench.samples(1, 49.2 if n % 5 == 0 else math.nan)
        assert bench.session.is_open

    def test_silence_before_the_opening_does_not_count(self, bench: Bench) -> None:
        bench.silence(30.0)
        bench.open()
        bench.silence(0.9)
        assert bench.session.is_open
        bench.silence(0.2)
        assert bench.session.cause is Cause.NO_PV

    def test_a_relay_ends_at_a_pv_limit(self, bench: Bench) -> None:
        bench.open()
        bench.order(Order.RELAY, *RELAY[:4], 45.0, 55.0, 0.0, 1)
        bench.samples(1, 55.0)
        assert bench.session.is_open
        bench.samples(1, 55.1)
        assert (bench.session.cause, bench.channel.relay_state) == (Cause.PV_LIMIT, RelayState.ENDED_BY_LIMIT)

    def test_a_relay_ends_after_its_samples(self, bench: Bench) -> None:
        bench.open()
        bench.order(Order.RELAY, *RELAY[:3], 5, *RELAY[4:])
        modes = [bench.samples(1) and bench.channel.mode for _ in range(6)]
        assert modes == [Mode.EXPERIMENT] * 5 + [Mode.AUTOMATIC]
        assert (bench.session.cause, bench.channel.relay_state) == (Cause.RELAY_SAMPLES, RelayState.DONE)

    @HOMES
    def test_a_test_ends_at_a_pv_limit_in_every_mode(self, mode: Mode) -> None:
        bench = Bench(mode)
        bench.samples(3)
        bench.open()
        home = bench.session.home
        bench.order(Order.WATCH, 45.0, 55.0)
        bench.order(Order.MODE, Mode.MANUAL)
        bench.order(Order.OUTPUT, 70.0)
        assert bench.samples(1, 55.0) == 70.0
        assert bench.session.is_open
        bench.samples(1, 55.1)
        assert bench.session.cause is Cause.PV_LIMIT and bench.is_home(home)

    def test_the_pv_limits_of_a_session_end_with_it(self, bench: Bench) -> None:
        bench.open()
        bench.order(Order.WATCH, 45.0, 55.0)
        bench.order(Order.CLOSE)
        bench.open()
        bench.samples(3, 60.0)
        assert bench.session.is_open

    def test_a_pv_that_is_no_number_is_out_of_no_limits(self, bench: Bench) -> None:
        bench.open()
        bench.order(Order.WATCH, 45.0, 55.0)
        bench.samples(1, math.nan)
        assert bench.session.is_open


class TestManualOutput:
    """What becomes of the manual output of a loop in manual that a tuner moves."""

    @pytest.mark.parametrize("cause", CAUSES, ids=lambda cause: cause.name.lower())
    def test_every_end_restores_the_manual_output_found(self, cause: Cause) -> None:
        """Also the end at a PV limit that the tuner has set, on the same sample."""
        bench = Bench(Mode.MANUAL)
        bench.samples(3)
        bench.open()
        bench.order(Order.WATCH, 45.0, 55.0)
        bench.order(Order.OUTPUT, 70.0)
        assert bench.samples(1) == 70.0
        if cause is Cause.PV_LIMIT:
            assert bench.samples(1, 55.1) == 45.0
        else:
            bench.end_by(cause)
            if cause not in WITHOUT_PV:
                bench.samples(1)
        assert bench.session.cause is cause
        assert (bench.channel.mode, bench.channel.manual_output, bench.channel.mv) == (Mode.MANUAL, 45.0, 45.0)

    def test_gains_are_accepted_in_manual_without_moving_MV(self) -> None:
        bench = Bench(Mode.MANUAL)
        bench.samples(3)
        bench.open()
        assert bench.order(Order.ACCEPT, *TRIED) is None
        seen = {bench.samples(1) for _ in range(3)}
        bench.order(Order.CLOSE)
        seen |= {bench.samples(1) for _ in range(3)}
        assert seen == {45.0} and bench.channel.mode is Mode.MANUAL
        assert bench.channel.accepted == Parameters(*TRIED)
