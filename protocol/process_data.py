"""The process data of one channel: the PDOs PV, MV and status, put together into samples.

The tuner's client and a listener that sends nothing decode them by the same code.
"""

from __future__ import annotations

from typing import NamedTuple

from loopwright.protocol.profile import MV_FRAME, PV_FRAME, STATUS_FRAME, UNASKED
from loopwright.protocol.real32 import shortest


class BusSample(NamedTuple):
    """One sample as seen on the bus: PV(n), the MV that answers it, and the status in effect then."""

    n: int
    pv: float
    mv: float
    mode: int
    on_trial: bool
    sp: float


class ProcessData:
    """Puts samples together. Every method raises struct.error for a foreign frame with the identifier, which has
    another length; the frame is then passed over."""

    def __init__(self) -> None:
        self.mode, self.on_trial, self.sp = 0, False, 0.0
        self.session_is_open = False
        self._pv = (0.0, -1)

    def take_pv(self, data: bytes) -> None:
        self._pv = PV_FRAME.unpack(data)

    def take_mv(self, data: bytes) -> tuple[int, float, float] | None:
        """Returns sample number, PV and MV as the REAL32 that were sent; None where the MV answers no PV that came."""
        mv, n = MV_FRAME.unpack(data)
        pv, answered = self._pv
        return (n, pv, mv) if n == answered and n != UNASKED else None

    def take_status(self, data: bytes) -> None:
        self.mode, on_trial, sp, is_open, _cause = STATUS_FRAME.unpack(data)
        self.sp = shortest(sp)
        self.on_trial, self.session_is_open = bool(on_trial), bool(is_open)
