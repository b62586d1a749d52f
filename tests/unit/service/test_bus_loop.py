"""The live loop on devices and a bus in memory: what it writes to the controller, and when. Time is the wire's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest

from controller.device import ControllerChannel, ControllerDevice
from controller.pid import Parameters
from plantsim.catalogue import find
from plantsim.device import PlantChannel, PlantDevice
from protocol import tuner as tuner_module
from protocol.bus import Frame
from protocol.objects import BY_NAME, Device
from protocol.profile import CONTROLLER_NODE, PLANT_NODE, sdo_request_id
from service import bus_loop as bus_loop_module
from service.bus_loop import LEASE_WALL_S, BusLoop
from tests.unit.protocol.memory_bus import MemoryBus, Wire
from tuning.gains import Gains
from tuning.plan import Command, Mode, SetGains, SetMode, SetRelay, SetSetpoint
from tuning.reasons import Failed, Reason

NAMES = {entry.index: name for name, entry in BY_NAME.items() if entry.device is not Device.PLANT}
RELAY = SetRelay(amplitude=5.0, hysteresis=0.0, working_output=50.0)
RENEWAL = "controller_lease_renewal"


class OurBus(MemoryBus):
    """What we wait for, the devices do meanwhile; an SDO takes them `slow_s`."""

    def __init__(self, site: Site) -> None:
        super().__init__(site.wire)
        self.site = site

    def send(self, can_id: int, data: bytes) -> None:
        if can_id == sdo_request_id(CONTROLLER_NODE):
            self.site.wire.clock.now += self.site.slow_s
            if data[0] & 0xE0 == 0x20:
                self.site.written.append((NAMES[data[1] | data[2] << 8], self.site.wire.clock.now))
        super().send(can_id, data)

    def recv(self, timeout: float | None) -> Frame | None:
        self.site.pump()
        return super().recv(timeout)


class Site:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, pace: float) -> None:
        self.wire = Wire()
        self.slow_s = 0.0
        self.written: list[tuple[str, float]] = []
        entry, clock = find("fopdt"), self.wire.clock
        self.plant = PlantDevice(self.wire.open(), [PlantChannel(entry.build)], pace=pace, run=0, clock=clock)
        channel = ControllerChannel(Parameters(200.0, 12.0), 50.0)
        self.controller = ControllerDevice(self.wire.open(), [channel], clock=clock)
        self.controller.start()
        self.plant.start()
        monkeypatch.setattr(tuner_module, "open_bus", self.open)
        monkeypatch.setattr(tuner_module, "_beats", {})
        time = SimpleNamespace(monotonic=clock, sleep=self.sleep)
        monkeypatch.setattr(tuner_module, "time", time)
        monkeypatch.setattr(bus_loop_module, "time", time)
        self.loop = BusLoop("wire", CONTROLLER_NODE, PLANT_NODE)

    def open(self, url: str) -> OurBus:
        bus = OurBus(self)
        self.wire.join(bus)
        return bus

    def sleep(self, seconds: float) -> None:
        self.wire.clock.now += seconds

    def pump(self) -> None:
        """A plant that runs freely never has nothing to do."""
        for _ in range(100):
            if not self.plant.runtime.poll(0.0) | self.controller.runtime.poll(0.0):
                break

    def names(self) -> list[str]:
        names, self.written = [name for name, _ in self.written], []
        return names


@pytest.fixture
def in_blocks(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    site = Site(monkeypatch, pace=0.0)
    yield site
    site.loop.close()


@pytest.fixture
def in_real_time(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    site = Site(monkeypatch, pace=1.0)
    yield site
    site.loop.close()


def test_the_lease_is_paid_before_commands_are_sent(in_blocks: Site) -> None:
    loop = in_blocks.loop
    loop.begin()
    in_blocks.names()
    for _ in range(loop._lease // 3):
        loop.step(())
    assert in_blocks.names() == [], "until a third is used up nothing is paid"
    loop.step((SetSetpoint(50.1),))
    assert in_blocks.names() == [RENEWAL, "controller_setpoint"]


@pytest.mark.parametrize("commands", [(RELAY, SetMode(Mode.EXPERIMENT)), (SetGains(Gains(150.0, 9.0)),)], ids=str)
def test_the_lease_is_paid_between_writes_that_take_long(in_real_time: Site, commands: Sequence[Command]) -> None:
    """As many loops that ask one node make them."""
    loop = in_real_time.loop
    loop.begin()
    paid = in_real_time.wire.clock.now
    in_real_time.slow_s = 0.45
    loop.step(commands)
    in_real_time.slow_s = 0.0
    written = in_real_time.written
    times = [paid, *(at for name, at in written if name == RENEWAL), written[-1][1]]
    assert written[-1][0] != RENEWAL and written[-1][1] - paid > LEASE_WALL_S
    assert len(times) > 2 and max(b - a for a, b in pairwise(times)) < 0.8 * LEASE_WALL_S
    last = [loop.step(()) for _ in range(100)][-1]
    assert (last.mode, in_real_time.controller.channels[0].on_trial) == (
        (Mode.EXPERIMENT, False) if RELAY in commands else (Mode.AUTOMATIC, True)
    )


def test_what_a_relay_has_already_is_not_written_again(in_blocks: Site) -> None:
    loop = in_blocks.loop
    loop.begin()
    loop.step((RELAY, SetMode(Mode.EXPERIMENT)))
    first = [name for name in in_blocks.names() if name.startswith("controller_relay_")]
    assert len(first) == len(set(first)) >= 8
    for _ in range(9):
        loop.step(())
    loop.step((replace(RELAY, amplitude=6.0),))
    assert in_blocks.names() == [
        "controller_relay_amplitude", "controller_experiment", "controller_mode_command",
    ]  # fmt: skip


def test_a_session_that_has_ended_is_not_paid_for(in_blocks: Site) -> None:
    loop = in_blocks.loop
    loop.begin()
    for _ in range(loop._lease // 3):
        loop.step(())
    in_blocks.controller.channels[0].renew_lease(1)
    in_blocks.controller.channels[0].step(50.0)
    with pytest.raises(Failed) as caught:
        loop.step(())
    assert caught.value.reason is Reason.DEVICE_WENT_BACK
    assert in_blocks.controller.channels[0].lease == 0
