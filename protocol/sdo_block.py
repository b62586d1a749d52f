"""The server's side of a CiA 301 block upload: blocks of segments, a confirmation for each block, a CRC at the end."""

from __future__ import annotations

import struct
from binascii import crc_hqx

LONGEST = 127
"""Largest number of segments in a block."""
_PART = 7
_LAST = 0x80
_END = struct.Struct("<BH5x")


class BlockUpload:
    """One block upload. Its methods return frames of 8 bytes each, one after the other."""

    def __init__(self, data: bytes, length: int) -> None:
        """Begins an upload.

        length: segments of the first block.
        """
        self._data = self._left = data
        self._length = length
        self.sent = 0
        """Number of segments of the present block."""
        self.over = False
        """Whether everything is confirmed; only the client's end frame is still to come."""

    def segments(self) -> bytes:
        """Returns the next block, which begins with the first byte that the client has not confirmed."""
        starts = range(0, max(len(self._left), 1), _PART)
        parts = [self._left[at : at + _PART] for at in starts[: self._length]]
        self.sent = len(parts)
        frames = bytearray()
        for number, part in enumerate(parts, start=1):
            last = _LAST if number == len(starts) else 0
            frames += bytes((number | last,)) + part.ljust(_PART, b"\0")
        return bytes(frames)

    def after(self, confirmed: int, length: int) -> bytes:
        """Returns the frames that follow a confirmation.

        confirmed: number of segments of the block that the client confirms.
        length: segments of the next block.
        """
        self._left = self._left[_PART * confirmed :]
        self._length = length
        if self._left or not confirmed:
            return self.segments()
        self.over = True
        unused = -len(self._data) % _PART if self._data else _PART
        return _END.pack(0xC1 | unused << 2, crc_hqx(self._data, 0))
