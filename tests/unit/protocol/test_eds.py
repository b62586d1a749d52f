"""The committed EDS files against the table, and against what `canopen` reads out of them."""

from __future__ import annotations

import configparser
import subprocess
import sys
from itertools import chain
from pathlib import Path

import canopen
import pytest

from loopwright.protocol.eds import FILES, FOLDER, eds
from loopwright.protocol.object_dictionary import Dictionary
from loopwright.protocol.objects import OBJECTS, Device, Shape, Type, default_of, lookup, objects_of
from loopwright.protocol.pdos import pdo_objects
from loopwright.protocol.profile import CONTROLLER_NODE, MAX_CHANNELS, PLANT_NODE, REVISION, channel_ids

NODE = {Device.PLANT: PLANT_NODE, Device.CONTROLLER: CONTROLLER_NODE}
DEVICES = list(FILES)


@pytest.mark.parametrize("device", DEVICES)
def test_committed_file_is_what_the_table_gives(device: Device) -> None:
    assert (FOLDER / FILES[device]).read_text(encoding="ascii") == eds(device)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("device", DEVICES)
def test_a_reader_of_eds_files_finds_every_object(device: Device, channels: int, tmp_path: Path) -> None:
    path = tmp_path / "device.eds"
    path.write_text(eds(device, channels), encoding="ascii")
    dictionary = canopen.import_od(str(path), NODE[device])
    for entry in chain(objects_of(device), pdo_objects(device, channels)):
        found = dictionary[entry.index]
        first = 0 if entry.shape is Shape.VAR else 1
        for sub in range(first, entry.count(channels) + 1):
            variable = found if entry.shape is Shape.VAR else found.subindices[sub]
            assert variable.data_type == entry.type_of(sub).number
            assert (variable.readable, variable.writable) == (entry.readable, entry.writable), entry.name
            if entry.name != "emcy_cob_id":
                told = entry.readable and not entry.counted and entry.type_of(sub) is not Type.REAL32
                assert variable.default == (default_of(entry, sub, device) if told else None), entry.name
            limits = (entry.low, entry.high) if entry.type_of(sub) is not Type.REAL32 else (None, None)
            assert (variable.min, variable.max) == limits, entry.name
    assert dictionary[0x1014].default == 0x80 + NODE[device]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("device", DEVICES)
def test_a_checker_of_eds_files_has_nothing_to_say(device: Device, channels: int, tmp_path: Path) -> None:
    path = tmp_path / "device.eds"
    path.write_text(eds(device, channels), encoding="ascii")
    command = [Path(sys.executable).with_name("dcfchk"), "-n", str(NODE[device]), path]
    checked = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert (checked.returncode, checked.stdout + checked.stderr) == (0, "")


@pytest.mark.parametrize("device", DEVICES)
def test_who_made_it_is_what_the_device_says(device: Device) -> None:
    file = configparser.ConfigParser(interpolation=None)
    file.read_string(eds(device))
    identity = [int(file["DeviceInfo"][f"{key}Number"], 0) for key in ("Vendor", "Product", "Revision")]
    dictionary = Dictionary(device, 1)
    assert identity == [dictionary.get("identity", sub) for sub in (1, 2, 3)]
    assert identity[2] == REVISION
    assert all(file["DeviceInfo"].values()) and all(file["FileInfo"].values())


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("device", DEVICES)
def test_what_a_pdo_maps_may_be_mapped_that_way(device: Device, channels: int) -> None:
    """Received into what is written, sent from what is read; each of the length that the mapping says."""
    file = configparser.ConfigParser(interpolation=None)
    file.read_string(eds(device, channels))
    for mapping in pdo_objects(device, channels):
        if mapping.index & 0x200:
            allowed = ("rw", "rww") if mapping.index < 0x1800 else ("rw", "rwr", "ro", "const")
            for mapped in map(int, mapping.defaults):
                sub = f"sub{mapped >> 8 & 0xFF:X}" if mapped >> 8 & 0xFF else ""
                section = file[f"{mapped >> 16:04X}{sub}"]
                assert section["AccessType"] in allowed, section.name
                assert section["PDOMapping"] == "1"
                size = next(each.size for each in Type if each.number == int(section["DataType"], 0))
                assert 8 * size == mapped & 0xFF


def test_default_pdos_are_those_of_the_profile() -> None:
    controller = {entry.index: entry for entry in pdo_objects(Device.CONTROLLER, 1)}
    assert {index: entry.defaults[0] for index, entry in controller.items() if index & 0x200 == 0} == {
        0x1400: 0x190,
        0x1401: 0x320,
        0x15FF: 0x520,
        0x1801: 0x400002A0,
        0x1802: 0x400003A0,
    }
    assert controller[0x1A02].defaults == (0x21010108, 0x21210108, 0x64020120, 0x21380108, 0x21330108)
    plant = {entry.index: entry for entry in pdo_objects(Device.PLANT, 1)}
    assert plant[0x1800].defaults == (0x40000190, 1)
    assert plant[0x1600].defaults == (0x63000120, 0x20010020)


def test_names_and_indices_are_unique_per_device() -> None:
    assert len({entry.name for entry in OBJECTS}) == len(OBJECTS)
    for device in DEVICES:
        indices = [entry.index for entry in chain(objects_of(device), pdo_objects(device, MAX_CHANNELS))]
        assert len(set(indices)) == len(indices)


def test_lookup_by_name() -> None:
    assert lookup("controller_mode_command").index == 0x2100
    with pytest.raises(KeyError):
        lookup("no_such_object")


@pytest.mark.parametrize("nodes", [(PLANT_NODE, CONTROLLER_NODE), (0x01, 0x41)])
def test_every_channel_has_its_own_identifiers(nodes: tuple[int, int]) -> None:
    ids = [can_id for channel in range(1, MAX_CHANNELS + 1) for can_id in channel_ids(channel, *nodes)]
    assert len(set(ids)) == 4 * MAX_CHANNELS
    assert all(0x180 < can_id < 0x580 for can_id in ids)


@pytest.mark.parametrize("channel", [0, MAX_CHANNELS + 1])
def test_no_identifiers_beyond_the_channels(channel: int) -> None:
    with pytest.raises(ValueError, match="channel must be"):
        channel_ids(channel)
