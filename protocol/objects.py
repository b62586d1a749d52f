"""The object dictionary of both devices as one table: EDS files, checks on writes and every look-up come from it.

Objects 2000h-5FFFh are manufacturer-specific and not claimed to be standard. 1000h-1FFFh follow CiA 301;
6000h-9FFFh have the index and meaning that are publicly known of CiA 404.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from loopwright.protocol.profile import REVISION, SYNC_COUNTER_OVERFLOW, SYNC_ID, Order

Value = int | float | str


class Type(Enum):
    """The data types by their CANopen number (CiA 301) and struct format."""

    BOOLEAN = (0x1, "<B")
    U8 = (0x5, "<B")
    U16 = (0x6, "<H")
    U32 = (0x7, "<I")
    REAL32 = (0x8, "<f")
    STRING = (0x9, "")

    @property
    def number(self) -> int:
        return self.value[0]

    @property
    def format(self) -> str:
        return self.value[1]

    @property
    def size(self) -> int:
        """Returns the number of bytes; 0 for strings."""
        return struct.calcsize(self.value[1])

    def encode(self, value: Value) -> bytes:
        """Returns the bytes of a value, little-endian."""
        if isinstance(value, str):
            return value.encode("ascii")
        return struct.pack(self.format, value if self is Type.REAL32 else int(value))

    def decode(self, data: bytes) -> Value:
        """Returns the value of these bytes. Raises struct.error when the length does not fit."""
        if self is Type.STRING:
            return data.decode("ascii", "replace")
        value: int | float = struct.unpack(self.format, data)[0]
        return value


class Device(Enum):
    """The device, or devices, that have an object."""

    PLANT = "plant"
    CONTROLLER = "controller"
    BOTH = "both"


class Shape(Enum):
    """The arrangement of an object's sub-indices."""

    VAR = "var"
    """The object has one value, at sub-index 0."""
    CHANNELS = "channels"
    """Sub-index k belongs to channel k."""
    ENTRIES = "entries"
    """The object has a fixed number of entries, listed in `names`."""


@dataclass(frozen=True, slots=True)
class Object:
    """One entry of the object dictionary.

    low, high: EDS limits, enforced by the devices; None for no limit.
    pdo: T where the object may be sent in a PDO, R where it may be received in one.
    """

    name: str
    index: int
    type: Type
    access: str
    text: str
    device: Device
    shape: Shape = Shape.VAR
    pdo: str = ""
    default: Value = 0
    low: float | None = None
    high: float | None = None
    unit: str = ""
    """Unit of the value, for readers of this table: EDS files have no field for it."""
    names: tuple[str, ...] = ()
    """Names of the entries; sub-index 0 returns their number."""
    types: tuple[Type, ...] = ()
    """Types of the entries where they differ."""
    defaults: tuple[Value, ...] = ()
    by_pdo: bool = False
    """Whether only PDOs write the object; an SDO write is refused as not possible in the present state."""
    counted: bool = False
    """Whether sub-index 0 holds the present number of entries, and may be written."""
    relative: tuple[int, ...] = ()
    """Sub-indices whose default depends on the node-ID (COB-IDs); the EDS marks them."""
    is_record: bool = False

    def type_of(self, sub: int) -> Type:
        if sub == 0 and self.shape is not Shape.VAR:
            return Type.U8
        return self.types[sub - 1] if self.types else self.type

    def default_of(self, sub: int) -> Value:
        return self.defaults[sub - 1] if self.defaults and sub > 0 else self.default

    def count(self, channels: int) -> int:
        """Returns the highest sub-index on a device with this number of channels."""
        return {Shape.VAR: 0, Shape.CHANNELS: channels, Shape.ENTRIES: len(self.names)}[self.shape]

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access in ("rw", "wo")


BOTH, PLANT, CONTROLLER = Device.BOTH, Device.PLANT, Device.CONTROLLER
BOOLEAN, U8, U16, U32, REAL32, STRING = Type.BOOLEAN, Type.U8, Type.U16, Type.U32, Type.REAL32, Type.STRING
VAR, CHANNELS, ENTRIES = Shape.VAR, Shape.CHANNELS, Shape.ENTRIES

DEGREE_CELSIUS = 0x002D0000
SECOND = 0x00030000
_IDENTITY = ("Vendor-ID", "Product code", "Revision number", "Serial number")

