"""A whole session with a master that nobody here wrote: the client of `canopen`, our EDS, and zlib for the check.

Everything is written as somebody would who has the EDS and decision 8 before them, and none of our code.
"""

from __future__ import annotations

import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import canopen
import pytest

INTERFACE = "vcan0"
pytestmark = pytest.mark.vcan
TUNER, CONTROLLER = 0x55, 0x20
EDS = Path(__file__).parents[2] / "protocol" / "eds_files" / "loopwright_controller.eds"
OPEN, CLOSE, SETPOINT, MODE, OUTPUT, RELAY, TRY, ACCEPT = range(8)
MANUAL, AUTOMATIC, EXPERIMENT = 1, 2, 3
PATIENCE_S = 10.0
FORMATS = {
    OPEN: ("<BIIII", (0x2139, 0x213A, 0x213B, 0x213C, 0x213D)),
    CLOSE: ("<", ()),
    SETPOINT: ("<f", (0x2166,)),
    MODE: ("<B", (0x2167,)),
    OUTPUT: ("<f", (0x2168,)),
    RELAY: ("<fffIfffB", tuple(range(0x2151, 0x2159))),
    TRY: ("<ffffff", tuple(range(0x2160, 0x2166))),
    ACCEPT: ("<ffffff", tuple(range(0x2160, 0x2166))),
}
"""By order: how its values are packed for the check, and the objects that they are staged in."""


