"""The client's side of a CiA 301 segmented upload, as a pure function of the server's answers.

Nothing is believed that does not fit together: a device that is foreign or broken, or another client of the same
server, ends the upload with an abort code, and none can make it endless.
"""

from __future__ import annotations

from loopwright.protocol.profile import Abort
from loopwright.protocol.sdo import SdoAbort

LONGEST = 1024
"""Bytes of the longest value that is taken; names of devices are far shorter."""
_INITIATED, _SEGMENT = 2, 0


class SegmentedUpload:
    """One upload. It asks by `request` until `over`; `take` raises SdoAbort for an answer that does not fit.

    begun: the answer that began it.
    size: bytes that the value has, 0 for any number of them.
    """

    def __init__(self, begun: bytes, size: int) -> None:
        self._address = begun[1:4]
        announced = int.from_bytes(begun[4:8], "little") if begun[0] & 0x01 else None
        if announced is not None and size and announced != size:
            raise SdoAbort(Abort.LENGTH)
        if announced is not None and announced > LONGEST:
            raise SdoAbort(Abort.OUT_OF_MEMORY)
        self._announced = size or announced
        self._toggle = 0
        self._answered = False
        self.value = b""
        self.over = False

    def request(self) -> bytes:
        """Returns the request for the next segment."""
        return bytes((0x60 | self._toggle,)) + bytes(7)

    def take(self, answer: bytes) -> bool:
        """Takes an answer of 8 bytes that is no abort. Returns False when it belongs to the beginning, which was asked
        for more than once."""
        specifier = answer[0] >> 5
        if specifier == _INITIATED and answer[1:4] == self._address and not self._answered:
            return False
        self._answered = True
        if specifier != _SEGMENT:
            raise SdoAbort(Abort.COMMAND)
        if answer[0] & 0x10 != self._toggle:
            raise SdoAbort(Abort.TOGGLE)
        part = answer[1 : 8 - (answer[0] >> 1 & 7)]
        self.value += part
        self.over = bool(answer[0] & 0x01)
        self._check_length(part)
        self._toggle ^= 0x10
        return True

    def _check_length(self, part: bytes) -> None:
        maximum = LONGEST if self._announced is None else self._announced
        is_short = self.over and self._announced is not None and len(self.value) < self._announced
        if len(self.value) > maximum or is_short or not (part or self.over):
            raise SdoAbort(Abort.LENGTH)
