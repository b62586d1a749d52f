"""A session on a channel, opened and given orders as a tuner does it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pytest

from loopwright.controller.channel import Channel, Home, Mode, Parameters, RelayState, Settings
from loopwright.controller.session import Session
from loopwright.protocol.profile import Abort, Cause, Order, OutsideChange
from loopwright.protocol.sdo import SdoAbort
from loopwright.protocol.session import check_of

TUNER = 0x7D
PI, OTHER = Parameters(1.0, Ti=5.0), Parameters(4.0, Ti=1.0, b=0.25)
TERMS = (TUNER, 100, 3000, 1000, 1000)
"""Tuner, samples, ms of the lease, ms of a PV's silence, ms of the tuner's."""
RELAY = (10.0, 0.0, 50.0, 1000, 0.0, 100.0, 0.0, 1)
TRIED = (4.0, 1.0, 0.0, 0.0, 0.25, 0.0)
ORDERS: dict[Order, Sequence[float]] = {
    Order.SETPOINT: (53.0,),
    Order.MODE: (Mode.MANUAL,),
    Order.OUTPUT: (70.0,),
    Order.RELAY: RELAY,
    Order.TRY: TRIED,
    Order.ACCEPT: TRIED,
    Order.WATCH: (0.0, 100.0),
}
"""Every order that a session takes but the last ones, CLOSE and HOLD, with values that make a difference."""
HOMES = pytest.mark.parametrize("mode", [Mode.OFF, Mode.MANUAL, Mode.AUTOMATIC], ids=lambda mode: mode.name.lower())


class Bench:
    """A channel with its session. Time and PV are what the test says; 0.1 s a sample."""

    def __init__(self, mode: Mode = Mode.AUTOMATIC, **limits: float) -> None:
        settings = Settings(safe_output=5.0, **limits)
        self.channel = Channel(0.1, settings, PI, 50.0, mode, 45.0)
        self.now = 100.0
        self.session = Session(self.channel, itertools.count(0x1000, 7).__next__, pv_timeout_s=1.0)
        self.stored: list[Parameters] = []
        self.session.tick(self.now)

    def samples(self, count: int, pv: float = 49.2) -> float:
        """MV after so many samples, in real time."""
        for _ in range(count):
            self.now += 0.1
            self.session.step(pv)
            self.session.tick(self.now)
        return self.channel.mv

    def silence(self, seconds: float, beating: bool = True) -> None:
        """No PV comes; the tuner beats."""
        for _ in range(round(seconds / 0.02)):
            self.now += 0.02
            if beating:
                self.session.heard(TUNER, self.now)
            self.session.tick(self.now)

    def order(self, order: Order, *values: float, number: int | None = None, count: int | None = None) -> Abort | None:
        session = self.session
        usual = (session.next, 0) if order is Order.OPEN else (session.number or session.last, session.count)
        check = check_of(usual[0] if number is None else number, usual[1] if count is None else count, order, values)
        return self.give(order, check, *values)

    def give(self, order: Order, check: int, *values: float) -> Abort | None:
        try:
            self.session.give(order, check, values, self.now, self.stored.append)
        except SdoAbort as abort:
            return abort.code
        return None

    def open(self, *terms: float) -> int:
        """The session's number."""
        assert self.order(Order.OPEN, *(terms or TERMS)) is None
        return self.session.number

    def hand(self, what: OutsideChange) -> Channel:
        """Another hand begins; `settle` after what it does."""
        self.session.on_outside_change(what)
        return self.channel

    def look(self) -> tuple[object, ...]:
        """Everything that an order may change."""
        c = self.channel
        return (
            c.mode, c.setpoint, c.manual_output, c.accepted, c.in_effect, c.on_trial, c.relay, self.session.number,
            self.session.count, self.session.pv_limits, tuple(self.stored),
        )  # fmt: skip

    def is_home(self, home: Home) -> bool:
        c = self.channel
        return (c.mode, c.setpoint, c.manual_output) == (home.mode, home.setpoint, home.manual_output) and (
            c.in_effect == c.accepted and not c.on_trial and c.relay is None and c.relay_state is not RelayState.RUNNING
        )

    def end_by(self, cause: Cause) -> None:
        """Lets the session end so."""
        session, opened = self.session, self.session.number
        match cause:
            case Cause.CLOSED:
                assert self.order(Order.CLOSE) is None
            case Cause.LEASE:
                while session.number == opened:
                    session.heard(TUNER, self.now)
                    self.samples(1)
            case Cause.HEARTBEAT:
                self.samples(12)
            case Cause.NMT:
                session.end(Cause.NMT, operational=False)
            case Cause.NO_PV:
                self.silence(1.2)
            case Cause.PV_LIMIT:
                assert self.order(Order.RELAY, *RELAY[:4], 45.0, 55.0, 0.0, 1) is None
                self.samples(2, 54.9)
                self.samples(1, 55.1)
            case Cause.RELAY_SAMPLES:
                assert self.order(Order.RELAY, *RELAY[:3], 2, *RELAY[4:]) is None
                self.samples(3)
            case Cause.OUTSIDE_CHANGE:
                self.hand(OutsideChange.GAINS)
                session.settle()
            case _:
                raise AssertionError(cause)
        assert (session.is_open, session.last, session.cause) == (False, opened, cause)


CAUSES = [cause for cause in Cause if cause not in (Cause.NONE, Cause.HELD)]
"""The ends of a session that need no order HOLD before."""
WITHOUT_PV = (Cause.NMT, Cause.NO_PV)
NO_NUMBERS = (math.nan, math.inf, 1e30)
