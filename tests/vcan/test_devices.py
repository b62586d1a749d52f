"""Plant and controller as two processes on a real (virtual) CAN bus, spoken to by the client of `canopen`."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import canopen
import pytest
from canopen.sdo.base import SdoVariable

from loopwright.protocol.bus import Bus, BusError, open_bus
from loopwright.protocol.eds import FILES, FOLDER
from loopwright.protocol.objects import Device, lookup
from loopwright.protocol.profile import (
    EMCY_FRAME,
    HEARTBEAT_FRAME,
    MV_FRAME,
    PV_FRAME,
    TUNER_NODE,
    Abort,
    Cause,
    Emcy,
    NmtCommand,
    NmtState,
    Order,
    channel_ids,
    emcy_id,
    heartbeat_id,
)
from loopwright.protocol.session import STAGED, check_of, object_of

INTERFACE = "vcan0"
URL = f"socketcan:{INTERFACE}"
PLANT, CONTROLLER = 0x10, 0x20
IDS = channel_ids(1)
PATIENCE_S = 10.0

Start = Callable[..., "subprocess.Popen[str]"]


pytestmark = pytest.mark.vcan


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts `python -m MODULE` on the bus and waits for its "ready"."""
    running: list[subprocess.Popen[str]] = []

    def go(module: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", module, "--bus", URL, *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().startswith(f"ready {module.removeprefix('loopwright.')}")
        return process

    yield go
    for process in running:
        with process:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.wait(PATIENCE_S)


@pytest.fixture
def network() -> Iterator[canopen.Network]:
    with canopen.Network() as network:
        # A Python client that hears every sample of a plant at full speed falls behind: SDO and heartbeats only.
        filters = [{"can_id": can_id, "can_mask": 0x780} for can_id in (0x580, 0x700)]
        network.connect(interface="socketcan", channel=INTERFACE, can_filters=filters)
        for device, node in ((Device.PLANT, PLANT), (Device.CONTROLLER, CONTROLLER)):
            network.add_node(node, str(FOLDER / FILES[device])).sdo.RESPONSE_TIMEOUT = 2.0
        yield network


@pytest.fixture
def listener() -> Iterator[Bus]:
    bus = open_bus(URL)
    yield bus
    bus.close()


@pytest.fixture
def loop(start: Start) -> None:
    start("loopwright.controller", "--kp", "200", "--ti", "12", "--sp", "50")
    start("loopwright.plantsim", "--model", "fopdt", "--ts", "0.1", "--speed", "max")


def sdo(network: canopen.Network, name: str) -> SdoVariable:
    entry = lookup(name)
    node = network[PLANT if entry.device is Device.PLANT else CONTROLLER]
    found = node.sdo[entry.index]
    return found[1] if entry.count(1) else found


def wait_for(what: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up, "this did not happen in time"
        time.sleep(0.02)


def hear_emergency(listener: Bus, node: int, code: Emcy) -> bytes:
    """The detail of the first EMCY with this code."""
    give_up = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up:
        frame = listener.recv(0.1)
        if frame is not None and frame[0] == emcy_id(node):
            heard, _, detail = EMCY_FRAME.unpack(frame[1])
            if heard == code:
                return bytes(detail)
    raise AssertionError(f"no EMCY {code.name}")


def order(network: canopen.Network, which: Order, *values: float) -> None:
    """Stages the values and writes the check over them."""
    for name, value in zip(STAGED[which], values, strict=True):
        sdo(network, name).raw = value
    opening = which is Order.OPEN
    number = sdo(network, "controller_session_next" if opening else "controller_session").raw
    count = 0 if opening else sdo(network, "controller_session_count").raw
    sdo(network, object_of(which)).raw = check_of(number, count, which, values)


def open_trial(network: canopen.Network, lease: int) -> None:
    order(network, Order.OPEN, TUNER_NODE, lease, 60_000, 10_000, 1000)
    order(network, Order.TRY, 300.0, 12.0, 0.0, 0.0, 1.0, 0.0)


@pytest.mark.usefixtures("loop")
class TestLoop:
    def test_the_loop_is_closed(self, network: canopen.Network) -> None:
        sdo(network, "controller_setpoint").raw = 50.2
        wait_for(lambda: abs(sdo(network, "plant_pv").raw - 50.2) < 1e-3)
        assert sdo(network, "controller_mv").raw == pytest.approx(70.0, abs=0.5)
        assert sdo(network, "plant_missing_answers").raw == 0

    def test_every_sample_is_answered_in_order(self, network: canopen.Network, listener: Bus) -> None:
        listener.set_filters({IDS.pv, IDS.mv})
        sdo(network, "plant_samples_to_run").raw = 0
        wait_for(lambda: listener.recv(0.1) is None)
        sdo(network, "plant_samples_to_run").raw = 500
        frames = [listener.recv(1.0) for _ in range(1000)]
        assert listener.recv(0.1) is None
        ids = [frame[0] for frame in frames if frame is not None]
        assert ids == [IDS.pv, IDS.mv] * 500
        numbers = [(PV_FRAME if can_id == IDS.pv else MV_FRAME).unpack(data)[1] for can_id, data in frames if data]
        assert numbers == [numbers[0] + at // 2 for at in range(1000)]

    def test_sdo_by_the_client_of_canopen(self, network: canopen.Network) -> None:
        assert sdo(network, "device_name").raw == "Loopwright controller"
        assert network[PLANT].sdo[0x1008].raw == "Loopwright plant"
        assert sdo(network, "controller_accepted_kp").raw == 200.0
        sdo(network, "controller_staged_ti").raw = 7.5
        assert sdo(network, "controller_staged_ti").raw == 7.5
        refusals = {
            "controller_mv_high": (struct.pack("<f", 101.0), Abort.TOO_HIGH),
            "controller_staged_kp": (struct.pack("<f", float("nan")), Abort.INVALID_VALUE),
            "controller_mode": (b"\x01", Abort.READ_ONLY),
            "controller_mode_command": (b"\x01\x00", Abort.LENGTH),
        }
        for name, (data, code) in refusals.items():
            with pytest.raises(canopen.SdoAbortedError) as caught:
                network[CONTROLLER].sdo.download(lookup(name).index, 1, data)
            assert caught.value.code == code

    def test_a_tuner_that_falls_silent_loses_the_loop(self, network: canopen.Network, listener: Bus) -> None:
        listener.set_filters({emcy_id(CONTROLLER)})
        network[CONTROLLER].sdo[0x1016][1].raw = TUNER_NODE << 16 | 1000
        for _ in range(3):
            listener.send(heartbeat_id(TUNER_NODE), HEARTBEAT_FRAME.pack(NmtState.OPERATIONAL))
        open_trial(network, 0x7FFFFFFF)
        assert sdo(network, "controller_on_trial").raw == 1
        assert hear_emergency(listener, CONTROLLER, Emcy.TUNER_LOST)[0] == 1, "the channel"
        assert sdo(network, "controller_on_trial").raw == 0
        assert sdo(network, "controller_cause").raw == Cause.HEARTBEAT
        assert sdo(network, "controller_accepted_kp").raw == 200.0

    def test_a_lease_not_renewed_ends_the_trial(self, network: canopen.Network, listener: Bus) -> None:
        listener.set_filters({emcy_id(CONTROLLER)})
        open_trial(network, 3000)
        order(network, Order.SETPOINT, 50.125)
        hear_emergency(listener, CONTROLLER, Emcy.LEASE_USED_UP)
        assert sdo(network, "controller_on_trial").raw == 0
        assert sdo(network, "controller_cause").raw == Cause.LEASE
        assert sdo(network, "controller_setpoint").raw == 50.0

    def test_reset_over_the_bus_boots_to_operational(self, network: canopen.Network, listener: Bus) -> None:
        listener.set_filters({heartbeat_id(CONTROLLER)})
        sdo(network, "controller_staged_kp").raw = 300.0
        network[CONTROLLER].nmt.send_command(NmtCommand.RESET_NODE)
        wait_for(lambda: listener.recv(0.1) == (heartbeat_id(CONTROLLER), bytes((NmtState.BOOT_UP,))))
        wait_for(lambda: listener.recv(0.1) == (heartbeat_id(CONTROLLER), bytes((NmtState.OPERATIONAL,))))
        assert sdo(network, "controller_staged_kp").raw == 200.0
        before = sdo(network, "sample_number").raw
        wait_for(lambda: sdo(network, "sample_number").raw > before)


def test_each_says_when_the_other_is_gone(start: Start, network: canopen.Network, listener: Bus) -> None:
    listener.set_filters({emcy_id(PLANT), emcy_id(CONTROLLER)})
    controller = start("loopwright.controller", "--kp", "200", "--ti", "12")
    plant = start("loopwright.plantsim", "--model", "fopdt", "--speed", "max")
    wait_for(lambda: bool(network[PLANT].sdo[0x2000].raw > 100))
    controller.send_signal(signal.SIGSTOP)
    hear_emergency(listener, PLANT, Emcy.NO_ANSWER)
    controller.send_signal(signal.SIGCONT)
    hear_emergency(listener, PLANT, Emcy.ERROR_GONE)
    plant.kill()
    hear_emergency(listener, CONTROLLER, Emcy.NO_PV)


def test_ends_cleanly_on_sigterm(start: Start) -> None:
    for process in (start("loopwright.controller"), start("loopwright.plantsim", "--model", "reactor", "--speed", "1")):
        process.terminate()
        assert process.wait(PATIENCE_S) == 0


def test_no_such_interface_is_said_plainly() -> None:
    with pytest.raises(BusError, match="nocan7"):
        open_bus("socketcan:nocan7")
