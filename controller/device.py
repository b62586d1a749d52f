"""The controller device: it answers each PV with the MV of its sample; all other access is by SDO."""

from __future__ import annotations

import math
import secrets
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

from loopwright.controller.channel import Channel, Home, Settings
from loopwright.controller.pid import Parameters
from loopwright.controller.session import Session
from loopwright.protocol.bus import Bus, BusError
from loopwright.protocol.device_runtime import Runtime
from loopwright.protocol.object_dictionary import Dictionary, Writer
from loopwright.protocol.objects import Device, Value
from loopwright.protocol.profile import (
    COMMAND_FRAME,
    CONTROLLER_NODE,
    MV_FRAME,
    PLANT_NODE,
    PV_FRAME,
    RENEWAL_FRAME,
    STATUS_FRAME,
    UNASKED,
    Abort,
    Cause,
    Emcy,
    Mode,
    NmtState,
    Order,
    OutsideChange,
    ParameterCommand,
    channel_ids,
    renewal_id,
)
from loopwright.protocol.real32 import nearest
from loopwright.protocol.sdo import SdoAbort
from loopwright.protocol.session import GAINS, STAGED, object_of

_SHORTEST_PV_TIMEOUT_S = 1.0
_PV_TIMEOUT_SAMPLES = 3

_DRIVEN_S = 2.0
_DRIVEN_SAMPLES = 10
"""A set-point that an RPDO has changed within the longer of these times (s, samples) is driven by an outer loop or a
ramp."""

_GAINS = dict(zip(GAINS, ("Kp", "Ti", "Td", "Tf", "b", "c"), strict=True))
_SETTINGS = {
    "controller_mv_low": "mv_low",
    "controller_mv_high": "mv_high",
    "controller_safe_output": "safe_output",
    "controller_rate_limit": "rate_limit_per_s",
    "controller_pv_low": "pv_low",
    "controller_pv_high": "pv_high",
}
_ENDED_BY = {Cause.LEASE: Emcy.LEASE_USED_UP, Cause.PV_LIMIT: Emcy.PV_LIMIT, Cause.HEARTBEAT: Emcy.TUNER_LOST}


@dataclass(frozen=True, slots=True)
class RetainedState:
    """The state of one channel that outlives a restart.

    accepted: the accepted gains.
    mode, setpoint, manual_output: the state before the test within a session, else the last commanded values.
    """

    accepted: Parameters
    mode: Mode
    setpoint: float
    manual_output: float


@dataclass(frozen=True, slots=True)
class ControllerChannel:
    """The initial state of a channel.

    setpoint: in PV units.
    manual_output: the first MV, in percent.
    """

    parameters: Parameters
    setpoint: float
    settings: Settings = field(default_factory=Settings)
    mode: Mode = Mode.AUTOMATIC
    manual_output: float = 50.0

    @property
    def retained(self) -> RetainedState:
        """Returns the part of this state that is stored over a restart."""
        return RetainedState(self.parameters, self.mode, self.setpoint, self.manual_output)

    def with_retained(self, retained: RetainedState) -> ControllerChannel:
        """Returns this channel with a stored state."""
        return replace(
            self,
            parameters=retained.accepted,
            mode=retained.mode,
            setpoint=retained.setpoint,
            manual_output=retained.manual_output,
        )

    def make(self, sample_time_s: float) -> Channel:
        """Returns the control channel in this state."""
        return Channel(sample_time_s, self.settings, self.parameters, self.setpoint, self.mode, self.manual_output)


class RetainedStateStore(Protocol):
    """The storage of the channels' state over a restart."""

    def write_now(self, channels: Sequence[RetainedState]) -> None:
        """Returns when the state is on the disk. Raises OSError; the state that is to be stored then has to be passed
        again, to `soon`."""
        ...

    def write_soon(self, channels: Sequence[RetainedState]) -> None:
        """Returns at once; the state is written within seconds."""
        ...


class NoRetainedState:
    """Storage that stores nothing."""

    def write_now(self, channels: Sequence[RetainedState]) -> None:
        pass

    def write_soon(self, channels: Sequence[RetainedState]) -> None:
        pass


_Status = tuple[Mode, bool, float, bool, Cause]


@dataclass(slots=True)
class _PdoSetpoint:
    """The last set-point received by RPDO.

    value: the set-point, PV units; None before the first one.
    changed_at: when it last changed, s of the controller's clock.
    """

    value: float | None = None
    changed_at: float = -math.inf


