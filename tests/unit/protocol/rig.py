"""Plant and controller devices joined by a bus in memory, with a client that speaks SDO."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.controller.channel import Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice, RetainedStateStore
from loopwright.controller.pid import Parameters
from loopwright.plantsim.catalogue import find
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.protocol.objects import Value, lookup
from loopwright.protocol.profile import (
    EMCY_FRAME,
    HEARTBEAT_FRAME,
    NMT_FRAME,
    NMT_ID,
    RENEWAL_FRAME,
    STATUS_FRAME,
    TUNER_NODE,
    Abort,
    Cause,
    Mode,
    NmtCommand,
    NmtState,
    Order,
    channel_ids,
    emcy_id,
    heartbeat_id,
    renewal_id,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.session import STAGED, check_of, object_of
from tests.unit.protocol.memory_bus import Wire

PLANT, CONTROLLER = 0x10, 0x20
IDS = channel_ids(1)
KP, TI = 200.0, 12.0  # percent per PV unit: "fopdt" has 100 % per unit, ultimate gain 850


class Rig:
    """Both devices and a client, pumped in turns; the plant starts held."""

    def __init__(
        self,
        channels: int = 1,
        pace: float = 0.0,
        retained_state: RetainedStateStore | None = None,
        setpoint: float = 50.0,
    ) -> None:
        self.wire = Wire()
        self.client = self.wire.open()
        entry = find("fopdt")
        self.plant = PlantDevice(
            self.wire.open(), [PlantChannel(entry.build)] * channels, pace=pace, run=0, clock=self.wire.clock
        )
        settings = Settings(pv_low=40.0, pv_high=60.0)
        self.controller = ControllerDevice(
            self.wire.open(),
            [ControllerChannel(Parameters(KP, TI), setpoint, settings)] * channels,
            clock=self.wire.clock,
            retained_state=retained_state,
        )
        self.controller.start()
        self.plant.start()

    def pump(self) -> None:
        """Until nobody has anything to say."""
        busy = True
        while busy:
            busy = self.plant.runtime.poll(0.0) | self.controller.runtime.poll(0.0)
            busy |= (self.plant.runtime.due or self.wire.clock.now + 1.0) <= self.wire.clock.now

    def wait(self, seconds: float, alive: Sequence[int] = ()) -> None:
        """Wall time passes in steps of 20 ms, as the devices see it on a quiet bus; nodes in `alive` beat meanwhile."""
        for _ in range(round(seconds / 0.02)):
            for node in alive:
                self.client.send(heartbeat_id(node), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
            self.wire.clock.now += 0.02
            for device in (self.plant, self.controller):
                while device.runtime.poll(1e-9):
                    pass
        self.pump()

    def run(self, samples: int) -> None:
        assert self.write("plant_samples_to_run", samples) is None
        self.pump()

    def write(self, name: str, value: float, sub: int = 1) -> Abort | None:
        entry = lookup(name)
        sub = sub if entry.count(1) else 0
        data = entry.type.encode(value)
        command = 0x23 | (4 - len(data)) << 2
        answer = self._request(name, bytes((command,)) + entry.index.to_bytes(2, "little") + bytes((sub,)), data)
        return Abort(int.from_bytes(answer[4:8], "little")) if answer[0] == 0x80 else None

    def read(self, name: str, sub: int = 1) -> float:
        entry = lookup(name)
        sub = sub if entry.count(1) else 0
        answer = self._request(name, b"\x40" + entry.index.to_bytes(2, "little") + bytes((sub,)), b"")
        assert answer[0] & 0xF3 == 0x43
        return float(entry.type.decode(answer[4 : 4 + entry.type.size]))

    def _request(self, name: str, header: bytes, data: bytes) -> bytes:
        node = PLANT if name.startswith("plant_") else CONTROLLER
        self.client.send(sdo_request_id(node), header + data.ljust(4, b"\0"))
        self.pump()
        return self.wire.sent(sdo_response_id(node))[-1]

    def nmt(self, command: NmtCommand, node: int = 0) -> None:
        self.client.send(NMT_ID, NMT_FRAME.pack(command, node))
        self.pump()

    def emergencies(self, node: int) -> list[int]:
        return [EMCY_FRAME.unpack(data)[0] for data in self.wire.sent(emcy_id(node))]

    def status(self) -> tuple[int, int, float]:
        """Mode, on trial, set-point."""
        mode, on_trial, setpoint, _, _ = STATUS_FRAME.unpack(self.wire.sent(IDS.status)[-1])
        return mode, on_trial, setpoint

    def session(self) -> tuple[bool, Cause]:
        """Whether one is open, and why the last one ended: as the status PDO says it."""
        *_, is_open, cause = STATUS_FRAME.unpack(self.wire.sent(IDS.status)[-1])
        return bool(is_open), Cause(cause)

    # A tuner by hand

    def order(self, order: Order, *values: float, sub: int = 1) -> Abort | None:
        """Stages the values and writes the check, as a tuner does that knows number and count."""
        for name, value in zip(STAGED[order], values, strict=True):
            refused = self.write(name, value, sub)
            if refused is not None:
                return refused
        opening = order is Order.OPEN
        number = int(self.read("controller_session_next" if opening else "controller_session", sub))
        count = 0 if opening else int(self.read("controller_session_count", sub))
        carried = [real(order, at, value) for at, value in enumerate(values)]
        return self.write(object_of(order), check_of(number, count, order, carried), sub)

    def open(self, samples: int = 10_000, sub: int = 1, watch_ms: int = 1000, silence_ms: int = 1000) -> int:
        """The session's number."""
        assert self.order(Order.OPEN, TUNER_NODE, samples, 60_000, silence_ms, watch_ms, sub=sub) is None
        return int(self.read("controller_session", sub))

    def renew(self, number: int, sub: int = 1) -> None:
        self.client.send(renewal_id(CONTROLLER), RENEWAL_FRAME.pack(number, sub))
        self.pump()

    def relay(self, sub: int = 1, amplitude: float = 4.0, low: float = 40.0, high: float = 60.0) -> None:
        assert self.order(Order.RELAY, amplitude, 0.0, 50.0, 10_000, low, high, 0.0, 1, sub=sub) is None

    def under_test(self) -> None:
        """An open session that has moved set-point, gains and, by its relay, the output."""
        self.run(3)
        self.open()
        assert self.order(Order.SETPOINT, 50.25) is None
        assert self.order(Order.TRY, 300.0, 10.0, 0.0, 0.0, 1.0, 0.0) is None
        self.relay()
        self.run(5)

    def is_home(self, setpoint: float = 50.0, mode: Mode = Mode.AUTOMATIC) -> bool:
        read = self.read
        return (read("controller_mode"), read("controller_setpoint")) == (mode, setpoint) and not (
            read("controller_session") or read("controller_on_trial") or read("controller_relay_state") == 1
        )


def real(order: Order, at: int, value: float) -> Value:
    """A value as an SDO carries it."""
    kind = lookup(STAGED[order][at]).type
    return kind.decode(kind.encode(value))
