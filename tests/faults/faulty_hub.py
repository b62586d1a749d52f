"""The hub with faults: frames lost, late or twice, as a test asks for while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from protocol.hub import Hub, _Member

Fault = Callable[[int], Sequence[float]]
"""Of a frame's COB-ID: the delays in s after which copies are passed on; none: the frame is lost."""


def well(can_id: int) -> Sequence[float]:
    return (0.0,)


class FaultyHub(Hub):
    def __init__(self) -> None:
        super().__init__(port=0)
        self.fault: Fault = well
        self._late: list[tuple[float, _Member, bytes]] = []

    def _pass_on(self, sender: _Member, frame: bytes) -> None:
        for delay in self.fault(int(frame.split()[2], 16)):
            if delay:
                self._late.append((time.monotonic() + delay, sender, frame))
            else:
                super()._pass_on(sender, frame)

    def _flush(self, member: _Member) -> None:
        now = time.monotonic()
        for each in [each for each in self._late if each[0] <= now]:
            self._late.remove(each)
            super()._pass_on(each[1], each[2])
        super()._flush(member)
