"""The hub with faults: frames lost, late or twice, as a test asks for while it runs.

Two look on. The witness in the hub counts the samples of channel 1 as the bus carried them. The onlooker is a member
whose SDO dialogue no fault touches: through it a loop is read while its bus is down for everybody else.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from loopwright.protocol.hub import Hub, _Member
from loopwright.protocol.objects import lookup
from loopwright.protocol.profile import (
    CONTROLLER_NODE,
    MV_FRAME,
    PLANT_NODE,
    PV_FRAME,
    Order,
    channel_ids,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.protocol.session import object_of

Fault = Callable[[int], Sequence[float]]
"""Of a frame's COB-ID: the delays in s after which copies are passed on; none: the frame is lost."""


def _address_of(order: Order) -> bytes:
    return lookup(object_of(order)).index.to_bytes(2, "little") + b"\x01"


_PV, _MV = channel_ids(1)[:2]
_ANSWERS = {sdo_response_id(PLANT_NODE), sdo_response_id(CONTROLLER_NODE)}
_OPENING = _address_of(Order.OPEN)
_COMMANDS = {_address_of(order) for order in Order if order not in (Order.OPEN, Order.CLOSE)}
_NO_NUMBER = b"0000C07F"


def well(can_id: int) -> Sequence[float]:
    return (0.0,)


class FaultyHub(Hub):
    def __init__(self) -> None:
        super().__init__(port=0)
        self.fault: Fault = well
        self.sample_number = 0
        """Of the latest PV, whoever sent it."""
        self.answered = 0
        """Of the latest MV that was passed on as the answer to the latest PV: that sample was there to be stored."""
        self.first_of_session = 0
        """The number of the first sample after the session was opened."""
        self.samples: dict[int, list[tuple[float, float]]] = {}
        """PV and MV of every sample of the session whose frames were passed on, by its number; more than one pair where
        somebody else has sent a PV of that number as well."""
        self.commanded = 0
        """The number of the sample in which a tuner has last given an order within its session."""
        self.pv_broken = False
        """The transmitter of channel 1 gives no number."""
        self.shows: Callable[[float], float] | None = None
        """What the transmitter of channel 1 makes of PV; None: it shows PV."""
        self.pv = math.nan
        """The latest one, as it was shown."""
        self._taken = self._held = False
        self._onlooker: _Member | None = None
        self._late: list[tuple[float, _Member, bytes]] = []

    @property
    def onlooker_url(self) -> str:
        return f"{self.url}/onlooker"

    @property
    def session_opened(self) -> bool:
        """Since the last `new_job`."""
        return self._held

    def new_job(self) -> None:
        """The next session that is opened is its."""
        self._held = False

    def _answer(self, member: _Member, words: list[bytes]) -> None:
        if words[:2] == [b"open", b"onlooker"]:
            self._onlooker = member
        super()._answer(member, words)

    def _pass_on(self, sender: _Member, frame: bytes) -> None:
        words = frame.split()
        can_id = int(words[2], 16)
        data = words[4] if len(words) > 5 else b""
        if can_id == _PV and len(data) == 2 * PV_FRAME.size and self.shows is not None:
            pv, number = PV_FRAME.unpack(bytes.fromhex(data.decode()))
            shown = PV_FRAME.pack(self.shows(pv), number).hex().upper().encode()
            frame, data = frame.replace(data, shown), shown
        self._witness(can_id, data)
        if self.pv_broken and can_id == _PV and len(data) == 2 * PV_FRAME.size:
            frame = frame.replace(data, _NO_NUMBER + data[8:])
        onlooker = self._onlooker
        if sender is onlooker:
            super()._pass_on(sender, frame)
            return
        if onlooker is not None and can_id in _ANSWERS and onlooker.raw_from is not None:
            onlooker.queue += frame
        for delay in self.fault(can_id):
            if delay:
                self._late.append((time.monotonic() + delay, sender, frame))
            else:
                self._to_the_others(sender, frame)

    def _to_the_others(self, sender: _Member, frame: bytes) -> None:
        for other in self._members:
            if other is not sender and other is not self._onlooker and other.raw_from is not None:
                other.queue += frame
        _, _, can_id, _, data, *_ = frame.split()
        if int(can_id, 16) == _MV and len(data) == 2 * MV_FRAME.size:
            mv, number = MV_FRAME.unpack(bytes.fromhex(data.decode()))
            if number == self.sample_number:
                self.answered = number
                self.samples.setdefault(number, []).append((self.pv, mv))

    def _witness(self, can_id: int, data: bytes) -> None:
        if can_id == _PV and len(data) == 2 * PV_FRAME.size:
            self.pv, self.sample_number = PV_FRAME.unpack(bytes.fromhex(data.decode()))
            if self._taken:
                self._taken, self.first_of_session = False, self.sample_number
                self.samples.clear()
        elif can_id == sdo_request_id(CONTROLLER_NODE):
            request = bytes.fromhex(data.decode())
            if request[:1] != b"\x23":
                return
            if request[1:4] in _COMMANDS:
                self.commanded = self.sample_number
            elif request[1:4] == _OPENING and not self._held:
                self._taken = self._held = True

    def _flush(self, member: _Member) -> None:
        now = time.monotonic()
        for each in [each for each in self._late if each[0] <= now]:
            self._late.remove(each)
            self._to_the_others(each[1], each[2])
        super()._flush(member)
