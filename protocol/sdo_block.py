"""A block upload of CiA 301 from the server's side: segments by the block, a confirmation for each, CRC at the end."""

from __future__ import annotations

import struct
from binascii import crc_hqx

LONGEST = 127
"""Segments in a block."""
_PART = 7
_LAST = 0x80
_END = struct.Struct("<BH5x")


class BlockUpload:
    """One transfer. Frames are handed out one behind the other, 8 bytes each."""

    def __init__(self, data: bytes, length: int) -> None:
        """length: of the first block, in segments."""
        self._data = self._left = data
        self._length = length
        self.sent = 0
        """Segments of the block that is under way."""
        self.over = False
        """All has arrived; the client has only to say goodbye."""

    def segments(self) -> bytes:
        """The next block, which begins with what the client has not confirmed yet."""
        starts = range(0, max(len(self._left), 1), _PART)
        parts = [self._left[at : at + _PART] for at in starts[: self._length]]
        self.sent = len(parts)
        frames = bytearray()
        for number, part in enumerate(parts, start=1):
            last = _LAST if number == len(starts) else 0
            frames += bytes((number | last,)) + part.ljust(_PART, b"\0")
        return bytes(frames)

    def after(self, confirmed: int, length: int) -> bytes:
        """What follows the confirmation of that many segments of the block; length: of the next one."""
        self._left = self._left[_PART * confirmed :]
        self._length = length
        if self._left or not confirmed:
            return self.segments()
        self.over = True
        unused = -len(self._data) % _PART if self._data else _PART
        return _END.pack(0xC1 | unused << 2, crc_hqx(self._data, 0))
