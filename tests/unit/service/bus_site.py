"""Plant and controller on a bus in memory, with tuners of as many gateways as a test wants. Time is the wire's.

Everything happens in the calls on the bus: while a tuner waits there the devices work, and there a test may strike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

from loopwright.controller.channel import Channel, Mode, Settings
from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.controller.pid import Parameters
from loopwright.plantsim.catalogue import find
from loopwright.plantsim.device import PlantChannel, PlantDevice
from loopwright.protocol.bus import Frame
from loopwright.protocol.objects import BY_NAME, Device, lookup
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    FOREVER,
    HEARTBEAT_FRAME,
    NMT_FRAME,
    NMT_ID,
    PLANT_NODE,
    TUNER_NODE,
    NmtCommand,
    NmtState,
    heartbeat_id,
    sdo_request_id,
)
from loopwright.protocol.station import Station
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import SetRelay
from tests.unit.protocol.memory_bus import MemoryBus, Wire

NAMES = {entry.index: name for name, entry in BY_NAME.items() if entry.device is not Device.PLANT}
FOUND, NEW = Parameters(200.0, 12.0), Gains(150.0, 9.0)
RELAY = SetRelay(amplitude=5.0, hysteresis=0.0, working_output=50.0)
STEP_S = 0.005
CALL_S = 1e-4
"""A call on the bus takes some time: a plant at full speed would fill it for ever."""


class Killed(BaseException):
    """The process of this gateway is gone: it can do nothing any more."""


class Gateway(Station):
    """One process with its node-ID."""

    def __init__(self, site: Site, node: int = TUNER_NODE, listen_s: float = 0.0) -> None:
        super().__init__(node, listen_s, site.wire.clock, site.sleep, self.open)
        self.site = site
        self.dead = False
        self.calls = 0
        """On the bus, so far."""
        self.before: Callable[[int], object] = lambda call: None
        """Told of each call before it is made: its number."""
        self.sent: list[Frame] = []

    def open(self, url: str) -> TunerBus:
        bus = TunerBus(self)
        self.site.wire.join(bus)
        return bus

    def call(self) -> None:
        self.calls += 1
        self.site.wire.clock.now += CALL_S
        self.before(self.calls)
        if self.dead:
            raise Killed
        if self.site.lost is not None:
            raise self.site.lost

    def kill_at(self, call: int) -> None:
        """`kill -9` before that many calls more."""
        last = self.calls + call

        def strike(number: int) -> None:
            self.dead = self.dead or number >= last

        self.before = strike


class TunerBus(MemoryBus):
    """What a tuner waits for, the devices do meanwhile; an SDO takes them `slow_s`."""

    def __init__(self, gateway: Gateway) -> None:
        super().__init__(gateway.site.wire)
        self.gateway, self.site = gateway, gateway.site

    def send(self, can_id: int, data: bytes) -> None:
        self.gateway.call()
        self.gateway.sent.append((can_id, bytes(data)))
        if can_id == sdo_request_id(CONTROLLER_NODE):
            self.site.wire.clock.now += self.site.slow_s
            if data[0] & 0xE0 == 0x20:
                self.site.written.append((NAMES[data[1] | data[2] << 8], self.site.wire.clock.now))
        super().send(can_id, data)

    def recv(self, timeout: float | None) -> Frame | None:
        self.gateway.call()
        clock = self.site.wire.clock
        give_up = clock.now + (timeout or 0.0)
        while True:
            self.site.pump()
            if self.queue or clock.now >= give_up:
                return super().recv(0.0)
            clock.now = min(clock.now + STEP_S, give_up)


class Site:
    def __init__(self, pace: float = 1.0, channels: int = 1, Ts: float = 0.1, mode: Mode = Mode.AUTOMATIC) -> None:
        self.wire = Wire()
        self.slow_s = 0.0
        self.lost: Exception | None = None
        """What every tuner's bus raises, while it does."""
        self.written: list[tuple[str, float]] = []
        entry, clock = find("fopdt"), self.wire.clock
        plants = [PlantChannel(entry.build)] * channels
        self.plant = PlantDevice(self.wire.open(), plants, Ts, pace, 0, clock=clock)
        laws = [ControllerChannel(FOUND, 50.0, Settings(pv_low=40.0, pv_high=60.0), mode)] * channels
        draw = itertools.count(0x1000).__next__
        self.controller = ControllerDevice(self.wire.open(), laws, Ts, clock=clock, draw=draw)
        self.controller.start()
        self.plant.start()
        self.gateway = Gateway(self)
        self.loop = self.tuner(self.gateway)
        self._others = self.wire.open()
        self._others.set_filters(())

    def tuner(self, gateway: Gateway, pv_limits: tuple[float, float] | None = None, channel: int = 1) -> BusLoop:
        return BusLoop("wire", CONTROLLER_NODE, PLANT_NODE, channel, station=gateway, pv_limits=pv_limits)

    def another(self, node: int = TUNER_NODE) -> tuple[Gateway, BusLoop]:
        """Another gateway, or the same one started again, and its loop."""
        gateway = Gateway(self, node)
        return gateway, self.tuner(gateway)

    @property
    def channel(self) -> Channel:
        return self.controller.channels[0]

    @property
    def mv(self) -> float:
        """At the plant."""
        return self.plant.mv[0]

    def sleep(self, seconds: float) -> None:
        self.pass_time(seconds)

    def pump(self) -> None:
        """A plant that runs freely never has nothing to do."""
        for _ in range(100):
            if not self.plant.runtime.poll(0.0) | self.controller.runtime.poll(0.0):
                break
        for device in (self.plant, self.controller):
            device.runtime.poll(1e-9)  # an idle device looks at the clock

    def pass_time(self, seconds: float, beating: int | None = None) -> None:
        """beating: a node that is heard meanwhile."""
        for tick in range(math.ceil(seconds / 0.02)):
            self.wire.clock.now += 0.02
            if beating is not None and tick % 5 == 0:
                self._others.send(heartbeat_id(beating), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
            self.pump()

    def let_run(self) -> None:
        self.plant.dictionary.write(lookup("plant_samples_to_run").index, 0, FOREVER.to_bytes(4, "little"))
        self.pass_time(5.0 * self.plant.sample_time_s)

    def hand(self, name: str, value: float) -> None:
        """Somebody else writes by SDO."""
        entry = lookup(name)
        data = entry.type.encode(value)
        command = 0x23 | (4 - len(data)) << 2
        request = bytes((command,)) + entry.index.to_bytes(2, "little") + b"\x01" + data.ljust(4, b"\0")
        self._others.send(sdo_request_id(CONTROLLER_NODE), request)
        self.pump()

    def nmt(self, command: NmtCommand, node: int = CONTROLLER_NODE) -> None:
        self._others.send(NMT_ID, NMT_FRAME.pack(command, node))
        self.pump()

    def replay(self, frame: Frame) -> None:
        self._others.send(*frame)
        self.pump()

    def transmitter(self, works: bool) -> None:
        self.plant.plants[0].noise_std = 0.0 if works else math.nan

    def names(self) -> list[str]:
        """Of the objects written since this was asked last."""
        names, self.written = [name for name, _ in self.written], []
        return names

    def begun(self) -> tuple[LoopState, int]:
        """Home and the number of a session that has just been opened, on a plant that runs, or is run in blocks."""
        if self.plant.pace:
            self.let_run()
        numbers: list[int] = []
        home = self.loop.begin(note_session=numbers.append)
        return home, numbers[-1]

    def is_home(self, setpoint: float = 50.0, mode: Mode = Mode.AUTOMATIC) -> bool:
        c, session = self.channel, self.controller.sessions[0]
        return (c.mode, c.setpoint, c.in_effect, c.on_trial, c.relay, session.is_open) == (
            mode, setpoint, c.accepted, False, None, False
        )  # fmt: skip
