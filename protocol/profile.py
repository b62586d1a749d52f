"""The fieldbus profile: node-IDs, COB-IDs, frame layouts and code lists shared by plant, controller and tuner.

All values are little-endian. PV is in engineering units, MV in percent of the output range (0..100).
Plant time is `sample number * sample time`; a PV and the MV that answers it carry the same sample number.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from functools import cache
from struct import Struct
from typing import NamedTuple

PLANT_NODE = 0x10
CONTROLLER_NODE = 0x20
TUNER_NODE = 0x7D
"""Node-ID of a gateway unless another one is configured."""
MAX_CHANNELS = 199
REVISION = 0x00030000
"""Object 1018h:3 of both devices. The upper half counts changes of the behaviour on the bus, the lower half the
rest."""

NMT_ID = 0x000
SYNC_ID = 0x080
SYNC_COUNTER_OVERFLOW = 240
FOREVER = 0xFFFFFFFF
"""Value of 2011h (samples to run) that means "without end"."""

PV_FRAME = Struct("<fI")
"""Layout of a PV frame: PV REAL32, sample number U32."""
MV_FRAME = Struct("<fI")
"""Layout of a MV frame: MV REAL32 (percent), number U32 of the sample that it answers; with UNASKED it answers none,
and takes effect at once."""
UNASKED = 0
STATUS_FRAME = Struct("<BBfBB")
"""Layout of a status frame: mode U8, gain set in effect U8 (0 accepted, 1 on trial), set-point REAL32, session U8 (0
none, 1 open), cause U8."""
COMMAND_FRAME = Struct("<f")
"""Layout of a command frame: set-point REAL32."""
RENEWAL_FRAME = Struct("<IB")
"""Layout of a renewal frame: number U32 of the session whose lease is renewed, channel U8."""
SYNC_FRAME = Struct("<B")
NMT_FRAME = Struct("<BB")
"""Layout of an NMT frame: command U8, node-ID U8 (0 = all)."""
HEARTBEAT_FRAME = Struct("<B")
EMCY_FRAME = Struct("<HB5s")
"""Layout of an EMCY frame: error code U16, error register U8, five manufacturer-specific bytes."""


class Mode(IntEnum):
    """The modes of a controller channel (2101h)."""

    OFF = 0
    MANUAL = 1
    AUTOMATIC = 2
    EXPERIMENT = 3


class Cause(IntEnum):
    """Why a session ended (2133h)."""

    NONE = 0
    HEARTBEAT = 1
    LEASE = 2
    PV_LIMIT = 3
    CLOSED = 4
    NMT = 5
    NO_PV = 6
    RELAY_SAMPLES = 7
    OUTSIDE_CHANGE = 8
    HELD = 9
    """The tuner had ordered HOLD: whatever ended the session then, the channel is in manual at the MV of home."""


class OutsideChange(IntFlag):
    """The settings that were changed outside the session, by an operator or another master, since it was opened
    (2134h)."""

    NONE = 0
    SETPOINT = 1
    MODE = 2
    OUTPUT = 4
    GAINS = 8
    LIMITS = 16


class Order(IntEnum):
    """The orders of a tuner within its session; each has an object, 2170h + its number."""

    OPEN = 0
    CLOSE = 1
    SETPOINT = 2
    MODE = 3
    OUTPUT = 4
    RELAY = 5
    TRY = 6
    ACCEPT = 7
    WATCH = 8
    HOLD = 9


class ParameterCommand(IntEnum):
    """The commands of 2120h."""

    TRY = 1
    ACCEPT = 2
    GO_BACK = 3


class RelayState(IntEnum):
    """The states of a relay (2159h)."""

    IDLE = 0
    RUNNING = 1
    DONE = 2
    ENDED_BY_LIMIT = 3


class OnMissingAnswer(IntEnum):
    """The plant's action on a sample that the controller has not answered (2014h)."""

    HOLD_OUTPUT = 0
    STOP_RUN = 1
    SAFE_OUTPUT = 2


class NmtCommand(IntEnum):
    """The NMT commands of CiA 301."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """The NMT states as a heartbeat carries them."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Emcy(IntEnum):
    """The EMCY error codes that the devices send."""

    ERROR_GONE = 0x0000
    HEARTBEAT_LOST = 0x8130
    PDO_LENGTH = 0x8210
    NO_PV = 0x8250
    LEASE_USED_UP = 0xFF01
    PV_LIMIT = 0xFF02
    NO_ANSWER = 0xFF03
    TUNER_LOST = 0xFF04


EMCY_REGISTER = {
    Emcy.ERROR_GONE: 0x00,
    Emcy.HEARTBEAT_LOST: 0x11,
    Emcy.PDO_LENGTH: 0x11,
    Emcy.NO_PV: 0x11,
    Emcy.LEASE_USED_UP: 0x81,
    Emcy.PV_LIMIT: 0x81,
    Emcy.NO_ANSWER: 0x81,
    Emcy.TUNER_LOST: 0x91,
}
"""Error register (1001h) by error code: bit 0 generic, bit 4 communication, bit 7 manufacturer."""


class Abort(IntEnum):
    """The SDO abort codes that the devices use."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE_NUMBER = 0x05040003
    OUT_OF_MEMORY = 0x05040005
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    INCOMPATIBLE = 0x06040043
    LENGTH = 0x06070010
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    GENERAL = 0x08000000
    NOT_STORED = 0x08000020
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


def node_name(node: int) -> str:
    """Returns a node-ID as it stands on the bus and as it stands in most configurations: 20h (32)."""
    return f"{node:02X}h ({node})"


def samples_between(earlier: int, later: int) -> int:
    """Returns how many samples `later` comes after `earlier`; numbers wrap from FFFFFFFFh to 1, because 0 is UNASKED.

    A number that lies far behind (a plant that has restarted) gives a negative count.
    """
    passed = (later - earlier) % 0xFFFFFFFF
    return passed if passed < 0x80000000 else passed - 0xFFFFFFFF


def emcy_id(node: int) -> int:
    return 0x080 + node


def sdo_request_id(node: int) -> int:
    return 0x600 + node


def sdo_response_id(node: int) -> int:
    return 0x580 + node


def heartbeat_id(node: int) -> int:
    return 0x700 + node


def renewal_id(controller_node: int) -> int:
    """Returns the COB-ID of the renewals of all channels: that of the default RPDO4, which `channel_ids` never
    reaches."""
    return 0x500 + controller_node


class ChannelIds(NamedTuple):
    """The COB-IDs of one loop."""

    pv: int
    mv: int
    status: int
    command: int


@cache
def channel_ids(channel: int, plant_node: int = PLANT_NODE, controller_node: int = CONTROLLER_NODE) -> ChannelIds:
    """Returns the COB-IDs of channel 1..199.

    Channel 1 has the default PDOs of its two nodes. The other channels take 181h..57Fh without those four, in channel
    order: first all PV, then all MV, status, command. So an ID depends on the channel alone and not on the number of
    channels, and a measurement wins arbitration over an output.
    Raises ValueError.
    """
    if not 1 <= channel <= MAX_CHANNELS:
        raise ValueError(f"channel must be 1..{MAX_CHANNELS}, not {channel}")
    first = ChannelIds(0x180 + plant_node, 0x280 + controller_node, 0x380 + controller_node, 0x300 + controller_node)
    if channel == 1:
        return first
    free = [cob_id for cob_id in range(0x181, 0x580) if cob_id not in first]
    per_direction = MAX_CHANNELS - 1
    return ChannelIds(*(free[direction * per_direction + channel - 2] for direction in range(4)))
