"""PDO parameters (1400h ff.) of both devices, per channel. The mapping is fixed, because struct packs the frames."""

from __future__ import annotations

from collections.abc import Iterator

from loopwright.protocol.objects import Device, Object, Shape, Type, lookup
from loopwright.protocol.profile import CONTROLLER_NODE, PLANT_NODE, channel_ids, renewal_id

_ON_SYNC = 1
_ON_ARRIVAL_OR_CHANGE = 255
_RPDO, _TPDO = 0x1400, 0x1800
_RENEWAL_SLOT = 0x1FF
"""Slot of the renewal's RPDO, after the PDOs of the last channel."""
_NO_REMOTE_REQUEST = 1 << 30
"""Bit of the COB-ID of a transmitted PDO: remote requests for it are not answered."""


def pdo_objects(
    device: Device, channels: int, plant_node: int = PLANT_NODE, controller_node: int = CONTROLLER_NODE
) -> Iterator[Object]:
    """Yields communication and mapping parameters of every PDO of the device.

    Channel 1 of the controller has RPDO1 PV, RPDO2 command, TPDO2 MV, TPDO3 status (TPDO1, analogue inputs in CiA 404,
    is left out: the device measures nothing); channel k has RPDO 2k-1, 2k and TPDO 2k, 2k+1. Channel k of the plant has
    RPDO k and TPDO k. RPDO512 of the controller renews the lease of a session on any channel.
    """
    if device is Device.CONTROLLER:
        renewal = ("controller_renewal_session", "controller_renewal_channel")
        cob_id = renewal_id(controller_node)
        yield from _pdo(_RPDO + _RENEWAL_SLOT, cob_id, _ON_ARRIVAL_OR_CHANGE, 0, renewal, True)
    for channel in range(1, channels + 1):
        ids = channel_ids(channel, plant_node, controller_node)
        own = channel == 1
        if device is Device.PLANT:
            slot = channel - 1
            yield from _pdo(_RPDO + slot, ids.mv, _ON_SYNC, channel, ("plant_mv", "plant_output_sample_number"), False)
            yield from _pdo(_TPDO + slot, ids.pv, _ON_SYNC, channel, ("plant_pv", "sample_number"), own)
        else:
            slot = 2 * (channel - 1)
            event = _ON_ARRIVAL_OR_CHANGE
            yield from _pdo(_RPDO + slot, ids.pv, event, channel, ("controller_received_pv", "sample_number"), False)
            yield from _pdo(_RPDO + slot + 1, ids.command, event, channel, ("controller_setpoint",), own)
            yield from _pdo(_TPDO + slot + 1, ids.mv, event, channel, ("controller_mv", "sample_number"), own)
            status = (
                "controller_mode", "controller_on_trial", "controller_setpoint", "controller_session_is_open",
                "controller_cause",
            )  # fmt: skip
            yield from _pdo(_TPDO + slot + 2, ids.status, event, channel, status, own)


def _pdo(index: int, cob_id: int, kind: int, channel: int, mapped: tuple[str, ...], own: bool) -> Iterator[Object]:
    label = f"{'RPDO' if index < _TPDO else 'TPDO'}{(index & 0x1FF) + 1}"
    owner = lookup(mapped[0]).device
    cob_id |= _NO_REMOTE_REQUEST if index >= _TPDO else 0
    yield Object(
        f"{label.lower()}_communication",
        index,
        Type.U32,
        "ro",
        f"{label} communication parameter",
        owner,
        Shape.ENTRIES,
        names=("COB-ID", "Transmission type"),
        types=(Type.U32, Type.U8),
        defaults=(cob_id, kind),
        relative=(1,) if own else (),
        is_record=True,
    )
    yield Object(
        f"{label.lower()}_mapping",
        index + 0x200,
        Type.U32,
        "ro",
        f"{label} mapping parameter",
        owner,
        Shape.ENTRIES,
        names=tuple(f"Mapped object {number}" for number in range(1, len(mapped) + 1)),
        defaults=tuple(_mapping(lookup(name), channel) for name in mapped),
        is_record=True,
    )


def _mapping(entry: Object, channel: int) -> int:
    """Returns index, sub-index and length in bits, packed as in CiA 301."""
    sub = channel if entry.shape is Shape.CHANNELS else 0
    return entry.index << 16 | sub << 8 | 8 * entry.type.size
