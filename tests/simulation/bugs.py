"""Bugs put in on purpose: what the simulation must find. Each takes a way to replace an attribute, and does so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from loopwright.controller import session
from loopwright.controller.channel import Channel, Home
from loopwright.protocol.objects import Value
from loopwright.protocol.profile import Cause, Mode, Order, RelayState
from loopwright.protocol.session import check_of as check_of_order
from loopwright.protocol.tuner import Tuner
from loopwright.service.jobs import decisions, watching
from loopwright.service.loops import bus_endings, bus_loop, gain_change

Replace = Callable[[Any, str, Any], None]


class _OfAnyCount(int):
    """A check that is equal to that of each of the first orders of a session."""

    checks: frozenset[int]

    def __ne__(self, other: object) -> bool:
        return other not in self.checks


def count_is_not_checked(replace: Replace) -> None:
    """The controller obeys an order of this session whatever its count."""
    real = check_of_order

    def check_of(number: int, count: int, order: Order, values: Sequence[Value]) -> int:
        check = _OfAnyCount(real(number, count, order, values))
        check.checks = frozenset(real(number, each, order, values) for each in range(60))
        return check

    replace(session, "check_of", check_of)


def set_point_stays(replace: Replace) -> None:
    """The end of a session brings mode and gains home, and leaves the set-point."""
    go_home = Channel.go_home

    def goes_home(self: Channel, home: Home, relay_state: RelayState = RelayState.DONE) -> None:
        setpoint = self.setpoint
        go_home(self, home, relay_state)
        self.setpoint = setpoint

    replace(Channel, "go_home", goes_home)


def manual_output_stays(replace: Replace) -> None:
    """The end of a session in manual leaves the manual output where a pulse has taken it."""
    go_home = Channel.go_home

    def goes_home(self: Channel, home: Home, relay_state: RelayState = RelayState.DONE) -> None:
        output = self.manual_output
        go_home(self, home, relay_state)
        if home.mode is Mode.MANUAL:
            self.manual_output = output

    replace(Channel, "go_home", goes_home)


def hold_keeps_automatic(replace: Replace) -> None:
    """HOLD goes home at once, and leaves home in automatic."""

    def held(self: Home) -> Home:
        return self

    replace(Home, "held", held)


def hold_is_not_looked_for(replace: Replace) -> None:
    """Whoever reads a loop back takes one that is held for one that has come home as ever."""
    real = bus_endings.cause_of

    def cause_of(tuner: Tuner) -> Cause:
        cause = real(tuner)
        return Cause.CLOSED if cause is Cause.HELD else cause

    replace(bus_endings, "cause_of", cause_of)


def gains_are_not_compared(replace: Replace) -> None:
    """The watch after acceptance puts the previous gains back whatever the controller holds."""

    def same(*gains: object) -> bool:
        return True

    for module in (gain_change, bus_loop, decisions, watching):
        replace(module, "same_gains", same)


BUGS: dict[str, Callable[[Replace], None]] = {
    "count-is-not-checked": count_is_not_checked,
    "set-point-stays": set_point_stays,
    "manual-output-stays": manual_output_stays,
    "hold-keeps-automatic": hold_keeps_automatic,
    "hold-is-not-looked-for": hold_is_not_looked_for,
    "gains-are-not-compared": gains_are_not_compared,
}
