"""The controller device: each PV that arrives is answered with the MV of its sample; everything else is SDO."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from controller.channel import Channel, Settings
from controller.pid import Parameters
from protocol.bus import Bus
from protocol.dictionary import Dictionary, Writer
from protocol.objects import Device, Value
from protocol.profile import (
    COMMAND_FRAME,
    CONTROLLER_NODE,
    MV_FRAME,
    PLANT_NODE,
    PV_FRAME,
    STATUS_FRAME,
    TUNER_NODE,
    Abort,
    Cause,
    Emcy,
    Experiment,
    ExperimentState,
    Mode,
    NmtState,
    ParameterCommand,
    channel_ids,
)
from protocol.runtime import Runtime
from protocol.sdo import SdoAbort

_SHORTEST_PV_TIMEOUT_S = 1.0
_PV_TIMEOUT_SAMPLES = 3

_GAINS = {"kp": "Kp", "ti": "Ti", "td": "Td", "tf": "Tf", "b": "b", "c": "c"}
_SETTINGS = {
    "controller_mv_low": "mv_low",
    "controller_mv_high": "mv_high",
    "controller_safe_output": "safe_output",
    "controller_rate_limit": "rate_limit_per_s",
    "controller_pv_low": "pv_low",
    "controller_pv_high": "pv_high",
}


@dataclass(frozen=True, slots=True)
class ControllerChannel:
    """What a channel starts with. setpoint in PV units, manual_output (the first MV) in percent."""

    parameters: Parameters
    setpoint: float
    settings: Settings = field(default_factory=Settings)
    mode: Mode = Mode.AUTOMATIC
    manual_output: float = 50.0


_Status = tuple[Mode, bool, float]


class ControllerDevice:
    """pv_timeout_s: wall time without a PV after which EMCY 8250h is sent; default 3 samples, at least 1 s.

    keep: called with the accepted sets whenever one changes; what raises OSError there is not accepted.
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
        keep: Callable[[Sequence[Parameters]], None] = lambda accepted: None,
    ) -> None:
        self._keep = keep
        count = len(channels)
        self._sample_time_s = sample_time_s
        self._pv_timeout_s = pv_timeout_s or max(_SHORTEST_PV_TIMEOUT_S, _PV_TIMEOUT_SAMPLES * sample_time_s)
        self.channels = [
            Channel(sample_time_s, each.settings, each.parameters, each.setpoint, each.mode, each.manual_output)
            for each in channels
        ]
        self.dictionary = dictionary = Dictionary(Device.CONTROLLER, count, plant_node, node)
        self.runtime = runtime = Runtime(bus, node, dictionary, clock)
        self._send = bus.send
        ids = [channel_ids(k, plant_node, node) for k in range(1, count + 1)]
        self._mv_ids = [each.mv for each in ids]
        self._status_ids = [each.status for each in ids]
        self._numbers = [0] * count
        self._pvs = [0.0] * count
        self._told: list[_Status | None] = [None] * count
        self._pv_seen: list[tuple[int, float] | None] = [None] * count
        runtime.handlers = {
            **{each.pv: partial(self._on_pv, at) for at, each in enumerate(ids)},
            **{each.command: partial(self._on_command, at) for at, each in enumerate(ids)},
        }
        runtime.on_tick = self._on_tick
        runtime.on_leave_operational = self._on_leave_operational
        runtime.on_heartbeat_lost = self._on_heartbeat_lost
        runtime.on_reset = self._on_reset
        dictionary.set("sample_time", round(sample_time_s * 1e6))
        for at, each in enumerate(channels):
            dictionary.set("controller_relay_pv_low", each.settings.pv_low, at + 1)
            dictionary.set("controller_relay_pv_high", each.settings.pv_high, at + 1)
        self._connect(dictionary)

    def start(self) -> None:
        self.runtime.start()

    # The sample

    def _on_pv(self, at: int, data: bytes) -> None:
        if len(data) != PV_FRAME.size:
            return
        pv, number = PV_FRAME.unpack(data)
        if number == self._numbers[at] and number:  # a frame that came twice is one sample
            return
        self._numbers[at] = number
        self._pvs[at] = pv
        channel = self.channels[at]
        lease = channel.lease
        mv = channel.step(pv)
        if (channel.mode, channel.on_trial, channel.setpoint) != self._told[at]:
            self._report(at)
        if lease == 1 and channel.cause is Cause.LEASE:
            self.runtime.raise_error(Emcy.LEASE_USED_UP, bytes((at + 1,)))
        self._send(self._mv_ids[at], MV_FRAME.pack(mv, number))

    def _on_command(self, at: int, data: bytes) -> None:
        if len(data) != COMMAND_FRAME.size:
            return
        setpoint = COMMAND_FRAME.unpack(data)[0]
        if setpoint - setpoint == 0.0:  # finite
            self.channels[at].setpoint = setpoint

    def _report(self, at: int) -> None:
        """The status PDO, and the emergency of an experiment that a limit has ended."""
        channel = self.channels[at]
        before = self._told[at]
        self._told[at] = (channel.mode, channel.on_trial, channel.setpoint)
        self._send(self._status_ids[at], STATUS_FRAME.pack(channel.mode, channel.on_trial, channel.setpoint))
        ended = before is not None and before[0] is Mode.EXPERIMENT and channel.mode is not Mode.EXPERIMENT
        if ended and channel.experiment_state is ExperimentState.ENDED_BY_LIMIT:
            self.runtime.raise_error(Emcy.PV_LIMIT, bytes((at + 1,)))

    def _on_tick(self, now: float) -> None:
        if self.runtime.state is not NmtState.OPERATIONAL:
            return
        silent = []
        for at, channel in enumerate(self.channels):
            if (channel.mode, channel.on_trial, channel.setpoint) != self._told[at]:
                self._report(at)
            seen, number = self._pv_seen[at], self._numbers[at]
            if seen is None or seen[0] != number:
                self._pv_seen[at] = (number, now)
            elif now - seen[1] > self._pv_timeout_s:
                silent.append(at + 1)
        if silent:
            self.runtime.raise_error(Emcy.NO_PV, bytes(silent[:1]))
        else:
            self.runtime.clear_error(Emcy.NO_PV)

    # Going back

    def _go_back_from_trials(self, cause: Cause) -> int:
        """Every channel on which a tuner has something open; the mask of them."""
        mask = 0
        for at, channel in enumerate(self.channels):
            if channel.lease or channel.on_trial or channel.mode is Mode.EXPERIMENT:
                channel.go_back(cause)
                mask |= 1 << at
        return mask

    def _on_heartbeat_lost(self, node: int) -> bytes | None:
        """A tuner that has let every loop go may fall silent. It leaves the watch armed, for it cannot know whether
        another tuner holds a loop here; we know. The emergency names the first 32 channels."""
        if node != TUNER_NODE:
            return bytes(4)
        mask = self._go_back_from_trials(Cause.HEARTBEAT)
        return (mask & 0xFFFFFFFF).to_bytes(4, "little") if mask else None

    def _on_leave_operational(self) -> None:
        self._go_back_from_trials(Cause.NMT)

    def _on_reset(self) -> None:
        for at, channel in enumerate(self.channels):
            channel.stage(channel.accepted)
            self._told[at] = None
            self._pv_seen[at] = None

    # The object dictionary

    def _connect(self, dictionary: Dictionary) -> None:
        read, write = dictionary.on_read, dictionary.on_write
        channels = self.channels
        read["sample_number"] = lambda sub: max(self._numbers)
        read["controller_received_pv"] = lambda sub: self._pvs[sub - 1]
        write["controller_received_pv"] = self._only_by_pdo
        read["controller_mode_command"] = read["controller_mode"] = lambda sub: channels[sub - 1].mode
        write["controller_mode_command"] = self._write_mode
        read["controller_on"] = lambda sub: channels[sub - 1].mode >= Mode.AUTOMATIC
        write["controller_on"] = lambda sub, value: self._write_mode(sub, Mode.AUTOMATIC if value else Mode.OFF)
        read["controller_manual_output"] = lambda sub: channels[sub - 1].manual_output
        write["controller_manual_output"] = self._write_manual_output
        read["controller_setpoint"] = lambda sub: channels[sub - 1].setpoint
        write["controller_setpoint"] = self._write_setpoint
        read["controller_mv"] = lambda sub: channels[sub - 1].mv
        read["controller_action"] = lambda sub: not channels[sub - 1].settings.reverse
        write["controller_action"] = lambda sub, value: self._write_settings("reverse", sub, not value)
        for name, attribute in _SETTINGS.items():
            read[name] = partial(self._read_settings, attribute)
            write[name] = partial(self._write_settings, attribute)
        for name, attribute in _GAINS.items():
            read[f"controller_staged_{name}"] = partial(self._read_gain, "staged", attribute)
            read[f"controller_accepted_{name}"] = partial(self._read_gain, "accepted", attribute)
            write[f"controller_staged_{name}"] = self._writer_of_gain(attribute)
        write["controller_parameter_command"] = self._write_parameter_command
        read["controller_on_trial"] = lambda sub: channels[sub - 1].on_trial
        read["controller_accept_count"] = lambda sub: channels[sub - 1].accept_count
        read["controller_lease"] = lambda sub: channels[sub - 1].lease
        write["controller_lease"] = self._write_lease
        write["controller_lease_renewal"] = self._renew_lease
        read["controller_cause"] = lambda sub: channels[sub - 1].cause
        read["controller_experiment_state"] = lambda sub: channels[sub - 1].experiment_state
        read["controller_proportional_band"] = self._proportional_band
        read["controller_ti"] = partial(self._read_gain, "in_effect", "Ti")
        read["controller_td"] = partial(self._read_gain, "in_effect", "Td")
        read["controller_cycle_time"] = lambda sub: self._sample_time_s
        write["sample_time"] = self._write_sample_time

    def _only_by_pdo(self, sub: int, value: Value) -> None:
        raise SdoAbort(Abort.DEVICE_STATE)

    def _read_settings(self, attribute: str, sub: int) -> float:
        return float(getattr(self.channels[sub - 1].settings, attribute))

    def _write_settings(self, attribute: str, sub: int, value: Value) -> None:
        channel = self.channels[sub - 1]
        changed: dict[str, Any] = {attribute: value}
        try:
            channel.settings = replace(channel.settings, **changed)
        except ValueError:
            raise SdoAbort(Abort.MAXIMUM_BELOW_MINIMUM) from None

    def _read_gain(self, parameter_set: str, attribute: str, sub: int) -> float:
        return float(getattr(getattr(self.channels[sub - 1], parameter_set), attribute))

    def _writer_of_gain(self, attribute: str) -> Writer:
        def write(sub: int, value: Value) -> None:
            channel = self.channels[sub - 1]
            channel.stage(replace(channel.staged, **{attribute: float(value)}))

        return write

    def _write_setpoint(self, sub: int, value: Value) -> None:
        self.channels[sub - 1].setpoint = float(value)

    def _write_manual_output(self, sub: int, value: Value) -> None:
        self.channels[sub - 1].manual_output = float(value)

    def _write_mode(self, sub: int, value: Value) -> None:
        if value == Mode.EXPERIMENT:
            self._start_experiment(sub)
        else:
            self.channels[sub - 1].command_mode(int(value))

    def _start_experiment(self, sub: int) -> None:
        if self.dictionary.get("controller_experiment", sub) != Experiment.RELAY:
            raise SdoAbort(Abort.DEVICE_STATE)
        amplitude, hysteresis, working_output, parallel_gain, pv_low, pv_high = (
            float(self.dictionary.get(f"controller_relay_{name}", sub))
            for name in ("amplitude", "hysteresis", "working_output", "parallel_gain", "pv_low", "pv_high")
        )
        most = int(self.dictionary.get("controller_relay_max_samples", sub))
        low = float(self.dictionary.get("controller_relay_amplitude_low", sub))
        average = int(self.dictionary.get("controller_relay_average", sub))
        try:
            self.channels[sub - 1].start_relay(
                amplitude, hysteresis, working_output, parallel_gain, most, pv_low, pv_high, low, average
            )
        except ValueError:
            raise SdoAbort(Abort.INVALID_VALUE) from None
        self.runtime.clear_error(Emcy.PV_LIMIT, bytes((sub,)))

    def _write_parameter_command(self, sub: int, value: Value) -> None:
        channel = self.channels[sub - 1]
        if value == ParameterCommand.GO_BACK:
            channel.go_back(Cause.COMMAND)
        elif channel.mode is Mode.EXPERIMENT:
            raise SdoAbort(Abort.DEVICE_STATE)
        elif value == ParameterCommand.TRY:
            channel.try_staged()
        else:
            sets = [each.accepted for each in self.channels]
            sets[sub - 1] = channel.in_effect
            try:
                self._keep(sets)
            except OSError as error:
                print(f"controller: channel {sub} not accepted, it could not be kept: {error}", file=sys.stderr)
                raise SdoAbort(Abort.NOT_STORED) from error
            channel.accept()

    def _write_lease(self, sub: int, value: Value) -> None:
        self.channels[sub - 1].renew_lease(int(value))
        if value:
            self.runtime.clear_error(Emcy.LEASE_USED_UP, bytes((sub,)))

    def _renew_lease(self, sub: int, value: Value) -> None:
        """Unlike a lease written, it never opens a session: one that has ended stays ended."""
        if not self.channels[sub - 1].lease:
            raise SdoAbort(Abort.DEVICE_STATE)
        self.channels[sub - 1].renew_lease(int(value))

    def _proportional_band(self, sub: int) -> float:
        """Percent of span."""
        channel = self.channels[sub - 1]
        limits = channel.settings
        span = channel.in_effect.Kp * (limits.pv_high - limits.pv_low)
        return 100.0 * (limits.mv_high - limits.mv_low) / span if span else 0.0

    def _write_sample_time(self, sub: int, value: Value) -> None:
        """A new cycle time starts every channel anew on its accepted set, at its present output."""
        if self.runtime.state is not NmtState.PRE_OPERATIONAL:
            raise SdoAbort(Abort.DEVICE_STATE)
        self._sample_time_s = int(value) / 1e6
        for at, old in enumerate(self.channels):
            mode = Mode.AUTOMATIC if old.mode is Mode.EXPERIMENT else old.mode
            self.channels[at] = Channel(self._sample_time_s, old.settings, old.accepted, old.setpoint, mode, old.mv)
