"""Plant and controller as a master sees them that nobody here wrote: `canopen`, which knows of them only the EDS files.

Every entry is read, held against the default that its EDS gives, and tried to be written where the EDS says `ro`.
"""

from __future__ import annotations

import queue
import struct
import time
from collections.abc import Callable, Iterator

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import NUMBER_TYPES
from canopen.sdo.client import BlockUploadStream

from loopwright.protocol.eds import FILES, FOLDER
from loopwright.protocol.objects import Device
from loopwright.protocol.profile import TUNER_NODE, Abort, Emcy, NmtState
from tests.vcan.test_devices import INTERFACE, PATIENCE_S, Start, pytestmark, start

__all__ = ["pytestmark", "start"]

PLANT, CONTROLLER = 0x10, 0x20
EDS = {PLANT: FOLDER / FILES[Device.PLANT], CONTROLLER: FOLDER / FILES[Device.CONTROLLER]}
# Defaults of the EDS are those of a device started without options; these move by themselves, or are of the options.
LIVE = {0x1001, 0x2000, 0x2001, 0x2011, 0x2123, 0x2130}


@pytest.fixture
def network() -> Iterator[canopen.Network]:
    with canopen.Network() as network:
        network.connect(interface="socketcan", channel=INTERFACE)
        for node, path in EDS.items():
            network.add_node(node, str(path)).sdo.RESPONSE_TIMEOUT = PATIENCE_S
        yield network


@pytest.fixture(autouse=True)
def devices(start: Start) -> None:
    start("loopwright.controller", "--kp", "200", "--ti", "12", "--sp", "50")
    start("loopwright.plantsim", "--model", "fopdt", "--ts", "0.1", "--speed", "1")


def entries(node: canopen.RemoteNode) -> Iterator[ODVariable]:
    for entry in node.object_dictionary.values():
        if isinstance(entry, ODVariable):
            yield entry
        else:
            yield from entry.values()


