"""The committed EDS files against the table, and against what `canopen` reads out of them."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import canopen
import pytest

from protocol.eds import FILES, FOLDER, eds
from protocol.objects import OBJECTS, Device, Shape, default_of, lookup, objects_of
from protocol.pdos import pdo_objects
from protocol.profile import CONTROLLER_NODE, MAX_CHANNELS, PLANT_NODE, channel_ids

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
                assert variable.default == pytest.approx(default_of(entry, sub, device)), entry.name
            if entry.high is not None:
                assert variable.max == entry.high, entry.name
    assert dictionary[0x1014].default == 0x80 + NODE[device]


def test_default_pdos_are_those_of_the_profile() -> None:
    controller = {entry.index: entry for entry in pdo_objects(Device.CONTROLLER, 1)}
    assert {index: entry.defaults[0] for index, entry in controller.items() if index & 0x200 == 0} == {
        0x1400: 0x190, 0x1401: 0x320, 0x1801: 0x2A0, 0x1802: 0x3A0,
    }
    assert controller[0x1A02].defaults == (0x21010108, 0x21210108, 0x64020120)
    plant = {entry.index: entry for entry in pdo_objects(Device.PLANT, 1)}
    assert plant[0x1800].defaults == (0x190, 1)
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
