"""What a controller has to say while its bus takes no frame is said when the bus is back."""

from __future__ import annotations

from contextlib import suppress

import pytest

from loopwright.protocol.bus import BusError
from loopwright.protocol.profile import NMT_FRAME, NMT_ID, STATUS_FRAME, Cause, Mode, NmtCommand, NmtState, channel_ids
from tests.unit.protocol.rig import CONTROLLER, Rig


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
