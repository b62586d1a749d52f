"""The values of a device's object dictionary, with the checks of SDO writes."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from itertools import chain

from loopwright.protocol.objects import Device, Object, Shape, Type, Value, default_of, objects_of
from loopwright.protocol.pdos import pdo_objects
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, Abort
from loopwright.protocol.sdo import SdoAbort

Reader = Callable[[int], Value]
"""Function from a sub-index (the channel, for objects of a channel) to its value."""
Writer = Callable[[int, Value], None]
"""Function that takes a sub-index and a checked value; it raises SdoAbort to refuse. The value is stored afterwards."""


class Dictionary:
    """Holds values by name and sub-index. `on_read` and `on_write` connect an object with the device's functions."""

    def __init__(
        self, device: Device, channels: int, plant_node: int = PLANT_NODE, controller_node: int = CONTROLLER_NODE
    ) -> None:
        node = plant_node if device is Device.PLANT else controller_node
        table = chain(objects_of(device), pdo_objects(device, channels, plant_node, controller_node))
        self.by_index = {entry.index: entry for entry in table}
        self.channels = channels
        self.on_read: dict[str, Reader] = {}
        self.on_write: dict[str, Writer] = {}
        self._values: dict[tuple[str, int], Value] = {
            (entry.name, sub): default_of(entry, sub, device)
            for entry in self.by_index.values()
            for sub in range(0 if entry.shape is Shape.VAR else 1, entry.count(channels) + 1)
        }
        self.set("emcy_cob_id", 0x80 + node)
        self._start: dict[tuple[str, int], Value] = {}

    def get(self, name: str, sub: int = 0) -> Value:
        """Returns a value from inside the device, without calling `on_read`."""
        return self._values[name, sub]

    def set(self, name: str, value: Value, sub: int = 0) -> None:
        """Sets a value from inside the device, without checks and without calling `on_write`."""
        self._values[name, sub] = value

    def set_restore_values(self) -> None:
        """Notes the present values as those that `restore` sets."""
        self._start = dict(self._values)

    def restore(self, first: int, last: int) -> list[tuple[str, int]]:
        """Restores the objects with index `first` to `last`; returns name and sub-index of those that were different.
        It makes no checks and calls no `on_write`, as `set`."""
        names = {entry.name for index, entry in self.by_index.items() if first <= index <= last}
        changed = [key for key, value in self._start.items() if key[0] in names and self._values[key] != value]
        for key in changed:
            self._values[key] = self._start[key]
        return changed

    def read(self, index: int, sub: int) -> bytes:
        """Returns the bytes of an SDO upload. Raises SdoAbort."""
        entry = self._entry(index, sub)
        if entry.shape is not Shape.VAR and sub == 0 and not entry.counted:
            return Type.U8.encode(entry.count(self.channels))
        if not entry.readable:
            raise SdoAbort(Abort.WRITE_ONLY)
        reader = self.on_read.get(entry.name)
        value = reader(sub) if reader else self._values[entry.name, sub]
        try:
            return entry.type_of(sub).encode(value)
        except OverflowError:  # a double beyond the range of a REAL32
            return entry.type_of(sub).encode(math.copysign(math.inf, float(value)))

    def room(self, index: int, sub: int) -> int:
        """Returns how many bytes an SDO download must have, 0 for any number. Raises SdoAbort where nothing may be
        written."""
        return self._writable(index, sub).type_of(sub).size

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Carries out an SDO download; checks access, length, finiteness and limits, then asks the device. Raises
        SdoAbort."""
        entry = self._writable(index, sub)
        try:
            value = entry.type_of(sub).decode(data)
        except struct.error:
            raise SdoAbort(Abort.LENGTH) from None
        check_value(entry, value)
        writer = self.on_write.get(entry.name)
        if writer:
            writer(sub, value)
        self._values[entry.name, sub] = value

    def _writable(self, index: int, sub: int) -> Object:
        entry = self._entry(index, sub)
        if entry.shape is not Shape.VAR and sub == 0:
            if not entry.counted:
                raise SdoAbort(Abort.READ_ONLY)
        elif not entry.writable:
            raise SdoAbort(Abort.READ_ONLY)
        elif entry.by_pdo:
            raise SdoAbort(Abort.DEVICE_STATE)
        return entry

    def _entry(self, index: int, sub: int) -> Object:
        entry = self.by_index.get(index)
        if entry is None:
            raise SdoAbort(Abort.NO_OBJECT)
        if sub > entry.count(self.channels):
            raise SdoAbort(Abort.NO_SUBINDEX)
        return entry


def check_value(entry: Object, value: Value) -> None:
    """Raises SdoAbort for a value that is not finite or outside the limits of the table."""
    if isinstance(value, str):
        return
    if not math.isfinite(value) or (entry.type is Type.BOOLEAN and value > 1):
        raise SdoAbort(Abort.INVALID_VALUE)
    if entry.high is not None and value > entry.high:
        raise SdoAbort(Abort.TOO_HIGH)
    if entry.low is not None and value < entry.low:
        raise SdoAbort(Abort.TOO_LOW)
