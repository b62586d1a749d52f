"""An outside judge: Wireshark's own CANopen dissector reads a captured session and finds nothing malformed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from loopwright.protocol.bus import open_bus
from loopwright.protocol.profile import (
    NMT_FRAME,
    NMT_ID,
    SYNC_ID,
    NmtCommand,
    channel_ids,
    emcy_id,
    heartbeat_id,
    sdo_request_id,
    sdo_response_id,
)
from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.runner import run
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.service.loops.bus_session import WATCH_S
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode, Plan, SetGains, SetMode, SetRelay, SetSetpoint

INTERFACE = "vcan0"
pytestmark = pytest.mark.vcan
URL = f"socketcan:{INTERFACE}"
PLANT, CONTROLLER, TUNER = 0x10, 0x20, 0x7D
IDS = channel_ids(1)
SAMPLES = 400
BROKEN_ID = sdo_request_id(0x7F)
"""No such node: a request of two bytes that hurts nobody."""


@pytest.fixture(scope="module", autouse=True)
def what_it_needs() -> None:
    missing = [tool for tool in ("dumpcap", "tshark") if shutil.which(tool) is None]
    if missing:
        text = f"not there: {', '.join(missing)}"
        if os.environ.get("LOOPWRIGHT_REQUIRE_VCAN"):
            pytest.fail(text)
        pytest.skip(text)


@contextmanager
def captured(file: Path) -> Iterator[None]:
    """Everything on the bus, from before the first device's boot-up. Nothing may be lost on the way to the file."""
    command = ["dumpcap", "-q", "-i", INTERFACE, "-B", "16", "-w", str(file)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as dumpcap:
        assert dumpcap.stderr is not None
        said = [line := dumpcap.stderr.readline()]
        while not line.startswith("File:"):
            assert line, f"dumpcap: {''.join(said)}"
            said.append(line := dumpcap.stderr.readline())
        try:
            yield
            bus = open_bus(URL)
            bus.send(BROKEN_ID, b"\x40\x00")
            bus.close()
            time.sleep(0.5)
        finally:
            dumpcap.send_signal(signal.SIGINT)
            said += dumpcap.stderr.readlines()
    assert "/0 (pcap:0/dumpcap:0/" in said[-1], said


@contextmanager
def started(module: str, *arguments: str) -> Iterator[None]:
    command = [sys.executable, "-m", module, "--bus", URL, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready")
        try:
            yield
        finally:
            process.terminate()


def plan() -> Plan[None]:
    """Trial gains, a step, a relay."""
    yield (SetGains(Gains(Kp=80.0, Ti=6.0)), SetSetpoint(50.25))
    for _ in range(SAMPLES // 2):
        yield ()
    yield (SetRelay(amplitude=10.0, hysteresis=0.0, working_output=50.0), SetMode(Mode.EXPERIMENT))
    for _ in range(SAMPLES // 2):
        yield ()


def session() -> None:
    """A tuner's session, one that dies on the way, and a controller that is stopped and started by NMT."""
    loop = BusLoop(URL, CONTROLLER, PLANT)
    result = run(plan(), loop, limits=RunLimits())
    assert result.ended is None, result.ended
    loop.begin()
    loop.close()  # its heartbeat ends while its lease runs
    time.sleep(WATCH_S + 1.0)
    bus = open_bus(URL)
    for command in (NmtCommand.STOP, NmtCommand.START, NmtCommand.RESET_NODE):
        bus.send(NMT_ID, NMT_FRAME.pack(command, CONTROLLER))
        time.sleep(0.2)
    bus.close()


def decode(file: Path) -> list[tuple[int, str, str]]:
    """COB-ID, what the dissector calls the frame, and its complaint if it has one."""
    command = ["tshark", "-n", "-r", str(file), "-d", "can.subdissector,canopen", "-T", "fields"]
    for field in ("can.id", "frame.protocols", "_ws.col.Info", "_ws.malformed", "_ws.expert.message"):
        command += ["-e", field]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert found.returncode == 0, found.stderr
    frames = []
    for line in found.stdout.splitlines():
        can_id, protocols, info, *complaint = line.split("\t")
        assert protocols.startswith("can:canopen"), line
        frames.append((int(can_id), info, " ".join(complaint).strip()))
    return frames


def test_wireshark_reads_a_session_as_canopen(tmp_path: Path) -> None:
    file = tmp_path / "session.pcapng"
    controller = ("loopwright.controller", "--kp", "60", "--ti", "7", "--sp", "50")
    plant = ("loopwright.plantsim", "--model", "model-1", "--ts", "0.1", "--speed", "20", "--seed", "7")
    with captured(file), started(*controller), started(*plant):
        session()
    frames = decode(file)
    assert frames[-1] == (BROKEN_ID, frames[-1][1], frames[-1][2])
    assert "Malformed" in frames[-1][2], "the frame broken on purpose shows that the dissector complains"
    frames.pop()
    assert [frame for frame in frames if frame[2]] == []

    count = Counter(can_id for can_id, _, _ in frames)
    for can_id in (SYNC_ID, IDS.pv, IDS.mv):
        assert count[can_id] >= SAMPLES, hex(can_id)
    assert count[IDS.status] >= 3
    for node, minimum in ((CONTROLLER, 50), (PLANT, 5)):
        assert count[sdo_request_id(node)] >= minimum
        assert count[sdo_response_id(node)] == count[sdo_request_id(node)]
        assert count[heartbeat_id(node)] >= 5
    assert count[heartbeat_id(TUNER)] >= 10
    assert count[emcy_id(CONTROLLER)] >= 1
    assert count[NMT_ID] == 3

    said = Counter((can_id, info.split(" [")[0].removeprefix("16 ").strip()) for can_id, info, _ in frames)
    names = {info for _, info in said}
    assert {"SYNC", "PDO1 (tx)", "PDO2 (tx)", "PDO3 (tx)", "EMCY"} <= names, names
    assert said[heartbeat_id(CONTROLLER), "NMT Error Control: Boot-up"] == 2, said
    assert said[heartbeat_id(PLANT), "NMT Error Control: Boot-up"] == 1, said
    assert sum(number for (can_id, _), number in said.items() if can_id == sdo_request_id(CONTROLLER)) >= 50