def wait_for(what: Callable[[], object]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up, "this did not happen in time"
        time.sleep(0.02)


def hear(node: canopen.RemoteNode, code: Emcy) -> canopen.emcy.EmcyError:
    """The last emergency, as soon as it is this one. All are kept, so none can come before it is waited for."""
    wait_for(lambda: node.emcy.log and node.emcy.log[-1].code == code)
    return node.emcy.log[-1]


def refused(node: canopen.RemoteNode, entry: ODVariable, data: bytes) -> int:
    with pytest.raises(canopen.SdoAbortedError) as caught:
        node.sdo.download(entry.index, entry.subindex, data)
    return int(caught.value.code)


@pytest.mark.parametrize("number", [PLANT, CONTROLLER])
def test_every_entry_is_as_its_eds_says(network: canopen.Network, number: int) -> None:
    node = network[number]
    wait_for(lambda: node.sdo[0x1001].raw == 0)  # one of the two was started before the other
    node.sdo[0x1003][0].raw = 0
    different, compared = [], 0
    for entry in entries(node):
        where = f"{entry.index:04X}h:{entry.subindex}"
        absent = Abort.NO_DATA if entry.index == 0x1003 and entry.subindex else None
        if absent or not entry.readable:
            with pytest.raises(canopen.SdoAbortedError) as caught:
                node.sdo.upload(entry.index, entry.subindex)
            assert caught.value.code == (absent or Abort.WRITE_ONLY), where
            continue
        data = node.sdo.upload(entry.index, entry.subindex)
        if entry.data_type in NUMBER_TYPES:
            assert 8 * len(data) == len(entry), where
        if entry.default is not None and entry.index not in LIVE:
            compared += 1
            if entry.decode_raw(data) != entry.default:
                different.append(where)
        if not entry.writable:
            assert refused(node, entry, data) == Abort.READ_ONLY, where
    assert different == []
    assert compared > 40


def test_names_come_in_segments(network: canopen.Network) -> None:
    assert network[CONTROLLER].sdo["Manufacturer device name"].raw == "Loopwright controller"
    assert network[PLANT].sdo["Manufacturer device name"].raw == "Loopwright plant"
    with network[CONTROLLER].sdo.open(0x6402, 1, "wb", size=4, force_segment=True) as download:
        download.write(struct.pack("<f", 50.5))
    assert network[CONTROLLER].sdo[0x6402][1].raw == 50.5


@pytest.mark.parametrize("number", [PLANT, CONTROLLER])
def test_names_come_by_the_block(network: canopen.Network, number: int) -> None:
    """The client holds the number of segments and the CRC against what it got."""
    with network[number].sdo.open(0x1008, 0, "rb", block_transfer=True, request_crc_support=True) as upload:
        assert upload.read() == network[number].sdo.upload(0x1008, 0)
        assert isinstance(upload.raw, BlockUploadStream)


def test_limits_that_the_eds_leaves_out_hold_all_the_same(network: canopen.Network) -> None:
    node = network[CONTROLLER]
    assert refused(node, node.object_dictionary[0x2104][1], struct.pack("<f", 100.5)) == Abort.TOO_HIGH
    assert refused(node, node.object_dictionary[0x1003][0], b"\xff") == Abort.INVALID_VALUE
    assert refused(node, node.object_dictionary[0x2000], bytes(4)) == Abort.DEVICE_STATE


@pytest.mark.parametrize("number", [PLANT, CONTROLLER])
def test_states(network: canopen.Network, number: int) -> None:
    nmt = network[number].nmt
    heard: list[int] = []
    nmt.add_heartbeat_callback(heard.append)
    network[number].sdo[0x1017].raw = 50
    for command, state in (
        ("PRE-OPERATIONAL", NmtState.PRE_OPERATIONAL),
        ("STOPPED", NmtState.STOPPED),
        ("OPERATIONAL", NmtState.OPERATIONAL),
    ):
        nmt.state = command
        wait_for(lambda wanted=state: heard[-1:] == [wanted])
    for command in ("RESET", "RESET COMMUNICATION"):
        heard.clear()
        nmt.state = command
        wait_for(lambda: NmtState.BOOT_UP in heard and heard[-1] == NmtState.OPERATIONAL)
        assert network[number].sdo[0x1017].raw == 500


def test_pdos_by_what_the_device_says_of_them(network: canopen.Network) -> None:
    """Mapping and identifiers are read from the device; the set-point goes out by RPDO2, and the status says it."""
    node = network[CONTROLLER]
    node.tpdo.read()
    node.rpdo.read()
    status, command = node.tpdo[3], node.rpdo[2]
    assert not status.rtr_allowed
    assert [variable.index for variable in status.map] == [0x2101, 0x2121, 0x6402, 0x2138, 0x2133]
    heard: queue.Queue[float] = queue.Queue()
    status.add_callback(lambda received: heard.put(received[2].raw))
    command[0].raw = 50.25
    command.transmit()
    assert heard.get(timeout=PATIENCE_S) == 50.25
    assert node.sdo[0x6402][1].raw == 50.25


def test_emergencies(network: canopen.Network) -> None:
    node = network[CONTROLLER]
    wait_for(lambda: node.sdo[0x1001].raw == 0)  # it was started before there was a plant
    network.send_message(0x320, b"\1\2")
    error = hear(node, Emcy.PDO_LENGTH)
    assert (error.register, error.data[:4]) == (0x11, bytes.fromhex("20 03 02 04"))
    assert node.sdo[0x1003][1].raw & 0xFFFF == Emcy.PDO_LENGTH
    network.send_message(0x320, struct.pack("<f", 50.0))
    assert hear(node, Emcy.ERROR_GONE).register == 0
    assert node.sdo[0x1001].raw == 0
    node.sdo[0x1003][0].raw = 0
    assert node.sdo[0x1003][0].raw == 0


def test_a_node_that_is_watched_and_falls_silent(network: canopen.Network) -> None:
    node = network[CONTROLLER]
    node.sdo[0x1016][1].raw = TUNER_NODE << 16 | 300
    second = node.object_dictionary[0x1016][2]
    assert refused(node, second, struct.pack("<I", TUNER_NODE << 16 | 500)) == Abort.INCOMPATIBLE
    network.send_message(0x700 + TUNER_NODE, b"\5")
    assert hear(node, Emcy.HEARTBEAT_LOST).data[0] == TUNER_NODE
    assert node.sdo[0x2002].raw == NmtState.OPERATIONAL, "1029h: control goes on"
