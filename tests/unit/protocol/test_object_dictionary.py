"""What an SDO may read and write, and the abort codes of what it may not."""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx

import pytest

from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import Device, Value, lookup
from loopwright.protocol.profile import Abort
from loopwright.protocol.sdo import SdoAbort, SdoServer

REAL = struct.Struct("<f")


@pytest.fixture
def dictionary() -> Dictionary:
    return Dictionary(Device.CONTROLLER, 2)


def refusal(dictionary: Dictionary, index: int, sub: int, data: bytes) -> Abort:
    with pytest.raises(SdoAbort) as caught:
        dictionary.write(index, sub, data)
    return caught.value.code


@pytest.mark.parametrize(
    ("name", "value", "code"),
    [
        ("controller_mv_high", 100.5, Abort.TOO_HIGH),
        ("controller_mv_low", -0.5, Abort.TOO_LOW),
        ("controller_mv_low", math.nan, Abort.INVALID_VALUE),
        ("controller_setpoint", math.inf, Abort.INVALID_VALUE),
        ("controller_staged_kp", 0.0, Abort.TOO_LOW),
        ("controller_staged_ti", -1.0, Abort.TOO_LOW),
        ("controller_staged_b", math.nan, Abort.INVALID_VALUE),
        ("controller_accepted_kp", 1.0, Abort.READ_ONLY),
    ],
)
def test_refused_reals(dictionary: Dictionary, name: str, value: float, code: Abort) -> None:
    assert refusal(dictionary, lookup(name).index, 1, REAL.pack(value)) is code


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x2100, 1, b"\x03", Abort.TOO_HIGH),
        (0x2167, 1, b"\x03", Abort.TOO_HIGH),
        (0x2139, 1, b"\x00", Abort.TOO_LOW),
        (0x2170, 1, b"\x00", Abort.LENGTH),
        (0x2120, 1, b"\x00", Abort.TOO_LOW),
        (0x6422, 1, b"\x02", Abort.INVALID_VALUE),
        (0x2100, 1, b"\x01\x00", Abort.LENGTH),
        (0x6402, 1, b"\x00\x00", Abort.LENGTH),
        (0x2100, 3, b"\x01", Abort.NO_SUBINDEX),
        (0x2100, 0, b"\x01", Abort.READ_ONLY),
        (0x1008, 0, b"name", Abort.READ_ONLY),
        (0x5FFF, 0, b"\x01", Abort.NO_OBJECT),
    ],
)
def test_refused_writes(dictionary: Dictionary, index: int, sub: int, data: bytes, code: Abort) -> None:
    assert refusal(dictionary, index, sub, data) is code


@pytest.mark.parametrize("index", [0x2120, 0x2136, 0x2170, 0x2177])
def test_refused_read_of_write_only(dictionary: Dictionary, index: int) -> None:
    with pytest.raises(SdoAbort) as caught:
        dictionary.read(index, 1)
    assert caught.value.code is Abort.WRITE_ONLY


def test_the_limits_themselves_are_allowed(dictionary: Dictionary) -> None:
    dictionary.write(0x2104, 2, REAL.pack(100.0))
    dictionary.write(0x2103, 2, REAL.pack(0.0))
    assert dictionary.get("controller_mv_high", 2) == 100.0


def test_a_device_that_refuses_keeps_its_value(dictionary: Dictionary) -> None:
    def refuse(sub: int, value: Value) -> None:
        raise SdoAbort(Abort.DEVICE_STATE)

    dictionary.on_write["controller_mode_command"] = refuse
    assert refusal(dictionary, 0x2100, 1, b"\x01") is Abort.DEVICE_STATE
    assert dictionary.get("controller_mode_command", 1) == 2


def test_number_of_channels_is_sub_index_0(dictionary: Dictionary) -> None:
    assert dictionary.read(0x6402, 0) == b"\x02"
    assert dictionary.read(0x1018, 0) == b"\x04"


def abort_code(answer: bytes | None) -> int:
    assert answer is not None and answer[0] == 0x80
    code: int = struct.unpack_from("<I", answer, 4)[0]
    return code


