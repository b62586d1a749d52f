"""What a controller has to say while its bus takes no frame is said when the bus is back."""

from __future__ import annotations

from contextlib import suppress

import pytest

from loopwright.protocol.bus import BusError
from loopwright.protocol.profile import (
    FOREVER,
    NMT_FRAME,
    NMT_ID,
    STATUS_FRAME,
    Cause,
    Emcy,
    Mode,
    NmtCommand,
    NmtState,
    channel_ids,
)
from tests.unit.protocol.rig import CONTROLLER, KP, Rig


@pytest.mark.parametrize("sub", [1, 2])
def test_the_end_of_a_test_that_the_bus_did_not_take_is_told_when_it_is_back(
    sub: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(channels=2)
    rig.run(1)
    for channel in (1, 2):
        rig.open(sub=channel)

    def refuse(can_id: int, data: bytes) -> None:
        raise BusError("the interface is down")

    with monkeypatch.context() as away:
        away.setattr(rig.controller, "_send", refuse)
        for _ in range(200):
            rig.wire.clock.now += 0.02
            with suppress(BusError):
                rig.controller.runtime.tick()
    assert not any(session.is_open for session in rig.controller.sessions)
    rig.wait(0.1)
    mode, _, _, is_open, cause = STATUS_FRAME.unpack(rig.wire.sent(channel_ids(sub).status)[-1])
    assert (mode, bool(is_open), Cause(cause)) == (Mode.AUTOMATIC, False, Cause.HEARTBEAT)


def test_a_stop_ends_every_test_where_the_bus_takes_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(channels=2)
    rig.run(1)
    for channel in (1, 2):
        rig.open(sub=channel)

    def refuse(can_id: int, data: bytes) -> None:
        raise BusError("the transmit queue is full")

    with monkeypatch.context() as full:
        full.setattr(rig.controller, "_send", refuse)
        rig.client.send(NMT_ID, NMT_FRAME.pack(NmtCommand.STOP, CONTROLLER))
        with suppress(BusError):
            rig.pump()
    assert [session.cause for session in rig.controller.sessions] == [Cause.NMT, Cause.NMT]
    assert rig.controller.runtime.state is NmtState.STOPPED


def refused(can_id: int, data: bytes) -> None:
    raise BusError("the interface is down")


@pytest.mark.parametrize("period_ms", [10, 20, 100])
def test_a_controller_goes_home_without_a_bus_however_often_it_beats(
    period_ms: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig()
    assert rig.write("heartbeat_producer", period_ms) is None
    rig.run(1)
    rig.open()
    with monkeypatch.context() as away:
        away.setattr(vars(rig.controller.runtime)["_bus"], "send", refused)
        for _ in range(100):
            rig.wire.clock.now += 0.05
            with suppress(BusError):
                rig.controller.runtime.tick()
        assert not rig.controller.sessions[0].is_open


def test_a_node_that_is_lost_while_the_bus_is_away_does_not_keep_the_device_from_its_work(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig()
    ticked: list[float] = []
    rig.controller.runtime.on_tick = ticked.append
    monkeypatch.setattr(rig.controller.runtime, "raise_error", refused)
    rig.write("heartbeat_consumer", 0x00100064, 1)
    rig.client.send(0x710, b"\x05")
    rig.pump()
    rig.wire.clock.now += 1.0
    ticked.clear()
    with suppress(BusError):
        rig.controller.runtime.tick()
    assert ticked


def test_an_io_without_a_bus_takes_its_safe_output_after_one_answer_time_out(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(pace=1.0)
    assert rig.write("plant_on_missing_answer", 2) is None
    assert rig.write("plant_safe_output", 12.5) is None
    assert rig.write("plant_samples_to_run", FOREVER) is None
    rig.wait(1.0)
    assert rig.plant.mv != [12.5]
    with monkeypatch.context() as away:
        away.setattr(rig.plant, "_send", refused)
        away.setattr(vars(rig.plant.runtime)["_bus"], "send", refused)
        began = rig.wire.clock.now
        while rig.plant.mv != [12.5] and rig.wire.clock.now < began + 5.0:
            rig.wire.clock.now += 0.02
            with suppress(BusError):
                rig.plant.runtime.poll(0.0)
            with suppress(BusError):
                rig.plant.runtime.tick()
    assert rig.wire.clock.now - began < 0.1 + 0.1 + 0.05


def test_a_reset_ends_operational_also_where_the_bus_takes_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.run(1)
    rig.open()
    rig.write("controller_staged_kp", 300.0)
    with monkeypatch.context() as full:
        full.setattr(rig.controller, "_send", refused)
        full.setattr(vars(rig.controller.runtime)["_bus"], "send", refused)
        rig.client.send(NMT_ID, NMT_FRAME.pack(NmtCommand.RESET_NODE, CONTROLLER))
        with suppress(BusError):
            rig.pump()
    assert rig.controller.runtime.state is NmtState.OPERATIONAL
    assert rig.read("controller_staged_kp") == KP
    before = len(rig.wire.sent(channel_ids(1).mv))
    rig.run(1)
    assert len(rig.wire.sent(channel_ids(1).mv)) == before + 1


def test_the_errors_that_the_bus_did_not_take_are_sent_in_order_when_it_is_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig()
    rig.run(1)
    rig.open()
    with monkeypatch.context() as away:
        away.setattr(rig.controller, "_send", refused)
        away.setattr(vars(rig.controller.runtime)["_bus"], "send", refused)
        for _ in range(200):
            rig.wire.clock.now += 0.02
            with suppress(BusError):
                rig.controller.runtime.tick()
    assert rig.emergencies(CONTROLLER) == []
    rig.wait(0.1)
    assert rig.emergencies(CONTROLLER) == [Emcy.TUNER_LOST, Emcy.NO_PV]
    rig.wait(1.0)
    assert rig.emergencies(CONTROLLER) == [Emcy.TUNER_LOST, Emcy.NO_PV], "once"


def test_errors_are_not_sent_by_a_node_that_has_been_reset_since(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    with monkeypatch.context() as away:
        away.setattr(vars(rig.controller.runtime)["_bus"], "send", refused)
        with suppress(BusError):
            rig.controller.runtime.raise_error(Emcy.TUNER_LOST, b"\1")
    rig.nmt(NmtCommand.RESET_NODE, CONTROLLER)
    rig.wait(0.1)
    assert Emcy.TUNER_LOST not in rig.emergencies(CONTROLLER)