def _home_gain(attribute: str, session: Session) -> float:
    return float(getattr(session.home_gains, attribute))


def _random_number() -> int:
    return secrets.randbelow(0xFFFFFFFF) + 1


class ControllerDevice:
    """The controller on its bus.

    pv_timeout_s: wall time without a valid PV after which EMCY 8250h is sent; by default 3 samples, at least 1 s.
    retained_state: storage of accepted gains, mode, set-point and manual output over a restart; gains that cannot be
    stored are not accepted.
    draw: returns random numbers for sessions.
    """

    def __init__(
        self,
        bus: Bus,
        channels: Sequence[ControllerChannel],
        sample_time_s: float = 0.1,
        node: int = CONTROLLER_NODE,
        plant_node: int = PLANT_NODE,
        pv_timeout_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        retained_state: RetainedStateStore | None = None,
        draw: Callable[[], int] = _random_number,
    ) -> None:
        self._started_with = list(channels)
        self._started_sample_time_s = sample_time_s
        self._asked_pv_timeout_s = pv_timeout_s
        self.retained_store: RetainedStateStore = retained_state or NoRetainedState()
        self._is_retained = retained_state is not None
        self._draw = draw
        count = len(channels)
        self._sample_time_s = sample_time_s
        self.dictionary = dictionary = Dictionary(Device.CONTROLLER, count, plant_node, node)
        self.runtime = runtime = Runtime(bus, node, dictionary, clock)
        self._send = bus.send
        ids = [channel_ids(k, plant_node, node) for k in range(1, count + 1)]
        self._mv_ids = [each.mv for each in ids]
        self._status_ids = [each.status for each in ids]
        runtime.handlers = {
            **{each.pv: partial(self._on_pv, at) for at, each in enumerate(ids)},
            **{each.command: partial(self._on_command, at) for at, each in enumerate(ids)},
            renewal_id(node): self._on_renewal,
        }
        runtime.lengths = {
            **{each.pv: PV_FRAME.size for each in ids},
            **{each.command: COMMAND_FRAME.size for each in ids},
            renewal_id(node): RENEWAL_FRAME.size,
        }
        runtime.on_tick = self._on_tick
        runtime.on_leave_operational = self._on_leave_operational
        runtime.on_heartbeat = self._on_heartbeat
        runtime.on_reset = self._on_reset
        self._connect(dictionary)
        self._power_on()
        self._retained = self._retained_now()

    @property
    def channels(self) -> list[Channel]:
        return [session.channel for session in self.sessions]

    def start(self) -> None:
        """Boots the device on its bus."""
        self.runtime.start()

    def _power_on(self) -> None:
        """Restores every channel, and the staged values, to their state at the start of the program."""
        count = len(self._started_with)
        self._numbers = [0] * count
        self._pvs = [0.0] * count
        self.told: list[_Status | None] = [None] * count
        self._driven = [_PdoSetpoint() for _ in range(count)]
        sample_time_s = self._started_sample_time_s
        self._set_up([each.make(sample_time_s) for each in self._started_with], sample_time_s)
        self.dictionary.restore(0x2000, 0xFFFF)
        self.dictionary.set("sample_time", round(sample_time_s * 1e6))
        for at, each in enumerate(self._started_with):
            self.dictionary.set("controller_relay_pv_low", each.settings.pv_low, at + 1)
            self.dictionary.set("controller_relay_pv_high", each.settings.pv_high, at + 1)

    def _set_up(self, channels: Sequence[Channel], sample_time_s: float) -> None:
        self._sample_time_s = sample_time_s
        usual_s = max(_SHORTEST_PV_TIMEOUT_S, _PV_TIMEOUT_SAMPLES * sample_time_s)
        self.sessions = [Session(each, self._draw, self._asked_pv_timeout_s or usual_s) for each in channels]

    # The sample

    def _on_pv(self, at: int, data: bytes) -> None:
        pv, number = PV_FRAME.unpack(data)
        if number == self._numbers[at] and number:  # a repeated frame is the same sample
            return
        self._numbers[at] = number
        self._pvs[at] = pv
        session = self.sessions[at]
        was_open = session.number
        mv = session.step(pv)
        self._report_if_new(at)
        if was_open and not session.number:
            self._say_end(at)
        self._send(self._mv_ids[at], MV_FRAME.pack(mv, number))

    def _on_command(self, at: int, data: bytes) -> None:
        """Takes a set-point by RPDO. A repeated value is no new command: it is ignored within a session, and after a
        session as long as it equals the set-point."""
        setpoint = COMMAND_FRAME.unpack(data)[0]
        if not math.isfinite(setpoint):
            return
        session, driven = self.sessions[at], self._driven[at]
        before = driven.value
        if before is None:  # rounded as in an RPDO
            before = nearest(session.home.setpoint if session.is_open else session.channel.setpoint)
        driven.value = setpoint
        if setpoint != before:
            driven.changed_at = self.runtime.clock()
        elif session.is_open or setpoint == nearest(session.channel.setpoint):
            return
        with self._outside_change(at + 1, OutsideChange.SETPOINT) as channel:
            channel.setpoint = setpoint

    def _report_if_new(self, at: int) -> None:
        session = self.sessions[at]
        channel = session.channel
        status = channel.mode, channel.on_trial, channel.setpoint, session.is_open, session.cause
        if status != self.told[at]:
            self._send(self._status_ids[at], STATUS_FRAME.pack(*status))
            self.told[at] = status  # last: what the bus has not taken is told again

    def _on_tick(self, now: float) -> None:
        if self.runtime.state is not NmtState.OPERATIONAL:
            return
        failed: BusError | None = None
        for at in range(len(self.sessions)):
            try:
                self._tick_channel(at, now)
            except BusError as error:  # the time of the other channels goes on
                failed = error
        self._write_soon()
        if failed is not None:
            raise failed
        silent = [at for at, session in enumerate(self.sessions, start=1) if session.silent]
        if silent:
            self.runtime.raise_error(Emcy.NO_PV, bytes(silent[:1]))
        else:
            self.runtime.clear_error(Emcy.NO_PV)

    def _tick_channel(self, at: int, now: float) -> None:
        session = self.sessions[at]
        was_open = session.number
        session.tick(now)
        if was_open and not session.number:
            self._say_end(at)
        self._send_unasked(at)
        self._report_if_new(at)

    # Sessions

    def _order(self, order: Order, sub: int, value: Value) -> None:
        session, now = self.sessions[sub - 1], self.runtime.clock()
        if order is Order.OPEN and not session.is_open:
            if self.runtime.state is not NmtState.OPERATIONAL:  # no time-out would end it there
                raise SdoAbort(Abort.DEVICE_STATE)
            if self._is_driven(sub - 1, now):
                raise SdoAbort(Abort.LOCAL_CONTROL)
        was_open = session.number
        values = [self.dictionary.get(name, sub) for name in STAGED[order]]
        session.give(order, int(value), values, now, partial(self._store, sub))
        if session.number and not was_open:
            self.runtime.listen(each.holder for each in self.sessions)
            for code in _ENDED_BY.values():
                self.runtime.clear_error(code, bytes((sub,)))
        if order is Order.HOLD:
            self._write_soon()  # not first with the next tick: a restart must not go back to automatic
        self._report_if_new(sub - 1)
        self._send_unasked(sub - 1)

    def _is_driven(self, at: int, now: float) -> bool:
        return now - self._driven[at].changed_at < max(_DRIVEN_S, _DRIVEN_SAMPLES * self._sample_time_s)

    def _renew(self, sub: int, value: Value) -> None:
        self.sessions[sub - 1].renew(int(value), self.runtime.clock())

    def _on_renewal(self, data: bytes) -> None:
        """Renews a lease by RPDO, which needs no lock and no answer. A renewal of a session that is over is answered
        with the status, which the tuner must have missed."""
        number, sub = RENEWAL_FRAME.unpack(data)
        if not 1 <= sub <= len(self.sessions):
            return
        try:
            self._renew(sub, number)
        except SdoAbort:
            self.told[sub - 1] = None
            self._report_if_new(sub - 1)

    @contextmanager
    def _outside_change(self, sub: int, what: OutsideChange) -> Iterator[Channel]:
        """Yields the channel to a command through the ordinary objects, which ends a test on it."""
        session = self.sessions[sub - 1]
        session.on_outside_change(what)
        try:
            yield session.channel
        finally:
            session.settle()
            self._send_unasked(sub - 1)

    def _say_end(self, at: int) -> None:
        code = _ENDED_BY.get(self.sessions[at].cause)
        if code is not None:
            self.runtime.raise_error(code, bytes((at + 1,)))

    def _send_unasked(self, at: int) -> None:
        """Sends an output that answers no PV: the plant applies it at once."""
        session = self.sessions[at]
        if session.unasked:
            session.unasked = False
            self._send(self._mv_ids[at], MV_FRAME.pack(session.channel.mv, UNASKED))

    def _on_heartbeat(self, node: int) -> None:
        now = self.runtime.clock()
        for session in self.sessions:
            session.heard(node, now)

    def _on_leave_operational(self) -> None:
        for session in self.sessions:  # all of them before a frame, which the bus may not take
            session.end(Cause.NMT, operational=False)
        for at in range(len(self.sessions)):
            self._report_if_new(at)
            self._send_unasked(at)

    def _on_reset(self) -> None:
        """Restores the state at power-on: the stored state, or else that of the start of the program."""
        if self._is_retained:
            pairs = zip(self._started_with, self._retained_now(), strict=True)
            self._started_with = [each.with_retained(retained) for each, retained in pairs]
        self._power_on()

    # State that outlives a restart

    def _retained_now(self) -> list[RetainedState]:
        return [self._retained_of(session, session.channel.accepted) for session in self.sessions]

    @staticmethod
    def _retained_of(session: Session, accepted: Parameters) -> RetainedState:
        home: Home = session.retained
        return RetainedState(accepted, home.mode, home.setpoint, home.manual_output)

    def _write_soon(self) -> None:
        if not self._is_retained:
            return
        retained = self._retained_now()
        if retained != self._retained:
            self._retained = retained
            self.retained_store.write_soon(retained)

    def _store(self, sub: int, parameters: Parameters) -> None:
        """Writes gains to the disk before they are accepted, so that a confirmed acceptance outlives a power cut."""
        retained = self._retained_now()
        retained[sub - 1] = self._retained_of(self.sessions[sub - 1], parameters)
        try:
            self.retained_store.write_now(retained)
        except OSError as error:
            print(f"controller: channel {sub} not accepted, it could not be stored: {error}", file=sys.stderr)
            self._retained = self._retained_now()
            self.retained_store.write_soon(self._retained)
            raise SdoAbort(Abort.NOT_STORED) from error
        self._retained = retained

    # The object dictionary

    def _connect(self, dictionary: Dictionary) -> None:
        read, write = dictionary.on_read, dictionary.on_write
        read["sample_number"] = lambda sub: max(self._numbers)
        read["controller_received_pv"] = lambda sub: self._pvs[sub - 1]
        for name in ("mode_command", "mode"):
            self._reads(f"controller_{name}", lambda session: session.channel.mode)
        write["controller_mode_command"] = self._write_mode
        self._reads("controller_on", lambda session: session.channel.mode >= Mode.AUTOMATIC)
        write["controller_on"] = lambda sub, value: self._write_mode(sub, Mode.AUTOMATIC if value else Mode.OFF)
        self._reads("controller_manual_output", lambda session: session.channel.manual_output)
        write["controller_manual_output"] = self._write_manual_output
        self._reads("controller_setpoint", lambda session: session.channel.setpoint)
        write["controller_setpoint"] = self._write_setpoint
        self._reads("controller_mv", lambda session: session.channel.mv)
        self._reads("controller_action", lambda session: not session.channel.settings.reverse)
        write["controller_action"] = lambda sub, value: self._write_settings("reverse", sub, not value)
        for name, attribute in _SETTINGS.items():
            read[name] = partial(self._read_settings, attribute)
            write[name] = partial(self._write_settings, attribute)
        for name, attribute in _GAINS.items():
            read[f"controller_staged_{name}"] = partial(self._read_gain, "staged", attribute)
            read[f"controller_accepted_{name}"] = partial(self._read_gain, "accepted", attribute)
            self._reads(f"controller_home_{name}", partial(_home_gain, attribute))
            write[f"controller_staged_{name}"] = self._writer_of_gain(attribute)
        write["controller_parameter_command"] = self._write_parameter_command
        self._reads("controller_on_trial", lambda session: session.channel.on_trial)
        self._reads("controller_accept_count", lambda session: session.channel.accept_count)
        self._reads("controller_pv_valid", lambda session: session.pv_is_valid)
        self._reads("controller_session_next", lambda session: session.next)
        self._reads("controller_session", lambda session: session.number)
        self._reads("controller_session_last", lambda session: session.last)
        self._reads("controller_session_count", lambda session: session.count)
        self._reads("controller_session_holder", lambda session: session.holder)
        self._reads("controller_session_is_open", lambda session: session.is_open)
        self._reads("controller_cause", lambda session: session.cause)
        self._reads("controller_outside_changes", lambda session: session.outside_changes)
        self._reads("controller_home_mode", lambda session: session.home.mode)
        self._reads("controller_home_setpoint", lambda session: session.home.setpoint)
        self._reads("controller_home_manual_output", lambda session: session.home.manual_output)
        self._reads("controller_home_mv", lambda session: session.home.mv)
        write["controller_session_renewal"] = self._renew
        for order in Order:
            write[object_of(order)] = partial(self._order, order)
        self._reads("controller_relay_state", lambda session: session.channel.relay_state)
        read["controller_proportional_band"] = self._proportional_band
        read["controller_ti"] = partial(self._read_gain, "in_effect", "Ti")
        read["controller_td"] = partial(self._read_gain, "in_effect", "Td")
        read["controller_cycle_time"] = lambda sub: self._sample_time_s
        write["sample_time"] = self._write_sample_time

    def _reads(self, name: str, value: Callable[[Session], Value]) -> None:
        self.dictionary.on_read[name] = lambda sub: value(self.sessions[sub - 1])

    def _read_settings(self, attribute: str, sub: int) -> float:
        return float(getattr(self.channels[sub - 1].settings, attribute))

    def _write_settings(self, attribute: str, sub: int, value: Value) -> None:
        changed: dict[str, Any] = {attribute: value}
        try:
            settings = replace(self.channels[sub - 1].settings, **changed)
        except ValueError:
            raise SdoAbort(Abort.MAXIMUM_BELOW_MINIMUM) from None
        with self._outside_change(sub, OutsideChange.LIMITS) as channel:
            channel.settings = settings

    def _read_gain(self, parameter_set: str, attribute: str, sub: int) -> float:
        return float(getattr(getattr(self.channels[sub - 1], parameter_set), attribute))

    def _writer_of_gain(self, attribute: str) -> Writer:
        def write(sub: int, value: Value) -> None:
            channel = self.channels[sub - 1]
            channel.stage(replace(channel.staged, **{attribute: float(value)}))

        return write

    def _write_setpoint(self, sub: int, value: Value) -> None:
        with self._outside_change(sub, OutsideChange.SETPOINT) as channel:
            channel.setpoint = float(value)

    def _write_manual_output(self, sub: int, value: Value) -> None:
        with self._outside_change(sub, OutsideChange.OUTPUT) as channel:
            channel.manual_output = float(value)

    def _write_mode(self, sub: int, value: Value) -> None:
        with self._outside_change(sub, OutsideChange.MODE) as channel:
            channel.command_mode(int(value))

    def _write_parameter_command(self, sub: int, value: Value) -> None:
        """Carries out a gain command that is given without a session."""
        with self._outside_change(sub, OutsideChange.GAINS) as channel:
            if value == ParameterCommand.GO_BACK:
                channel.go_back()
            elif value == ParameterCommand.TRY:
                channel.try_gains(channel.staged)
            else:
                self._store(sub, channel.in_effect)
                channel.accept(channel.in_effect)

    def _proportional_band(self, sub: int) -> float:
        """Returns the proportional band in percent of the PV span."""
        channel = self.channels[sub - 1]
        limits = channel.settings
        span = channel.in_effect.Kp * (limits.pv_high - limits.pv_low)
        return 100.0 * (limits.mv_high - limits.mv_low) / span if span else 0.0

    def _write_sample_time(self, sub: int, value: Value) -> None:
        """Restarts every channel with the new cycle time, on its accepted gains and at its present output."""
        if self.runtime.state is not NmtState.PRE_OPERATIONAL:
            raise SdoAbort(Abort.DEVICE_STATE)
        sample_time_s = int(value) / 1e6
        channels = [
            Channel(sample_time_s, old.settings, old.accepted, old.setpoint, old.mode, old.mv) for old in self.channels
        ]
        self._set_up(channels, sample_time_s)
