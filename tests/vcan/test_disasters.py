"""Live: a gateway killed beside another one at a slow sample time, and the power of a controller cut."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from loopwright.protocol.station import Station
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.gains import Gains
from tests.vcan.test_bus_loop import CONTROLLER, GAINS, PLANT, TRIED, Start, as_configured, on_vcan, start, url  # noqa: F401

HOME_WITHIN_S = 3.0
GATEWAY = """
import sys
from loopwright.protocol.station import Station
from loopwright.service.loops.bus_loop import BusLoop
from loopwright.tuning.plan import Mode, SetMode, SetRelay, SetSetpoint
url, node, channel = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
loop = BusLoop(url, 0x20, 0x10, channel, station=Station(node))
loop.begin()
loop.step((SetSetpoint(50.5), SetRelay(10.0, 0.0, 50.0), SetMode(Mode.EXPERIMENT)))
print("in test", flush=True)
while True:
    loop.step(())
"""


@contextmanager
def gateway(url: str, node: int, channel: int) -> Iterator[subprocess.Popen[str]]:  # noqa: F811
    command = [sys.executable, "-c", GATEWAY, url, str(node), str(channel)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "in test\n"
        try:
            yield process
        finally:
            process.kill()


@on_vcan
@pytest.mark.parametrize("Ts", [0.05, 1.0])
def test_of_two_gateways_the_one_that_is_killed_leaves_its_loop_at_home(start: Start, url: str, Ts: float) -> None:  # noqa: F811
    gains = ("--kp", str(GAINS.Kp), "--ti", str(GAINS.Ti), "--sp", "50", "--ts", str(Ts))
    start("loopwright.controller", "--bus", url, "--channels", "2", *gains)
    start(
        "loopwright.plantsim", "--bus", url, "--model", "model-1", "--model", "model-1", "--ts", str(Ts), "--speed", "1"
    )
    with gateway(url, 0x7D, 1) as one, gateway(url, 0x7C, 2):
        observer = BusLoop(url, CONTROLLER, PLANT, station=Station(0x7B))
        beside = BusLoop(url, CONTROLLER, PLANT, 2, station=Station(0x7B))
        assert not as_configured(observer.read())
        one.send_signal(signal.SIGKILL)
        since = time.monotonic()
        while not as_configured(observer.read()):
            assert time.monotonic() - since < HOME_WITHIN_S
            time.sleep(0.02)
        assert not as_configured(beside.read()), "the other one's test goes on"
        observer.close()
        beside.close()


WATCHED = """
import os, shutil, sys
from pathlib import Path
folder, copy = Path(sys.argv.pop(1)), Path(sys.argv.pop(1))
sync, contents = os.fsync, {}
def fsync(descriptor):
    sync(descriptor)
    inode = os.fstat(descriptor).st_ino
    if inode != folder.stat().st_ino:
        contents[inode] = Path(f"/proc/self/fd/{descriptor}").read_bytes()
        return
    shutil.rmtree(copy, ignore_errors=True)
    copy.mkdir()
    for each in folder.iterdir():
        (copy / each.name).write_bytes(contents.get(each.stat().st_ino, b""))
os.fsync = fsync
from loopwright.controller.__main__ import main
sys.exit(main())
"""
"""A controller that copies, at each sync of the folder, what is on the disk by then: files that were synced."""


@on_vcan
def test_gains_that_are_confirmed_survive_a_power_cut(start: Start, url: str, tmp_path: Path) -> None:  # noqa: F811
    folder, synced = tmp_path / "disk", tmp_path / "synced"
    folder.mkdir()
    options = ["--bus", url, "--kp", str(GAINS.Kp), "--ti", str(GAINS.Ti), "--sp", "50", "--keep"]
    start("loopwright.plantsim", "--bus", url, "--model", "model-1", "--ts", "0.1", "--speed", "20")
    command = [sys.executable, "-c", WATCHED, str(folder), str(synced), *options, str(folder / "kept.json")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as controller:
        loop = BusLoop(url, CONTROLLER, PLANT)
        try:
            assert controller.stdout is not None
            assert controller.stdout.readline().startswith("ready")
            assert loop.accept(TRIED, GAINS).gains == TRIED
        finally:
            controller.kill()
    shutil.rmtree(folder)
    start("loopwright.controller", *options, str(synced / "kept.json"))
    state = loop.read()
    assert state.gains == Gains(TRIED.Kp, TRIED.Ti) and (state.sp, state.on_trial) == (50.0, False)
    loop.close()
