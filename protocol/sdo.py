"""SDO server of CiA 301 as a pure function of requests: expedited and segmented transfers, and uploads by the block.

The server of the `canopen` library is not used: it needs its Network (a thread) and answers neither a missing
sub-index nor a value beyond its limits with the abort code of the profile. A block download is refused, because
nothing that can be written is longer than one frame.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from loopwright.protocol.profile import Abort
from loopwright.protocol.sdo_block import LONGEST, BlockUpload

_HEADER = struct.Struct("<BHB")
_ABORT = struct.Struct("<BHBI")
_SIZE = struct.Struct("<I")
_LARGEST_DOWNLOAD = 1024  # bytes; no object is longer, and a client cannot fill the memory

_SEGMENT_DOWNLOAD, _DOWNLOAD, _UPLOAD, _SEGMENT_UPLOAD, _ABORTED, _BLOCK_UPLOAD = range(6)
_INITIATE, _END, _CONFIRM, _START = range(4)  # steps of a block upload


class SdoAbort(Exception):
    """Raised to end a transfer with this abort code."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code:#010x}")
        self.code = code


class SdoServer:
    """Serves one client at a time, as a default SDO channel does.

    read, write: carry out an upload and a download by index and sub-index.
    room: how many bytes an object takes, 0 for any number. All three raise SdoAbort to refuse.
    """

    def __init__(
        self,
        read: Callable[[int, int], bytes],
        write: Callable[[int, int, bytes], None],
        room: Callable[[int, int], int],
    ) -> None:
        self._read = read
        self.write = write
        self._room = room
        self._index = 0
        self._sub = 0
        self._outgoing: bytes | None = None
        self._incoming: bytearray | None = None
        self._block: BlockUpload | None = None
        self._announced: int | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """Returns the response of 8 bytes, several frames in a row for a block, or None when none is due."""
        if len(request) < 8:
            return None
        specifier = request[0] >> 5
        try:
            if specifier == _DOWNLOAD:
                return self._download(request)
            if specifier == _UPLOAD:
                return self._upload(request)
            if specifier == _BLOCK_UPLOAD:
                return self._block_upload(request)
            if specifier == _SEGMENT_UPLOAD:
                return self._segment_upload(request[0])
            if specifier == _SEGMENT_DOWNLOAD:
                return self._segment_download(request)
            if specifier == _ABORTED:
                self.end()
                return None
            _, self._index, self._sub = _HEADER.unpack_from(request)
            raise SdoAbort(Abort.COMMAND)
        except SdoAbort as abort:
            self.end()
            return _ABORT.pack(0x80, self._index, self._sub, abort.code)

    def end(self) -> None:
        """Drops the transfer in progress without a response."""
        self._outgoing = self._incoming = self._block = None
        self._toggle = 0

    def _begin(self, request: bytes) -> None:
        self.end()
        _, self._index, self._sub = _HEADER.unpack_from(request)

    def _upload(self, request: bytes) -> bytes:
        self._begin(request)
        return self._offer(self._read(self._index, self._sub))

    def _offer(self, data: bytes) -> bytes:
        if 0 < len(data) <= 4:
            command = 0x43 | (4 - len(data)) << 2
            return _HEADER.pack(command, self._index, self._sub) + data.ljust(4, b"\0")
        self._outgoing = data
        return _HEADER.pack(0x41, self._index, self._sub) + _SIZE.pack(len(data))

    def _block_upload(self, request: bytes) -> bytes | None:
        step = request[0] & 0x03
        if step == _INITIATE:
            return self._begin_block_upload(request)
        block = self._block
        if block is not None and not block.over:
            if step == _START:
                return block.segments()
            if step == _CONFIRM:
                if request[1] > block.sent:
                    raise SdoAbort(Abort.SEQUENCE_NUMBER)
                return block.after(request[1], _length_of_block(request[2]))
        elif block is not None and step == _END:
            self.end()
            return None
        raise SdoAbort(Abort.COMMAND)

    def _begin_block_upload(self, request: bytes) -> bytes:
        """Begins a block upload, or an ordinary one where the value is no longer than the client's threshold (pst)."""
        self._begin(request)
        length, threshold = _length_of_block(request[4]), request[5]
        data = self._read(self._index, self._sub)
        if len(data) <= threshold:
            return self._offer(data)
        self._block = BlockUpload(data, length)
        return _HEADER.pack(0xC6, self._index, self._sub) + _SIZE.pack(len(data))

    def _segment_upload(self, command: int) -> bytes:
        if self._outgoing is None:
            raise SdoAbort(Abort.COMMAND)
        self._check_toggle(command)
        part, self._outgoing = self._outgoing[:7], self._outgoing[7:]
        answer = self._toggle | (7 - len(part)) << 1
        self._toggle ^= 0x10
        if not self._outgoing:
            answer |= 1
            self.end()
        return bytes((answer,)) + part.ljust(7, b"\0")

    def _download(self, request: bytes) -> bytes:
        self._begin(request)
        command = request[0]
        room = self._room(self._index, self._sub)
        if command & 0x02:
            size = 4 - (command >> 2 & 3) if command & 0x01 else room or 4
            self.write(self._index, self._sub, request[4 : 4 + size])
        else:
            self._announced = _SIZE.unpack_from(request, 4)[0] if command & 0x01 else None
            if self._announced is not None and self._announced > _LARGEST_DOWNLOAD:
                raise SdoAbort(Abort.OUT_OF_MEMORY)
            self._incoming = bytearray()
        return _HEADER.pack(0x60, self._index, self._sub) + bytes(4)

    def _segment_download(self, request: bytes) -> bytes:
        if self._incoming is None:
            raise SdoAbort(Abort.COMMAND)
        command = request[0]
        self._check_toggle(command)
        self._incoming += request[1 : 8 - (command >> 1 & 7)]
        if len(self._incoming) > _LARGEST_DOWNLOAD:
            raise SdoAbort(Abort.OUT_OF_MEMORY)
        answer = 0x20 | self._toggle
        self._toggle ^= 0x10
        if command & 0x01:
            data = bytes(self._incoming)
            self.end()
            if self._announced not in (None, len(data)):
                raise SdoAbort(Abort.LENGTH)
            self.write(self._index, self._sub, data)
        return bytes((answer,)) + bytes(7)

    def _check_toggle(self, command: int) -> None:
        if command & 0x10 != self._toggle:
            raise SdoAbort(Abort.TOGGLE)


def _length_of_block(segments: int) -> int:
    if not 1 <= segments <= LONGEST:
        raise SdoAbort(Abort.BLOCK_SIZE)
    return segments