class TestServer:
    """Frame by frame; whole transfers are tested against the client of `canopen`."""

    @pytest.fixture
    def server(self, dictionary: Dictionary) -> SdoServer:
        return SdoServer(dictionary.read, dictionary.write, dictionary.room)

    def test_expedited_download_and_upload(self, server: SdoServer) -> None:
        assert server.answer(bytes.fromhex("23 02 64 01 00 00 48 42")) == bytes.fromhex("60 02 64 01 00 00 00 00")
        assert server.answer(bytes.fromhex("40 02 64 01 00 00 00 00")) == bytes.fromhex("43 02 64 01 00 00 48 42")

    def test_segmented_upload_of_a_name(self, server: SdoServer) -> None:
        assert server.answer(bytes.fromhex("40 08 10 00 00 00 00 00")) == bytes.fromhex("41 08 10 00 15 00 00 00")
        text, toggle = b"", 0
        while True:
            answer = server.answer(bytes((0x60 | toggle,)) + bytes(7))
            assert answer is not None and answer[0] & 0x10 == toggle
            text += answer[1 : 8 - (answer[0] >> 1 & 7)]
            toggle ^= 0x10
            if answer[0] & 1:
                break
        assert text == b"Loopwright controller"

    @pytest.mark.parametrize("request_frame", ["60" + 7 * "00", "00" + 7 * "00", "c0" + 7 * "00"])
    def test_what_begins_nothing_is_refused(self, server: SdoServer, request_frame: str) -> None:
        assert abort_code(server.answer(bytes.fromhex(request_frame))) == Abort.COMMAND

    def test_wrong_toggle(self, server: SdoServer) -> None:
        server.answer(bytes.fromhex("40 08 10 00 00 00 00 00"))
        assert abort_code(server.answer(b"\x70" + bytes(7))) == Abort.TOGGLE

    def test_segmented_download(self, server: SdoServer, dictionary: Dictionary) -> None:
        server.answer(bytes.fromhex("21 02 64 01 04 00 00 00"))
        assert server.answer(b"\x07" + REAL.pack(12.5) + bytes(3)) == b"\x20" + bytes(7)
        assert dictionary.get("controller_setpoint", 1) == 12.5

    def test_a_download_of_any_length_is_as_long_as_the_object(self, server: SdoServer, dictionary: Dictionary) -> None:
        """22h: expedited, size not indicated. What follows the value is not part of it."""
        assert server.answer(bytes.fromhex("22 67 21 01 01 ff ff ff")) == bytes.fromhex("60 67 21 01 00 00 00 00")
        assert server.answer(bytes.fromhex("22 17 10 00 e8 03 ff ff")) == bytes.fromhex("60 17 10 00 00 00 00 00")
        assert server.answer(bytes.fromhex("22 02 64 01 00 00 48 42")) == bytes.fromhex("60 02 64 01 00 00 00 00")
        values = [dictionary.get("controller_session_mode", 1), dictionary.get("heartbeat_producer")]
        assert [*values, dictionary.get("controller_setpoint", 1)] == [1, 1000, 50.0]

    @pytest.mark.parametrize("announced", [3, 5])
    def test_what_was_announced_must_come(self, server: SdoServer, dictionary: Dictionary, announced: int) -> None:
        server.answer(bytes.fromhex(f"21 02 64 01 {announced:02x} 00 00 00"))
        assert abort_code(server.answer(b"\x07" + REAL.pack(12.5) + bytes(3))) == Abort.LENGTH
        assert dictionary.get("controller_setpoint", 1) == 0

    @pytest.mark.parametrize(
        ("address", "code"),
        [
            ("ff 5f 00", Abort.NO_OBJECT),
            ("02 64 03", Abort.NO_SUBINDEX),
            ("10 64 01", Abort.READ_ONLY),
            ("00 20 00", Abort.DEVICE_STATE),
        ],
    )
    def test_a_download_in_vain_is_refused_before_its_segments(
        self, server: SdoServer, address: str, code: Abort
    ) -> None:
        assert abort_code(server.answer(bytes.fromhex(f"21 {address} 04 00 00 00"))) == code

    def test_a_download_cannot_fill_the_memory(self, server: SdoServer) -> None:
        assert abort_code(server.answer(bytes.fromhex("21 02 64 01 ff ff ff ff"))) == Abort.OUT_OF_MEMORY
        server.answer(bytes.fromhex("20 02 64 01 00 00 00 00"))
        answers = [server.answer(bytes((toggle,)) + bytes(7)) for toggle in (0x00, 0x10) * 80]
        assert Abort.OUT_OF_MEMORY in [abort_code(each) for each in answers if each and each[0] == 0x80]

    NAME = b"Loopwright controller"

    def block(self, server: SdoServer, request: str) -> list[str]:
        answer = server.answer(bytes.fromhex(request).ljust(8, b"\0"))
        return [answer[at : at + 8].hex(" ") for at in range(0, len(answer), 8)] if answer else []

    def test_block_upload(self, server: SdoServer) -> None:
        """Two segments by the block; the second block is lost once, and the client changes to longer ones."""
        assert self.block(server, "a4 08 10 00 02 00") == ["c6 08 10 00 15 00 00 00"]
        segments = [f"{head:02x} {self.NAME[at : at + 7].hex(' ')}" for head, at in ((1, 0), (2, 7), (0x81, 14))]
        assert self.block(server, "a3") == segments[:2]
        assert self.block(server, "a2 02 02") == segments[2:]
        assert self.block(server, "a2 00 7f") == segments[2:]
        end = bytes((0xC1,)) + crc_hqx(self.NAME, 0).to_bytes(2, "little") + bytes(5)
        assert self.block(server, "a2 01 7f") == [end.hex(" ")]
        assert self.block(server, "a1") == []
        assert abort_code(server.answer(b"\xa1" + bytes(7))) == Abort.COMMAND

    def test_block_upload_goes_on_where_the_client_lost_it(self, server: SdoServer) -> None:
        self.block(server, "a4 08 10 00 7f 00")
        assert len(self.block(server, "a3")) == 3
        assert self.block(server, "a2 01 7f")[0] == "01 " + self.NAME[7:14].hex(" ")

    def test_block_upload_of_a_number(self, server: SdoServer) -> None:
        assert self.block(server, "a0 17 10 00 7f 00") == ["c6 17 10 00 02 00 00 00"]
        assert self.block(server, "a3") == ["81 f4 01 00 00 00 00 00"]
        assert self.block(server, "a2 01 7f")[0].startswith("d5 ")

    def test_block_upload_of_what_is_short_enough_is_an_ordinary_one(self, server: SdoServer) -> None:
        assert self.block(server, "a4 17 10 00 7f 02") == ["4b 17 10 00 f4 01 00 00"]
        assert self.block(server, "a4 08 10 00 7f 15") == ["41 08 10 00 15 00 00 00"]
        assert self.block(server, "a4 08 10 00 7f 14") == ["c6 08 10 00 15 00 00 00"]

    @pytest.mark.parametrize(
        ("requests", "code"),
        [
            (["a4 08 10 00 00 00"], Abort.BLOCK_SIZE),
            (["a4 08 10 00 80 00"], Abort.BLOCK_SIZE),
            (["a4 08 10 00 7f 00", "a3", "a2 03 00"], Abort.BLOCK_SIZE),
            (["a4 08 10 00 7f 00", "a3", "a2 04 7f"], Abort.SEQUENCE_NUMBER),
            (["a4 08 10 00 7f 00", "a1"], Abort.COMMAND),
            (["a3"], Abort.COMMAND),
            (["a4 ff 5f 00 7f 00"], Abort.NO_OBJECT),
        ],
    )
    def test_block_uploads_that_are_refused(self, server: SdoServer, requests: list[str], code: Abort) -> None:
        *before, last = requests
        for request in before:
            self.block(server, request)
        assert abort_code(server.answer(bytes.fromhex(last).ljust(8, b"\0"))) == code
        assert abort_code(server.answer(b"\xa3" + bytes(7))) == Abort.COMMAND

    def test_silence_on_an_abort_and_on_a_short_frame(self, server: SdoServer) -> None:
        assert server.answer(b"\x80" + bytes(7)) is None
        assert server.answer(b"\x40\x00") is None
