"""The session of one channel: which tuner holds it, until when, the state it returns to, and its orders in force.

A tuner opens a session with a number that the controller has given out, and commands by orders whose check covers that
number and a running count (`protocol.session`). The session ends when the tuner closes it, when the lease or the
tuner's heartbeat runs out, when PV is lost or leaves the limits that the tuner has set, when the node leaves
operational, or when an operator or another master commands something; the controller itself then restores mode,
set-point, manual output and gains. Where the tuner has found that PV is false, its order HOLD replaces AUTOMATIC by
MANUAL at the MV before the test in what is restored. Time is an argument: seconds of the controller's clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from loopwright.controller.channel import Channel, Home, Parameters, RelaySettings
from loopwright.protocol.objects import Value
from loopwright.protocol.profile import Abort, Cause, Mode, Order, OutsideChange, RelayState
from loopwright.protocol.sdo import SdoAbort
from loopwright.protocol.session import check_of

AGAIN_S = 1.0
"""Time after which an output that answers no PV is sent again while PV stays away, s: the bus may have failed too."""

HELD_UP_S, CATCH_UP_S, CATCH_UP_AGAIN_S = 0.25, 0.5, 3.0
"""Where more than HELD_UP_S lie between two calls of `tick`, usually 20 ms, the controller itself was held up. It then
has CATCH_UP_S to read the frames received meanwhile before it treats any node as silent, once in CATCH_UP_AGAIN_S."""

_NO_HOME = Home(Mode.OFF, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Terms:
    """The terms of a session: the tuner's node-ID, the lease in samples, and times in s of the controller's clock."""

    tuner: int
    lease_samples: int
    lease_s: float
    pv_silence_s: float
    watch_s: float


class Session:
    """A channel and its session with a tuner.

    draw: returns a number that was not given out recently, never 0.
    pv_timeout_s: time without a valid PV after which PV counts as silent, s.
    """

    def __init__(self, channel: Channel, draw: Callable[[], int], pv_timeout_s: float) -> None:
        self.channel = channel
        self.next = draw()
        self.number = 0
        """The number of the open session; 0 for none."""
        self.last = 0
        self.count = 0
        self.cause = Cause.NONE
        self.outside_changes = OutsideChange.NONE
        self.home = _NO_HOME
        self.held = False
        """Whether HOLD was ordered in the session that is open, or ended last."""
        self.home_gains = channel.accepted
        self.terms: Terms | None = None
        self.pv_limits: tuple[float, float] | None = None
        """The limits of PV at which the session ends, in every mode, PV units; None for none."""
        self._draw = draw
        self._pv_timeout_s = pv_timeout_s
        self._answered: tuple[Order, int] | None = None
        self._samples_left = 0
        self._lease_until = self._heard_at = self._valid_at = 0.0
        self._ticked_at, self._caught_up_at = math.inf, -math.inf
        self._good_samples = -1
        self.silent = True
        """Whether there has been no valid PV for too long."""
        self._unsettled = False
        """Whether the channel has gone home and no sample has yet carried the resulting output to the plant."""
        self.unasked = False
        """Whether the output has moved without a PV; the device sends the output and resets this."""
        self._without_pv = False
        """Whether the present output answers no PV, and no PV has arrived since."""
        self._again_at = 0.0

    @property
    def is_open(self) -> bool:
        """Returns whether a session is open."""
        return self.number != 0

    @property
    def holder(self) -> int:
        """Returns the node-ID of the tuner; 0 without a session."""
        return self.terms.tuner if self.terms is not None else 0

    @property
    def pv_is_valid(self) -> bool:
        """Returns whether the last PV was valid and is not silent."""
        return self.channel.measuring and not self.silent

    @property
    def retained(self) -> Home:
        """Returns the state that a restart must restore: that before the test within a session, else the present
        one."""
        return self.home if self.is_open else self.channel.home

    # -- actions of the tuner

    def give(
        self, order: Order, check: int, values: Sequence[Value], now: float, store: Callable[[Parameters], None]
    ) -> None:
        """Puts an order in force. A repetition of the last order is answered as done. Raises SdoAbort.

        values: as staged, in the order of `protocol.session.STAGED`.
        store: stores gains on the disk before they are accepted.
        """
        if self._answered == (order, check):
            return
        if (order is Order.OPEN) == self.is_open:
            raise SdoAbort(Abort.DEVICE_STATE)
        if self.is_open and self.held and order not in (Order.CLOSE, Order.HOLD):  # a held loop is not moved any more
            raise SdoAbort(Abort.DEVICE_STATE)
        number, count = (self.next, 0) if order is Order.OPEN else (self.number, self.count)
        if check != check_of(number, count, order, values):
            raise SdoAbort(Abort.INVALID_VALUE)
        try:
            self._carry_out(order, values, now, store)
        except ValueError:
            raise SdoAbort(Abort.INVALID_VALUE) from None
        self.count += 1
        self._answered = order, check

    def _carry_out(
        self, order: Order, values: Sequence[Value], now: float, store: Callable[[Parameters], None]
    ) -> None:
        channel = self.channel
        numbers = [float(value) for value in values]
        match order:
            case Order.OPEN:
                self._open(Terms(int(numbers[0]), int(numbers[1]), *(ms / 1000.0 for ms in numbers[2:])), now)
            case Order.CLOSE:
                self.end(Cause.CLOSED)
            case Order.HOLD:
                self._hold()
            case Order.SETPOINT:
                channel.setpoint = numbers[0]
            case Order.MODE:
                channel.command_mode(int(numbers[0]))
            case Order.OUTPUT:
                channel.manual_output = numbers[0]
            case Order.WATCH:
                low, high = numbers
                if not -math.inf < low < high < math.inf:
                    raise ValueError("the PV limits must be finite, the low one below the high one")
                self.pv_limits = low, high
            case Order.RELAY:
                amplitude, hysteresis, working, samples, low, high, amplitude_low, average = numbers
                channel.start_relay(
                    RelaySettings(amplitude, hysteresis, working, int(samples), low, high, amplitude_low, int(average))
                )
            case Order.TRY | Order.ACCEPT:
                if channel.mode is Mode.EXPERIMENT:
                    raise SdoAbort(Abort.DEVICE_STATE)
                gains = Parameters(*numbers)
                if order is Order.TRY:
                    channel.try_gains(gains)
                else:
                    store(gains)
                    channel.accept(gains)

    def _hold(self) -> None:
        """Goes home at once, and for AUTOMATIC to MANUAL at the MV before the test: there is no PV to control by."""
        self.home, self.held = self.home.held(), True
        self._go_home(RelayState.DONE)
        self.settle()

    def _open(self, terms: Terms, now: float) -> None:
        if self.channel.on_trial:  # an operator has gains on trial, which a session would end
            raise SdoAbort(Abort.DEVICE_STATE)
        self.number, self.terms, self.home = self.next, terms, self.channel.home
        self.home_gains, self.pv_limits, self.held = self.channel.accepted, None, False
        self.next, self.count, self.outside_changes = self._draw(), 0, OutsideChange.NONE
        self._samples_left = terms.lease_samples
        self._lease_until, self._heard_at, self._valid_at = now + terms.lease_s, now, max(now, self._valid_at)

    def renew(self, number: int, now: float) -> None:
        """Renews the lease by as much as the opening granted. Raises SdoAbort when this session is not open."""
        if not number or number != self.number or self.terms is None:
            raise SdoAbort(Abort.DEVICE_STATE)
        self._samples_left, self._lease_until = self.terms.lease_samples, now + self.terms.lease_s

    def heard(self, node: int, now: float) -> None:
        """Notes a heartbeat of this node."""
        if node == self.holder:
            self._heard_at = now

    # -- effects of time and of others

    def step(self, pv: float) -> float:
        """Takes one sample and returns MV; ends the session on the conditions that are counted in samples or seen in
        PV."""
        if self.is_open:
            if self.channel.relay is not None:
                self._watch_relay(pv)
            if self.pv_limits is not None and (pv < self.pv_limits[0] or pv > self.pv_limits[1]):
                self.end(Cause.PV_LIMIT)
            if not self._samples_left:
                self.end(Cause.LEASE)
            self._samples_left -= 1
        mv = self.channel.step(pv)
        if self._unsettled and not self.channel.measuring:
            self.settle()
            mv, self.unasked = self.channel.mv, False
        self._unsettled = self._without_pv = False
        return mv

    def _watch_relay(self, pv: float) -> None:
        """Ends a relay at its limits. A PV that is not a number does not violate the PV limits."""
        relay = self.channel.relay
        assert relay is not None
        if relay.samples_left == 0:
            self.end(Cause.RELAY_SAMPLES)
        elif pv < relay.settings.pv_low or pv > relay.settings.pv_high:
            self.end(Cause.PV_LIMIT)
        else:
            relay.samples_left -= 1

    def tick(self, now: float) -> None:
        """Ends the session on the conditions that depend on time. Call it about every 20 ms."""
        if now - self._ticked_at > HELD_UP_S and now - self._caught_up_at > CATCH_UP_AGAIN_S:
            self._caught_up_at = now + CATCH_UP_S
        self._ticked_at = now
        caught_up = now >= self._caught_up_at
        if self.channel.good_samples != self._good_samples:
            self._good_samples, self._valid_at = self.channel.good_samples, now
        terms = self.terms
        allowed_s = terms.pv_silence_s if terms is not None else self._pv_timeout_s
        if caught_up or self.silent:
            self.silent = now - self._valid_at > allowed_s
        if terms is None:
            if self._unsettled:
                self.settle()
            elif self._without_pv and now >= self._again_at:
                # `settle`, which knows no time, has sent it for the first time.
                self.unasked |= self._again_at > 0.0
                self._again_at = now + AGAIN_S
            return
        if caught_up and now - self._heard_at > terms.watch_s:
            self.end(Cause.HEARTBEAT)
        elif now > self._lease_until:
            self.end(Cause.LEASE)
        elif self.silent:
            self.end(Cause.NO_PV)

    def on_outside_change(self, what: OutsideChange) -> None:
        """Ends the test because of a command through the ordinary objects; the commanded value stays.

        Call it before the command is carried out, and `settle` after it.
        """
        self.outside_changes |= what
        self._end(Cause.OUTSIDE_CHANGE)

    def end(self, cause: Cause, operational: bool = True) -> None:
        """Ends an open session and restores the state before the test.

        operational: False when the node leaves that state and will receive no more PV.
        """
        self._end(cause)
        self.settle(operational)

    def _end(self, cause: Cause) -> None:
        if self.is_open:
            state = RelayState.ENDED_BY_LIMIT if cause is Cause.PV_LIMIT else RelayState.DONE
            self._go_home(state)
            self.last, self.number, self.terms = self.number, 0, None
            self.cause = Cause.HELD if self.held else cause
            self.pv_limits = None

    def _go_home(self, relay_state: RelayState) -> None:
        self.channel.go_home(self.home, relay_state)
        self._unsettled = True

    def settle(self, operational: bool = True) -> None:
        """Where no PV will ask for the output that results from going home, sets it at once: to the output of the mode,
        in AUTOMATIC to the MV before the test."""
        if (self._unsettled or self._without_pv) and not (operational and self.pv_is_valid):
            # A later command continues from the output that the end of the session has left.
            self.channel.without_pv(self.home.mv if self._unsettled else self.channel.mv)
            self._unsettled, self._without_pv, self.unasked, self._again_at = False, True, True, 0.0
