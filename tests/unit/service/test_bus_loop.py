"""The live loop on devices and a bus in memory: what it writes to the controller, and when. Time is the wire's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest

from controller.channel import Channel
from controller.device import ControllerChannel, ControllerDevice
from controller.pid import Parameters
from plantsim.catalogue import find
from plantsim.device import PlantChannel, PlantDevice
from protocol import tuner as tuner_module
from protocol.bus import BusError, Frame
from protocol.objects import BY_NAME, Device, lookup
from protocol.profile import (
    CONTROLLER_NODE,
    EMCY_FRAME,
    FOREVER,
    HEARTBEAT_FRAME,
    PLANT_NODE,
    TUNER_NODE,
    Cause,
    Emcy,
    NmtState,
    emcy_id,
    heartbeat_id,
    sdo_request_id,
)
from service import bus_loop as bus_loop_module
from service.bus_loop import LEASE_WALL_S, BusLoop
from tests.unit.protocol.memory_bus import MemoryBus, Wire
from tuning.gains import Gains
from tuning.plan import Command, Mode, SetGains, SetMode, SetRelay, SetSetpoint
from tuning.reasons import Failed, Reason, Refused

NAMES = {entry.index: name for name, entry in BY_NAME.items() if entry.device is not Device.PLANT}
RELAY = SetRelay(amplitude=5.0, hysteresis=0.0, working_output=50.0)
RENEWAL = "controller_lease_renewal"


class OurBus(MemoryBus):
    """What we wait for, the devices do meanwhile; an SDO takes them `slow_s`."""

    def __init__(self, site: Site) -> None:
        super().__init__(site.wire)
        self.site = site

    def send(self, can_id: int, data: bytes) -> None:
        if self.site.lost is not None:
            raise self.site.lost
        if can_id == sdo_request_id(CONTROLLER_NODE):
            self.site.wire.clock.now += self.site.slow_s
            if data[0] & 0xE0 == 0x20:
                self.site.written.append((NAMES[data[1] | data[2] << 8], self.site.wire.clock.now))
        super().send(can_id, data)

    def recv(self, timeout: float | None) -> Frame | None:
        self.site.pump()
        if self.site.lost is not None:
            raise self.site.lost
        return super().recv(timeout)


class Site:
    def __init__(self, monkeypatch: pytest.MonkeyPatch, pace: float, channels: int = 1) -> None:
        self.wire = Wire()
        self.slow_s = 0.0
        self.lost: Exception | None = None
        """What our bus raises, while it does."""
        self.written: list[tuple[str, float]] = []
        entry, clock = find("fopdt"), self.wire.clock
        plants = [PlantChannel(entry.build)] * channels
        self.plant = PlantDevice(self.wire.open(), plants, pace=pace, run=0, clock=clock)
        laws = [ControllerChannel(Parameters(200.0, 12.0), 50.0)] * channels
        self.controller = ControllerDevice(self.wire.open(), laws, clock=clock)
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


FOUND, NEW = Parameters(200.0, 12.0), Gains(150.0, 9.0)


def time_passes(site: Site, seconds: float, beating: bool = False) -> None:
    """beating: another loop of this process goes on sending our heartbeat."""
    beat = site.wire.open()
    for tick in range(round(seconds / 0.02)):
        site.wire.clock.now += 0.02
        if beating and tick % 5 == 0:
            beat.send(heartbeat_id(TUNER_NODE), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
        site.pump()
        site.controller.runtime.poll(1e-9)  # an idle device looks at the clock


def let_run(site: Site, samples: int = FOREVER) -> None:
    site.plant.dictionary.write(lookup("plant_samples_to_run").index, 0, samples.to_bytes(4, "little"))
    site.pump()


def cannot_keep(sets: Sequence[Parameters]) -> None:
    raise OSError(28, "No space left on device")


def test_an_acceptance_leaves_nothing_behind(in_real_time: Site) -> None:
    let_run(in_real_time)
    channel = in_real_time.controller.channels[0]
    channel.command_mode(Mode.MANUAL)
    channel.manual_output = 43.0
    assert in_real_time.loop.accept(NEW).gains == NEW
    assert (channel.accepted.Kp, channel.on_trial, channel.lease) == (150.0, False, 0)
    beats = len(in_real_time.wire.sent(heartbeat_id(TUNER_NODE)))
    time_passes(in_real_time, 10.0)
    assert (channel.accepted.Kp, channel.in_effect.Kp, channel.mode, channel.mv) == (150.0, 150.0, Mode.MANUAL, 43.0)
    assert beats and len(in_real_time.wire.sent(heartbeat_id(TUNER_NODE))) == beats


@pytest.mark.parametrize("again", [False, True], ids=["never before", "after a job"])
def test_gains_that_the_controller_cannot_keep_do_not_stay(in_real_time: Site, again: bool) -> None:
    loop, channel = in_real_time.loop, in_real_time.controller.channels[0]
    if again:
        loop.restore(loop.begin())
        time_passes(in_real_time, 3.0)
    in_real_time.controller._keep = cannot_keep
    with pytest.raises(Refused, match="could not store it"):
        loop.accept(NEW)
    assert (channel.in_effect, channel.accepted, channel.on_trial, channel.lease) == (FOUND, FOUND, False, 0)
    channel.setpoint = 50.5
    time_passes(in_real_time, 10.0)
    assert channel.setpoint == 50.5, "there is no session left that could bring another one back"


def test_an_acceptance_tries_to_end_the_trial_until_the_bus_is_back(in_real_time: Site) -> None:
    loop, channel, pump = in_real_time.loop, in_real_time.controller.channels[0], in_real_time.pump
    lost_at: list[float] = []

    def broken(sets: Sequence[Parameters]) -> None:
        lost_at.append(in_real_time.wire.clock.now)
        in_real_time.lost = BusError("it is down")
        raise OSError(28, "No space left on device")

    def until_it_is_back() -> None:
        if lost_at and in_real_time.wire.clock.now > lost_at[0] + 0.8:
            in_real_time.lost = None
        pump()

    in_real_time.controller._keep, in_real_time.pump = broken, until_it_is_back  # type: ignore[method-assign]
    with pytest.raises(Failed) as caught:
        loop.accept(NEW)
    assert caught.value.reason is Reason.BUS_LOST
    assert (channel.in_effect, channel.on_trial, channel.lease) == (FOUND, False, 0)


def test_an_acceptance_whose_answer_was_lost_is_one(in_real_time: Site) -> None:
    channel, accept = in_real_time.controller.channels[0], Channel.accept
    times = 0

    def answer_lost(sets: Sequence[Parameters]) -> None:
        nonlocal times
        times += 1
        if times == 1:
            accept(channel)
            in_real_time.wire.clock.now += 0.01
            raise OSError(5, "Input/output error")

    in_real_time.controller._keep = answer_lost
    assert in_real_time.loop.accept(NEW).gains == NEW
    assert not channel.on_trial and channel.lease == 0


@pytest.mark.parametrize("beating", [False, True], ids=["silent", "another loop beats"])
def test_a_tuner_that_dies_while_it_accepts_leaves_no_gains(in_real_time: Site, beating: bool) -> None:
    let_run(in_real_time)

    class Dead(BaseException):
        pass

    def die(sets: Sequence[Parameters]) -> None:
        raise Dead

    channel = in_real_time.controller.channels[0]
    in_real_time.controller._keep = die
    with pytest.raises(Dead):
        in_real_time.loop.accept(NEW)
    assert channel.on_trial and channel.lease > 0
    time_passes(in_real_time, LEASE_WALL_S + 1.0, beating)
    assert (channel.in_effect, channel.on_trial, channel.lease) == (FOUND, False, 0)
    assert channel.cause is (Cause.LEASE if beating else Cause.HEARTBEAT)


def test_an_acceptance_keeps_its_hands_off_a_loop_that_another_has(in_real_time: Site) -> None:
    channel = in_real_time.controller.channels[0]
    channel.renew_lease(10**6)
    channel.stage(Parameters(80.0, 5.0))
    channel.try_staged()
    with pytest.raises(Refused) as caught:
        in_real_time.loop.accept(NEW)
    assert caught.value.reason is Reason.WRONG_MODE
    assert channel.on_trial and channel.in_effect.Kp == 80.0 and channel.lease > 0


def test_an_acceptance_does_not_end_an_experiment(in_real_time: Site) -> None:
    let_run(in_real_time)
    channel = in_real_time.controller.channels[0]
    time_passes(in_real_time, 0.5)
    channel.start_relay(5.0, 0.0, 50.0, 0.0, 10**6, 0.0, 100.0)
    with pytest.raises(Refused, match="experiment is running"):
        in_real_time.loop.accept(NEW)
    assert channel.mode == Mode.EXPERIMENT


def test_gains_are_accepted_while_the_plant_stands_still(in_blocks: Site) -> None:
    assert in_blocks.loop.accept(NEW).gains == NEW
    assert in_blocks.controller.channels[0].lease == 0


def test_a_pv_limit_has_its_name_while_another_channel_stands_at_one(monkeypatch: pytest.MonkeyPatch) -> None:
    site = Site(monkeypatch, pace=1.0, channels=2)
    loop = BusLoop("wire", CONTROLLER_NODE, PLANT_NODE, 2)
    one, two = site.controller.channels
    loop.begin()
    loop.step((RELAY, SetMode(Mode.EXPERIMENT)))
    for pv_low in (0.0, 60.0):
        one.start_relay(5.0, 0.0, 50.0, 0.0, 1000, pv_low, 100.0)
        for _ in range(20):
            loop.step(())
    assert Emcy.PV_LIMIT in [EMCY_FRAME.unpack(data)[0] for data in site.wire.sent(emcy_id(CONTROLLER_NODE))]
    assert two.mode == Mode.EXPERIMENT
    two.start_relay(5.0, 0.0, 50.0, 0.0, 1000, 60.0, 100.0)
    with pytest.raises(Failed) as caught:
        for _ in range(20):
            if loop.step(()).mode != Mode.EXPERIMENT:
                pytest.fail("it would be taken for somebody's hand")
    assert caught.value.reason is Reason.PV_LIMIT
    loop.close()


def test_an_interface_that_disappears_is_a_lost_bus(in_real_time: Site) -> None:
    """The kernel says so at whatever call comes next; not each is one that the bus layer has a word for."""
    state = in_real_time.loop.begin()
    in_real_time.lost = OSError(19, "No such device")
    with pytest.raises(Failed, match=r"No such device.*interface") as caught:
        in_real_time.loop.step(())
    assert caught.value.reason is Reason.BUS_LOST
    in_real_time.lost = None
    assert in_real_time.loop.restore(state).mode is state.mode


@pytest.mark.parametrize("lease", [0, 50], ids=["forgotten", "of a tuner that has died"])
def test_gains_that_somebody_tries_are_not_the_ones_to_come_back_to(in_real_time: Site, lease: int) -> None:
    """What a job writes down as found, before it begins, and what it then finds are the same."""
    let_run(in_real_time)
    loop, channel = in_real_time.loop, in_real_time.controller.channels[0]
    channel.renew_lease(lease)
    channel.stage(Parameters(999.0, 3.0))
    channel.try_staged()
    found = loop.read()
    assert found.on_trial and found.gains == Gains(200.0, 12.0)
    time_passes(in_real_time, 0.1 * lease + 1.0)
    assert loop.begin().gains == found.gains
    assert not loop.restore(found).on_trial


def test_an_acceptance_ends_a_forgotten_trial(in_real_time: Site) -> None:
    channel = in_real_time.controller.channels[0]
    channel.stage(Parameters(999.0, 3.0))
    channel.try_staged()
    assert in_real_time.loop.read().gains == Gains(200.0, 12.0), "what the decision compares with"
    assert in_real_time.loop.accept(NEW).gains == NEW and not channel.on_trial


@pytest.mark.parametrize("way", ["job", "acceptance"])
def test_a_loop_let_go_is_no_emergency(in_real_time: Site, way: str) -> None:
    loop = in_real_time.loop
    if way == "job":
        state = loop.begin()
        loop.step(())
        loop.restore(state)
    else:
        loop.accept(NEW)
    let_run(in_real_time)
    time_passes(in_real_time, 3.0)
    assert in_real_time.wire.sent(emcy_id(CONTROLLER_NODE)) == []
