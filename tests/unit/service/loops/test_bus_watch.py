"""What readiness hears of a bus: that it opens, and what its CAN controller says of itself."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

import pytest

from loopwright.protocol.bus import BusError, Frame
from loopwright.protocol.bus_state import BusState
from loopwright.service.loops.bus_watch import BusWatch


class Interface:
    """An interface that changes its state as it is listened to."""

    def __init__(self) -> None:
        self.coming: deque[BusState] = deque()
        self.is_there = True
        self.opened = 0

    def open(self, url: str) -> Opening:
        if not self.is_there:
            raise BusError(f"{url} is not up")
        self.opened += 1
        return Opening(self)


class Opening:
    def __init__(self, interface: Interface) -> None:
        self._interface = interface
        self.state = BusState.ACTIVE

    def send(self, can_id: int, data: bytes) -> None:
        raise AssertionError("readiness sends nothing")

    def recv(self, timeout: float | None) -> Frame | None:
        if self._interface.coming:
            self.state = self._interface.coming.popleft()
        elif self.state is BusState.BUS_OFF:
            raise BusError("bus-off: check termination")
        return None

    def set_filters(self, ids: Collection[int]) -> None:
        assert not ids

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        pass


def test_a_bus_that_works_is_well_and_opened_once_for_good() -> None:
    can0 = Interface()
    watch = BusWatch("socketcan:can0", can0.open)
    watch.check()
    watch.check()
    assert can0.opened == 3, "each time to see whether it opens, and once to listen"


@pytest.mark.parametrize(
    ("state", "words"), [(BusState.PASSIVE, "error-passive.*termination"), (BusState.BUS_OFF, "bus-off")]
)
def test_a_controller_in_trouble_is_named_until_it_is_well(state: BusState, words: str) -> None:
    can0 = Interface()
    watch = BusWatch("socketcan:can0", can0.open)
    watch.check()
    can0.coming += [BusState.WARNING, state]
    for _ in range(3):
        with pytest.raises(BusError, match=words):
            watch.check()
    can0.coming += [BusState.WARNING]
    watch.check()


def test_an_interface_that_goes_down_is_listened_to_again_when_it_is_up() -> None:
    can0 = Interface()
    watch = BusWatch("socketcan:can0", can0.open)
    watch.check()
    can0.is_there = False
    with pytest.raises(BusError, match="not up"):
        watch.check()
    can0.is_there = True
    can0.coming.append(BusState.PASSIVE)
    with pytest.raises(BusError, match="error-passive"):
        watch.check()


def test_a_hub_has_no_error_frames_and_is_not_kept_open() -> None:
    hub = Interface()
    watch = BusWatch("socketcand:127.0.0.1:29536", hub.open)
    watch.check()
    watch.check()
    assert hub.opened == 2