# Vendor-ID 0 is for tests; CiA assigns real ones.
# An object takes one line or two: with a line for each of its fields the table could not be read.
# fmt: off
_COMMUNICATION = (
    Object("device_type", 0x1000, U32, "ro", "Device type", BOTH),
    Object("error_register", 0x1001, U8, "ro", "Error register", BOTH, pdo="T"),
    Object("error_field", 0x1003, U32, "ro", "Pre-defined error field", BOTH, ENTRIES,
           names=("Error 1", "Error 2", "Error 3", "Error 4"), counted=True),
    Object("sync_cob_id", 0x1005, U32, "ro", "COB-ID SYNC", BOTH, default=0x80),
    Object("sample_time", 0x1006, U32, "rw", "Communication cycle period", BOTH, default=100_000,
           low=100, high=3_600_000_000, unit="us"),
    Object("device_name", 0x1008, STRING, "const", "Manufacturer device name", BOTH),
    Object("hardware_version", 0x1009, STRING, "const", "Manufacturer hardware version", BOTH, default="simulated"),
    Object("software_version", 0x100A, STRING, "const", "Manufacturer software version", BOTH, default="0.1.0"),
    Object("emcy_cob_id", 0x1014, U32, "ro", "COB-ID EMCY", BOTH, default=0x80, relative=(0,)),
    Object("heartbeat_consumer", 0x1016, U32, "rw", "Consumer heartbeat time", BOTH, ENTRIES,
           names=("First node watched", "Second node watched")),
    Object("heartbeat_producer", 0x1017, U16, "rw", "Producer heartbeat time", BOTH, default=500,
           unit="ms"),
    Object("identity", 0x1018, U32, "ro", "Identity object", BOTH, ENTRIES, names=_IDENTITY,
           defaults=(0, 0, REVISION, 0), is_record=True),
    Object("sync_counter_overflow", 0x1019, U8, "ro", "Synchronous counter overflow value", BOTH,
           default=SYNC_COUNTER_OVERFLOW),
    # 1: no change of the NMT state. Control goes on when a supervised node falls silent.
    Object("error_behaviour", 0x1029, U8, "const", "Error behaviour", BOTH, ENTRIES, names=("Communication error",),
           default=1),
    # 0: the device becomes operational by itself. Control does not wait for a master.
    Object("nmt_startup", 0x1F80, U32, "ro", "NMT startup", BOTH),
    Object("sample_number", 0x2000, U32, "rw", "Sample number", BOTH, pdo="TR", by_pdo=True),
    Object("node_state", 0x2002, U8, "ro", "NMT state, as the heartbeat carries it", BOTH, default=5),
)

_PLANT = (
    Object("plant_output_sample_number", 0x2001, U32, "rw", "Sample number of the output received", PLANT, pdo="R",
           by_pdo=True),
    Object("plant_pace", 0x2010, REAL32, "rw", "Pace (0 as fast as possible, 1 real time)", PLANT, default=1.0,
           low=0, high=1_000_000),
    Object("plant_samples_to_run", 0x2011, U32, "rw", "Samples to run (0 hold, FFFFFFFFh without end)", PLANT),
    Object("plant_missing_answers", 0x2012, U32, "ro", "Samples without an answer", PLANT, pdo="T"),
    Object("plant_answer_timeout", 0x2013, U16, "rw", "Answer time-out", PLANT, default=100, low=1, unit="ms"),
    Object("plant_on_missing_answer", 0x2014, U8, "rw", "On a missing answer (0 hold, 1 stop the run, 2 safe output)",
           PLANT, low=0, high=2),
    Object("plant_safe_output", 0x2015, REAL32, "rw", "Safe output", PLANT, CHANNELS, low=0, high=100, unit="%"),
    Object("plant_disturbance", 0x2022, REAL32, "rw", "Load disturbance", PLANT, CHANNELS, pdo="R",
           low=-1000, high=1000, unit="%"),
    Object("plant_noise", 0x2023, REAL32, "rw", "Measurement noise, standard deviation", PLANT, CHANNELS, low=0),
    Object("plant_seed", 0x2024, U32, "rw", "Random seed", PLANT, default=1),
    Object("plant_initialise", 0x2025, U8, "wo", "Initialise (1 = initial state, sample number 0)", PLANT,
           low=1, high=1),
    Object("plant_gain", 0x2026, REAL32, "rw", "Gain of the plant, in multiples of its own", PLANT, CHANNELS,
           default=1.0, low=0, high=1000),
    Object("plant_pv", 0x6130, REAL32, "ro", "AI input PV", PLANT, CHANNELS, pdo="T"),
    Object("plant_pv_unit", 0x6131, U32, "ro", "AI physical unit PV", PLANT, CHANNELS, default=DEGREE_CELSIUS),
    Object("plant_mv", 0x6300, REAL32, "rw", "AO output PV", PLANT, CHANNELS, pdo="R", low=0, high=100, unit="%"),
)

