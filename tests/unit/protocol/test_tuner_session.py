"""The tuner's side of a session, against a controller in memory."""

from __future__ import annotations

import itertools

import pytest

from loopwright.controller.device import ControllerChannel, ControllerDevice
from loopwright.controller.pid import Parameters
from loopwright.protocol.bus import Frame
from loopwright.protocol.objects import BY_NAME, lookup
from loopwright.protocol.profile import CONTROLLER_NODE, Abort, Order, sdo_request_id, sdo_response_id
from loopwright.protocol.station import Station
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError
from loopwright.protocol.tuner_session import Lease, TunerSession
from tests.unit.protocol.memory_bus import MemoryBus, Wire

LEASE = Lease(1000, 60_000, 60_000, 60_000)
RELAY = (5.0, 0.0, 50.0, 1000, 0.0, 100.0, 0.0, 1)
REQUEST, ANSWER = sdo_request_id(CONTROLLER_NODE), sdo_response_id(CONTROLLER_NODE)


class Site:
    """One controller, and tuners each with a station of its own."""

    def __init__(self) -> None:
        self.wire = Wire()
        self.device = ControllerDevice(
            self.wire.open(), [ControllerChannel(Parameters(2.0, 10.0), 50.0)], clock=self.wire.clock,
            draw=itertools.count(0x1000).__next__,
        )  # fmt: skip
        self.device.start()
        self.lost_answers = 0
        self.written: list[str] = []

    def tuner(self, node: int = 0x7D) -> Tuner:
        site = self

        class Ours(MemoryBus):
            def send(self, can_id: int, data: bytes) -> None:
                if can_id == REQUEST and data[0] & 0xE0 == 0x20:
                    index = int.from_bytes(data[1:3], "little")
                    site.written.append(next(name for name in NAMES if lookup(name).index == index))
                super().send(can_id, data)

            def recv(self, timeout: float | None) -> Frame | None:
                while site.device.runtime.poll(0.0):
                    pass
                return super().recv(timeout)

            def take(self, frame: Frame) -> None:
                if frame[0] == ANSWER and site.lost_answers:
                    site.lost_answers -= 1
                else:
                    super().take(frame)

        def open_bus(url: str) -> Ours:
            bus = Ours(self.wire)
            self.wire.join(bus)
            return bus

        station = Station(node, 0.0, self.wire.clock, open_bus=open_bus)
        return Tuner("wire", CONTROLLER_NODE, None, station=station)


NAMES = [name for name in BY_NAME if name.startswith("controller_")]


@pytest.fixture
def site() -> Site:
    return Site()


def opened(site: Site, node: int = 0x7D) -> TunerSession:
    session = TunerSession(site.tuner(node))
    session.open(LEASE, lambda number: None)
    return session


def test_the_number_is_remembered_before_the_opening_is_sent(site: Site) -> None:
    seen: list[tuple[int, int]] = []
    session = TunerSession(site.tuner())
    session.open(LEASE, lambda number: seen.append((number, site.device.sessions[0].number)))
    assert seen == [(session.number, 0)] and session.is_open


def test_only_what_differs_is_staged_again(site: Site) -> None:
    session = opened(site)
    session.give(Order.RELAY, RELAY)
    site.written.clear()
    session.give(Order.RELAY, (6.0, *RELAY[1:]))
    assert site.written == ["controller_relay_amplitude", "controller_order_relay"]
    assert site.device.channels[0].relay is not None


@pytest.mark.parametrize("order", [Order.SETPOINT, Order.CLOSE], ids=str)
def test_an_order_whose_answer_is_lost_is_given_once(site: Site, order: Order) -> None:
    session = opened(site)
    values = (51.0,) if order is Order.SETPOINT else ()
    if values:
        site.device.dictionary.set("controller_session_setpoint", 51.0, 1)
        session.staged["controller_session_setpoint"] = 51.0
    site.lost_answers = 2
    session.give(order, values)
    assert (site.lost_answers, site.device.sessions[0].count) == (0, 2)


def test_an_opening_whose_answer_is_lost_is_one(site: Site) -> None:
    session = TunerSession(site.tuner())
    for name in ("tuner", "lease_samples", "lease_ms", "pv_silence_ms", "watch_ms"):
        site.device.dictionary.get(f"controller_session_{name}", 1)

    def lose_later(number: int) -> None:
        site.lost_answers = 1

    session.open(LEASE, lose_later)
    assert session.is_open and site.device.sessions[0].count == 1


def test_what_another_has_staged_meanwhile_is_staged_again(site: Site) -> None:
    session = opened(site)
    session.give(Order.TRY, (3.0, 9.0, 0.0, 0.0, 1.0, 0.0))
    site.device.dictionary.set("controller_session_kp", 999.0, 1)
    session.give(Order.ACCEPT, (3.0, 9.0, 0.0, 0.0, 1.0, 0.0))
    assert site.device.channels[0].accepted == Parameters(3.0, 9.0)


def test_an_order_that_was_carried_out_by_nobodys_knowledge_is_given_again_with_the_right_count(site: Site) -> None:
    session = opened(site)
    session.count = 0
    session.give(Order.SETPOINT, (51.0,))
    assert site.device.channels[0].setpoint == 51.0


def test_who_takes_a_session_up_can_close_it(site: Site) -> None:
    dead = opened(site)
    dead.give(Order.SETPOINT, (51.0,))
    heir = TunerSession(site.tuner())
    heir.take_up(dead.number)
    heir.close()
    assert not heir.is_open and site.device.channels[0].setpoint == 50.0


def test_two_tuners_exclude_each_other(site: Site) -> None:
    first = opened(site, 0x7D)
    with pytest.raises(TunerError) as refused:
        opened(site, 0x7C)
    assert (refused.value.kind, refused.value.code) == (FailureKind.ABORT, Abort.DEVICE_STATE)
    first.give(Order.SETPOINT, (51.0,))
    first.close()
    second = opened(site, 0x7C)
    with pytest.raises(TunerError) as refused:
        first.give(Order.SETPOINT, (52.0,))
    assert refused.value.code == Abort.INVALID_VALUE
    with pytest.raises(TunerError):
        first.renew()
    assert second.is_open and site.device.channels[0].setpoint == 50.0


def test_a_refusal_for_good_is_told(site: Site) -> None:
    session = opened(site)
    with pytest.raises(TunerError) as refused:
        session.give(Order.RELAY, (0.0, *RELAY[1:]))
    assert refused.value.code == Abort.INVALID_VALUE
    session.give(Order.SETPOINT, (51.0,))
    assert site.device.channels[0].setpoint == 51.0, "and the session goes on"
