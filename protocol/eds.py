"""EDS files (CiA 306) of both devices, written from the object table. The committed files describe one channel.

python -m loopwright.protocol.eds plant [CHANNELS]          prints one
python -m loopwright.protocol.eds --write                   writes protocol/eds_files/
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

from loopwright.protocol.objects import Device, Object, Shape, Type, default_of, lookup, objects_of
from loopwright.protocol.pdos import pdo_objects
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, REVISION

FILES = {Device.PLANT: "loopwright_plant.eds", Device.CONTROLLER: "loopwright_controller.eds"}
FOLDER = Path(__file__).parent / "eds_files"

_NODE = {Device.PLANT: PLANT_NODE, Device.CONTROLLER: CONTROLLER_NODE}
_VAR, _ARRAY, _RECORD = 0x7, 0x8, 0x9
_MANDATORY = (0x1000, 0x1001, 0x1018)
_MODIFIED = "11-22-2026"
"""Date of the last change, month first. It is edited together with the revision: a date of generation would make every
file differ."""
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)


def eds(device: Device, channels: int = 1) -> str:
    """Returns the text of the EDS file; equal tables give equal texts (no date of generation)."""
    table = sorted(chain(objects_of(device), pdo_objects(device, channels)), key=lambda entry: entry.index)
    mandatory = [entry for entry in table if entry.index in _MANDATORY]
    manufacturer = [entry for entry in table if 0x2000 <= entry.index < 0x6000]
    optional = [entry for entry in table if entry not in mandatory and entry not in manufacturer]
    lines = list(_head(device, table))
    for title, group in (("Mandatory", mandatory), ("Optional", optional), ("Manufacturer", manufacturer)):
        lines += ["", f"[{title}Objects]", f"SupportedObjects={len(group)}"]
        lines += [f"{number}=0x{entry.index:04X}" for number, entry in enumerate(group, start=1)]
        for entry in group:
            lines += _object(entry, device, channels)
    return "\n".join(lines) + "\n"


def _head(device: Device, table: Sequence[Object]) -> Iterator[str]:
    receive = sum(1 for entry in table if 0x1400 <= entry.index < 0x1600)
    transmit = sum(1 for entry in table if 0x1800 <= entry.index < 0x1A00)
    vendor, product, revision = (default_of(lookup("identity"), sub, device) for sub in (1, 2, 3))
    yield from (
        "[FileInfo]",
        f"FileName={FILES[device]}",
        f"FileVersion={REVISION >> 16}",
        f"FileRevision={REVISION & 0xFFFF}",
        "EDSVersion=4.0",
        f"Description=Loopwright {device.value}",
        "CreationTime=12:00AM",
        "CreationDate=01-01-2026",
        "CreatedBy=protocol.eds",
        "ModificationTime=12:00AM",
        f"ModificationDate={_MODIFIED}",
        "ModifiedBy=protocol.eds",
        "",
        "[DeviceInfo]",
        "VendorName=Loopwright (vendor-ID 0 is for tests)",
        f"VendorNumber=0x{vendor:X}",
        f"ProductName=Loopwright {device.value}",
        f"ProductNumber=0x{product:X}",
        f"RevisionNumber=0x{revision:X}",
        f"OrderCode=loopwright-{device.value}",
        *(f"BaudRate_{rate}=1" for rate in _BIT_RATES),
        "SimpleBootUpMaster=0",
        "SimpleBootUpSlave=1",
        "Granularity=0",
        "DynamicChannelsSupported=0",
        "GroupMessaging=0",
        f"NrOfRXPDO={receive}",
        f"NrOfTXPDO={transmit}",
        "LSS_Supported=0",
        "",
        "[DummyUsage]",
        *(f"Dummy{number:04d}=0" for number in range(1, 8)),
        "",
        "[Comments]",
        "Lines=0",
    )


def _object(entry: Object, device: Device, channels: int) -> Iterator[str]:
    section = f"{entry.index:04X}"
    if entry.shape is Shape.VAR:
        yield from _variable(entry, section, entry.text, 0, device)
        return
    count = entry.count(channels)
    kind = _RECORD if entry.is_record else _ARRAY
    yield from ("", f"[{section}]", f"ParameterName={entry.text}", f"ObjectType=0x{kind:X}")
    yield f"SubNumber=0x{count + 1:X}"
    yield from (
        "",
        f"[{section}sub0]",
        "ParameterName=Highest sub-index supported",
        f"ObjectType=0x{_VAR:X}",
        f"DataType=0x{Type.U8.number:04X}",
        *_count_of(entry, count),
        "PDOMapping=0",
    )
    for sub in range(1, count + 1):
        name = entry.names[sub - 1] if entry.names else f"{entry.text} {sub}"
        yield from _variable(entry, f"{section}sub{sub:X}", name, sub, device)


def _variable(entry: Object, section: str, name: str, sub: int, device: Device) -> Iterator[str]:
    """Yields the lines of one entry. Write-only and optional entries get no default. A REAL32 gets neither default nor
    limits: readers of EDS files disagree on whether such a number is a decimal or the bits of a float, and some refuse
    writes for it. The device enforces its limits all the same."""
    data_type = entry.type_of(sub)
    limits = ("LowLimit", entry.low), ("HighLimit", entry.high)
    yield from ("", f"[{section}]", f"ParameterName={name}", f"ObjectType=0x{_VAR:X}")
    yield f"DataType=0x{data_type.number:04X}"
    yield f"AccessType={_access(entry)}"
    if entry.readable and not entry.counted and data_type is not Type.REAL32:
        yield f"DefaultValue={_default(entry, sub, device)}"
    yield f"PDOMapping={int(bool(entry.pdo))}"
    if data_type is not Type.REAL32:
        yield from (f"{key}={limit:.0f}" for key, limit in limits if limit is not None)


def _count_of(entry: Object, count: int) -> tuple[str, str]:
    """Returns access and default of sub-index 0."""
    return ("AccessType=rw", "DefaultValue=0") if entry.counted else ("AccessType=const", f"DefaultValue={count}")


def _access(entry: Object) -> str:
    """Returns the access type; `rww` and `rwr` say which kind of PDO a rw object may be mapped to, where it is only
    one."""
    if entry.access == "rw" and entry.pdo == "R":
        return "rww"
    if entry.access == "rw" and entry.pdo == "T":
        return "rwr"
    return entry.access


def _default(entry: Object, sub: int, device: Device) -> str:
    value = default_of(entry, sub, device)
    if sub in entry.relative:
        base = int(value) if entry.shape is Shape.VAR else int(value) - _NODE[device]
        return f"$NODEID+0x{base:X}"
    if isinstance(value, int) and entry.type_of(sub) is Type.U32 and value > 0xFFFF:
        return f"0x{value:X}"
    return str(value)


def main(arguments: Iterable[str]) -> None:
    first, *rest = [*arguments, ""]
    if first == "--write":
        for device, name in FILES.items():
            (FOLDER / name).write_text(eds(device), encoding="ascii", newline="\n")
    elif first in (device.value for device in FILES):
        print(eds(Device(first), int(rest[0] or 1)), end="")
    else:
        print(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