_SMALLEST_KP = 1e-9  # Kp is positive; the action of the controller is a separate object


def _gains(first_index: int, access: str, prefix: str, text: str) -> tuple[Object, ...]:
    """Returns the objects of Kp, Ti, Td, Tf, b, c in the ISA form. Ti = 0 means no integral action."""
    rows = (
        ("kp", "Kp", "%", _SMALLEST_KP, 1.0),
        ("ti", "Ti", "s", 0, 0.0),
        ("td", "Td", "s", 0, 0.0),
        ("tf", "Tf", "s", 0, 0.0),
        ("b", "set point weight b", "", None, 1.0),
        ("c", "set point weight c", "", None, 0.0),
    )
    return tuple(
        Object(f"controller_{prefix}_{name}", first_index + offset, REAL32, access, f"{text} {label}", CONTROLLER,
               CHANNELS, default=default, low=low, unit=unit)
        for offset, (name, label, unit, low, default) in enumerate(rows)
    )


_ORDERS = {
    Order.OPEN: "open the session",
    Order.CLOSE: "close the session",
    Order.SETPOINT: "set-point",
    Order.MODE: "mode",
    Order.OUTPUT: "manual output",
    Order.RELAY: "start the relay, or change it",
    Order.TRY: "gains on trial",
    Order.ACCEPT: "accept these gains",
    Order.WATCH: "end the session where PV leaves these limits",
    Order.HOLD: "hold the MV of the opening in manual, from now on and after the session",
}


def _session() -> tuple[Object, ...]:
    """Returns the objects that describe a channel's session, and those that hold the terms of the next one."""
    rows: tuple[tuple[str, Type, str, str, dict[str, Any]], ...] = (
        ("session_next", U32, "ro", "Number to open the next session with", {}),
        ("session", U32, "ro", "Number of the open session (0 none)", {}),
        ("session_last", U32, "ro", "Number of the session that ended last (0 none)", {}),
        ("cause", U8, "ro", "Why it ended", {"pdo": "T"}),
        ("outside_changes", U8, "ro",
         "Changed outside the session since the opening (1 SP, 2 mode, 4 output, 8 gains, 16 limits)", {}),
        ("session_count", U32, "ro", "Orders put in force in the session", {}),
        ("session_renewal", U32, "wo", "Renewal of the lease (number of the session)", {}),
        ("session_holder", U8, "ro", "Node-ID of the tuner that holds the session (0 none)", {}),
        ("session_is_open", U8, "ro", "Session (0 none, 1 open)", {"pdo": "T"}),
        ("session_tuner", U8, "rw", "Node-ID of the tuner, staged", {"default": 125, "low": 1, "high": 127}),
        ("session_lease_samples", U32, "rw", "Lease, staged", {"default": 100, "low": 1}),
        ("session_lease_ms", U32, "rw", "Lease by the controller's clock, staged",
         {"default": 3000, "low": 1, "unit": "ms"}),
        ("session_pv_silence_ms", U32, "rw", "Time without a valid PV that ends the session, staged",
         {"default": 1000, "low": 1, "unit": "ms"}),
        ("session_watch_ms", U32, "rw", "Time without the tuner's heartbeat that ends the session, staged",
         {"default": 1000, "low": 1, "unit": "ms"}),
        ("home_mode", U8, "ro", "Mode at the opening (manual after HOLD)", {}),
        ("home_setpoint", REAL32, "ro", "Set-point at the opening", {}),
        ("home_manual_output", REAL32, "ro", "Manual output at the opening (home MV after HOLD)", {"unit": "%"}),
        ("home_mv", REAL32, "ro", "MV at the opening", {"unit": "%"}),
    )
    return tuple(
        Object(f"controller_{name}", 0x2130 + at, kind, access, text, CONTROLLER, CHANNELS, **more)
        for at, (name, kind, access, text, more) in enumerate(rows)
    )