@pytest.fixture
def loop() -> Iterator[None]:
    started = [
        ("loopwright.controller", "--bus", f"socketcan:{INTERFACE}", "--kp", "200", "--ti", "12", "--sp", "50"),
        ("loopwright.plantsim", "--bus", f"socketcan:{INTERFACE}", "--model", "fopdt", "--ts", "0.1", "--speed", "20"),
    ]
    running = []
    for arguments in started:
        process = subprocess.Popen([sys.executable, "-m", *arguments], stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None and process.stdout.readline().startswith("ready")
    yield
    for process in running:
        with process:
            process.terminate()


class Master:
    """A tuner in thirty lines: what it stages, the check that puts it in force, and its heartbeat."""

    def __init__(self, network: canopen.Network) -> None:
        self.network = network
        self.node = network.add_node(CONTROLLER, str(EDS))
        self.node.sdo.RESPONSE_TIMEOUT = 2.0
        self.number = self.count = 0
        self._silent = threading.Event()
        self._beat: threading.Thread | None = None

    def read(self, index: int) -> float:
        value: float = self.node.sdo[index][1].raw
        return value

    def order(self, which: int, *values: float) -> None:
        packing, objects = FORMATS[which]
        for index, value in zip(objects, values, strict=True):
            self.node.sdo[index][1].raw = value
        if which == OPEN:
            self.number, self.count = int(self.read(0x2130)), 0
        revision = self.node.sdo[0x1018][3].raw
        text = struct.pack("<IIIB", revision, self.number, self.count, which) + struct.pack(packing, *values)
        self.node.sdo[0x2170 + which][1].raw = zlib.crc32(text)
        self.count += 1

    def beat(self) -> None:
        def send() -> None:
            while not self._silent.wait(0.1):
                self.network.send_message(0x700 + TUNER, b"\x05")

        self._beat = threading.Thread(target=send)
        self._beat.start()

    def fall_silent(self) -> None:
        self._silent.set()
        if self._beat is not None:
            self._beat.join()


@pytest.fixture
def master(loop: None) -> Iterator[Master]:
    with canopen.Network() as network:
        filters = [{"can_id": can_id, "can_mask": 0x780} for can_id in (0x080, 0x580, 0x700)]
        network.connect(interface="socketcan", channel=INTERFACE, can_filters=filters)
        master = Master(network)
        yield master
        master.fall_silent()


def until(true: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < give_up, "this did not happen in time"
        time.sleep(0.02)


def test_a_session_is_opened_ordered_renewed_and_closed(master: Master) -> None:
    master.beat()
    master.order(OPEN, TUNER, 10_000, 3000, 1000, 1000)
    assert (master.read(0x2131), master.read(0x2137), master.read(0x2138)) == (master.number, TUNER, 1)
    home_mv = master.read(0x2141)

    master.order(SETPOINT, 50.25)
    until(lambda: abs(master.read(0x6402) - 50.25) < 1e-6)
    master.order(MODE, MANUAL)
    master.order(OUTPUT, 55.0)
    until(lambda: master.read(0x6410) == 55.0)
    master.order(MODE, AUTOMATIC)
    master.order(TRY, 150.0, 10.0, 0.0, 0.0, 1.0, 0.0)
    assert (master.read(0x2121), master.read(0x2118)) == (1, 200.0)

    master.order(SETPOINT, 50.0)
    master.order(RELAY, 5.0, 0.0, 50.0, 100_000, 40.0, 60.0, 0.0, 1)
    assert (master.read(0x2101), master.read(0x2159)) == (EXPERIMENT, 1)
    until(lambda: master.read(0x6410) in {45.0, 55.0})  # until then 6410h shows the last sample in automatic
    seen = set()
    began = time.monotonic()
    while time.monotonic() < began + 4.0:  # longer than the lease
        master.node.sdo[0x2136][1].raw = master.number
        seen.add(master.read(0x6410))
        time.sleep(0.1)
    assert seen == {45.0, 55.0} and master.read(0x2131) == master.number

    master.order(CLOSE)
    assert (master.read(0x2131), master.read(0x2132), master.read(0x2133)) == (0, master.number, 4)
    assert (master.read(0x2101), master.read(0x6402), master.read(0x2121)) == (AUTOMATIC, 50.0, 0)
    until(lambda: abs(master.read(0x6410) - home_mv) < 0.5)


def test_gains_are_accepted_and_another_hand_ends_the_session(master: Master) -> None:
    master.beat()
    master.order(OPEN, TUNER, 10_000, 3000, 1000, 1000)
    master.order(ACCEPT, 150.0, 10.0, 0.0, 0.0, 1.0, 0.0)
    assert [master.read(index) for index in (0x2118, 0x2119, 0x2142, 0x2122)] == [150.0, 10.0, 200.0, 1]
    master.node.sdo[0x2100][1].raw = MANUAL
    assert (master.read(0x2131), master.read(0x2133), master.read(0x2134)) == (0, 8, 2)
    with pytest.raises(canopen.SdoAbortedError) as refused:
        master.order(SETPOINT, 51.0)
    assert refused.value.code == 0x08000022


def test_what_is_wrong_is_refused_by_its_abort_code(master: Master) -> None:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        master.order(SETPOINT, 51.0)
    assert refused.value.code == 0x08000022, "no session"
    master.beat()
    master.order(OPEN, TUNER, 10_000, 3000, 1000, 1000)
    opened, count = master.number, master.count
    with pytest.raises(canopen.SdoAbortedError) as refused:
        master.order(OPEN, TUNER, 10_000, 3000, 1000, 1000)
    assert refused.value.code == 0x08000022, "one at a time"
    master.number, master.count = opened, count + 1
    with pytest.raises(canopen.SdoAbortedError) as refused:
        master.order(SETPOINT, 51.0)
    assert refused.value.code == 0x06090030, "a count that is not the next"
    assert master.read(0x6402) == 50.0


def test_a_master_that_falls_silent_loses_the_loop(master: Master) -> None:
    heard: list[int] = []
    master.node.emcy.add_callback(lambda error: heard.append(error.code))
    master.beat()
    master.order(OPEN, TUNER, 0xFFFFFFFF, 60_000, 10_000, 1000)
    master.order(SETPOINT, 50.25)
    master.fall_silent()
    until(lambda: master.read(0x2131) == 0)
    assert (master.read(0x2133), master.read(0x6402)) == (1, 50.0)
    until(lambda: 0xFF04 in heard)