_CONTROLLER = (
    Object("controller_mode_command", 0x2100, U8, "rw", "Mode command (0 off, 1 manual, 2 automatic)", CONTROLLER,
           CHANNELS, default=2, low=0, high=2),
    Object("controller_mode", 0x2101, U8, "ro", "Mode in effect", CONTROLLER, CHANNELS, pdo="T", default=2),
    Object("controller_manual_output", 0x2102, REAL32, "rw", "Manual output", CONTROLLER, CHANNELS, pdo="R",
           low=0, high=100, unit="%"),
    Object("controller_mv_low", 0x2103, REAL32, "rw", "Output low limit", CONTROLLER, CHANNELS, low=0, high=100,
           unit="%"),
    Object("controller_mv_high", 0x2104, REAL32, "rw", "Output high limit", CONTROLLER, CHANNELS, default=100.0,
           low=0, high=100, unit="%"),
    Object("controller_received_pv", 0x2105, REAL32, "rw", "Received process value X", CONTROLLER, CHANNELS, pdo="R",
           by_pdo=True),
    Object("controller_safe_output", 0x2106, REAL32, "rw", "Safe output", CONTROLLER, CHANNELS, low=0, high=100,
           unit="%"),
    Object("controller_rate_limit", 0x2107, REAL32, "rw", "Output rate limit (0 none)", CONTROLLER, CHANNELS, low=0,
           unit="%/s"),
    Object("controller_pv_low", 0x2108, REAL32, "rw", "PV span low", CONTROLLER, CHANNELS),
    Object("controller_pv_high", 0x2109, REAL32, "rw", "PV span high", CONTROLLER, CHANNELS, default=100.0),
    Object("controller_action", 0x210A, U8, "rw", "Action (0 reverse, 1 direct)", CONTROLLER, CHANNELS, low=0, high=1),
    *_gains(0x2110, "rw", "staged", "Staged"),
    *_gains(0x2118, "ro", "accepted", "Accepted"),
    Object("controller_parameter_command", 0x2120, U8, "wo",
           "Parameter command (1 try staged, 2 accept, 3 go back)", CONTROLLER, CHANNELS, low=1, high=3),
    Object("controller_on_trial", 0x2121, U8, "ro", "Set in effect (0 accepted, 1 on trial)", CONTROLLER, CHANNELS,
           pdo="T"),
    Object("controller_accept_count", 0x2122, U32, "ro", "Accept counter", CONTROLLER, CHANNELS),
    Object("controller_pv_valid", 0x2123, U8, "ro", "PV is valid (0 no number, out of its span, or silent)", CONTROLLER,
           CHANNELS),
    *_session(),
    Object("controller_renewal_session", 0x2003, U32, "rw", "Renewal by PDO: number of the session", CONTROLLER,
           pdo="R", by_pdo=True),
    Object("controller_renewal_channel", 0x2004, U8, "rw", "Renewal by PDO: channel", CONTROLLER, pdo="R",
           by_pdo=True),
    *_gains(0x2142, "ro", "home", "Accepted at the opening:"),
    Object("controller_relay_amplitude", 0x2151, REAL32, "rw", "Relay amplitude, staged", CONTROLLER, CHANNELS,
           default=5.0, low=0, high=100, unit="%"),
    Object("controller_relay_hysteresis", 0x2152, REAL32, "rw", "Relay hysteresis, staged", CONTROLLER, CHANNELS,
           low=0),
    Object("controller_relay_working_output", 0x2153, REAL32, "rw", "Relay working output, staged", CONTROLLER,
           CHANNELS, default=50.0, low=0, high=100, unit="%"),
    Object("controller_relay_max_samples", 0x2154, U32, "rw", "Most samples the relay may take, staged", CONTROLLER,
           CHANNELS, default=6000, low=1),
    Object("controller_relay_pv_low", 0x2155, REAL32, "rw", "PV low limit of the relay, staged", CONTROLLER, CHANNELS),
    Object("controller_relay_pv_high", 0x2156, REAL32, "rw", "PV high limit of the relay, staged", CONTROLLER,
           CHANNELS, default=100.0),
    Object("controller_relay_amplitude_low", 0x2157, REAL32, "rw", "Relay amplitude of the low side, staged (0 same)",
           CONTROLLER, CHANNELS, low=0, high=100, unit="%"),
    Object("controller_relay_average", 0x2158, U8, "rw", "Samples whose mean switches the relay, staged", CONTROLLER,
           CHANNELS, default=1, low=1, high=100),
    Object("controller_relay_state", 0x2159, U8, "ro", "Relay state (0 idle, 1 running, 2 done, 3 limit)",
           CONTROLLER, CHANNELS, pdo="T"),
    *_gains(0x2160, "rw", "session", "Session"),
    Object("controller_session_setpoint", 0x2166, REAL32, "rw", "Set-point, staged", CONTROLLER, CHANNELS),
    Object("controller_session_mode", 0x2167, U8, "rw", "Mode, staged (0 off, 1 manual, 2 automatic)", CONTROLLER,
           CHANNELS, default=2, low=0, high=2),
    Object("controller_session_output", 0x2168, REAL32, "rw", "Manual output, staged", CONTROLLER, CHANNELS, low=0,
           high=100, unit="%"),
    Object("controller_session_pv_low", 0x2169, REAL32, "rw", "PV low limit of the session, staged", CONTROLLER,
           CHANNELS),
    Object("controller_session_pv_high", 0x216A, REAL32, "rw", "PV high limit of the session, staged", CONTROLLER,
           CHANNELS, default=100.0),
    *(
        Object(f"controller_order_{order.name.lower()}", 0x2170 + order, U32, "wo", f"Check of the order: {text}",
               CONTROLLER, CHANNELS)
        for order, text in _ORDERS.items()
    ),
    Object("controller_setpoint", 0x6402, REAL32, "rw", "CO set point W", CONTROLLER, CHANNELS, pdo="TR"),
    Object("controller_pv_unit", 0x6406, U32, "ro", "CO physical unit XW", CONTROLLER, CHANNELS,
           default=DEGREE_CELSIUS),
    Object("controller_mv", 0x6410, REAL32, "ro", "CO effective controller output Y", CONTROLLER, CHANNELS, pdo="T",
           unit="%"),
    Object("controller_on", 0x6422, BOOLEAN, "rw", "CO controller on/off", CONTROLLER, CHANNELS,
           default=1),
    Object("controller_proportional_band", 0x6450, REAL32, "ro", "CO proportional band Xp1", CONTROLLER, CHANNELS,
           unit="%"),
    Object("controller_ti", 0x6452, REAL32, "ro", "CO integral action time Tn1", CONTROLLER, CHANNELS, unit="s"),
    Object("controller_td", 0x6454, REAL32, "ro", "CO derivative action time Tv1", CONTROLLER, CHANNELS, unit="s"),
    Object("controller_cycle_time", 0x6456, REAL32, "ro", "CO cycle time T1", CONTROLLER, CHANNELS, unit="s"),
    Object("controller_time_unit", 0x6458, U32, "ro", "CO physical unit of the times", CONTROLLER, CHANNELS,
           default=SECOND),
)
# fmt: on

_SYNC_PRODUCER = 0x40000000

_OWN_DEFAULTS: dict[tuple[Device, str, int], Value] = {
    (PLANT, "device_type", 0): 0x000A0194,
    (CONTROLLER, "device_type", 0): 0x00100194,
    (PLANT, "device_name", 0): "Loopwright plant",
    (CONTROLLER, "device_name", 0): "Loopwright controller",
    (PLANT, "sync_cob_id", 0): _SYNC_PRODUCER | SYNC_ID,
}

OBJECTS: tuple[Object, ...] = _COMMUNICATION + _PLANT + _CONTROLLER

BY_NAME: dict[str, Object] = {entry.name: entry for entry in OBJECTS}


def lookup(name: str) -> Object:
    """Returns the object called `name`, for example "controller_mode_command". Raises KeyError."""
    return BY_NAME[name]


_OWN_OBJECTS: dict[tuple[Device, str], Object] = {
    (PLANT, "sample_number"): replace(BY_NAME["sample_number"], access="ro", pdo="T", by_pdo=False),
}
"""Objects that the two devices have in different ways: the plant sets the sample number, the controller receives it."""


def default_of(entry: Object, sub: int, device: Device) -> Value:
    """Returns the default of an object on this device; the two devices may have different defaults."""
    return _OWN_DEFAULTS.get((device, entry.name, sub), entry.default_of(sub))


def objects_of(device: Device) -> tuple[Object, ...]:
    """Returns the objects of the plant or the controller, sorted by index."""
    own = (_OWN_OBJECTS.get((device, entry.name), entry) for entry in OBJECTS if entry.device in (device, BOTH))
    return tuple(sorted(own, key=lambda entry: entry.index))
