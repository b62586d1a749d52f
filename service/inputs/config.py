"""The file loops.yaml: the loops, their addresses on the bus, and the limits of a retune.

All errors of a file are reported together, so that its author need not load it again for each mistake.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from loopwright.service.inputs.plausible import Positive, Size, Time, Value, check_step

Node = Annotated[int, Field(ge=1, le=127)]
ExcitationName = Literal["observe", "setpoint", "relay", "manual"]
DirectionName = Literal["both", "up", "down"]
Tag = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]

_BUS_KINDS = ("socketcan", "socketcand", "virtual", "pcan", "kvaser", "ixxat", "vector", "slcan", "gs_usb")


class ConfigError(Exception):
    """The file cannot be used; `problems` holds every error found, one line each."""

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        super().__init__("\n".join([f"{source}: {len(problems)} error(s)", *(f"  {p}" for p in problems)]))
        self.problems = list(problems)


class Limits(BaseModel):
    """A permitted range, low < high."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    low: Value
    high: Value

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low ({self.low:g}) must be less than high ({self.high:g})")
        return self


class PermittedTest(BaseModel):
    """What a test may do to a loop; a request may narrow it, not widen it.

    excitations: what method fast may learn the plant from: normal operation (observe), after which only the gains
    found are tried; pulses of the set-point under the present gains; the controller's relay. They are tried in this
    order, each where those before it tell too little. Of a loop in manual: pulses of its manual output (manual), and
    nothing else.
    mv_step_max: the largest jump of MV from one sample to the next, percent, of a test by any method; None: what
    mv_limits permit.
    directions: to which sides of its rest a test by any method moves the set-point, or PV by the manual output. A
    relay moves PV to both.
    sp_rate_max_per_s: the largest rate of the set-point, PV units per s of plant time, of a test by any method; None:
    the set-point is stepped.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    excitations: tuple[ExcitationName, ...] = Field(
        default=("relay",),
        min_length=1,
        description="What method fast may learn the plant from: normal operation (observe), after which only the gains "
        "found are tried, pulses of the set-point under the present gains, or the relay; of a loop in manual pulses of "
        "its manual output (manual), after which the gains are not tried",
        examples=[["setpoint", "relay"], ["observe", "setpoint", "relay", "manual"]],
    )
    mv_step_max: Positive | None = Field(
        default=None,
        description="The largest jump of MV that a test by any method makes from one sample to the next, percent; "
        "null: only the MV limits bound it",
        examples=[10.0],
    )
    directions: DirectionName = Field(
        default="both",
        description="To which sides of its rest a test moves the set-point; up and down exclude the relay",
        examples=["up"],
    )
    sp_rate_max_per_s: Positive | None = Field(
        default=None,
        description="The largest rate at which a test moves the set-point, PV units per s of plant time; null: it is "
        "stepped",
        examples=[0.02],
    )

    @field_validator("excitations")
    @classmethod
    def _once_each(cls, value: tuple[ExcitationName, ...]) -> tuple[ExcitationName, ...]:
        if len(set(value)) < len(value):
            raise ValueError(f"{', '.join(value)}: each excitation is named once")
        return value

    @model_validator(mode="after")
    def _to_one_side(self) -> Self:
        if self.directions != "both" and "relay" in self.excitations:
            raise ValueError(
                f"directions {self.directions} exclude the relay, which moves PV to both sides: name excitations "
                "without it, such as [setpoint]"
            )
        return self


class LoopConfig(BaseModel):
    """One loop. PV in `pv_unit`, MV in percent of the output range, times in plant seconds.

    setpoint_from: who moves the set-point in normal operation, an operator or (remote) another controller.
    outer_loop: the tag of that controller.
    test: what a test may do to the loop.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    tag: Tag
    description: str = ""
    bus: str
    controller_node: Node
    plant_node: Node | None = None
    channel: int = Field(default=1, ge=1, le=199)
    pv_unit: str = Field(min_length=1)
    mv_limits: Limits = Limits(low=0.0, high=100.0)
    pv_limits: Limits
    t95_s: Time
    sp_deviation: Positive
    noise_std_hint: Size | None = None
    setpoint_from: Literal["operator", "remote"] = "operator"
    outer_loop: Tag | None = None
    area: str | None = Field(default=None, min_length=1, max_length=64)
    test: PermittedTest = PermittedTest()
    notes: str = ""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        kind, colon, rest = self.bus.partition(":")
        if kind not in _BUS_KINDS or not colon or (not rest and kind != "virtual"):
            raise ValueError(f"bus {self.bus!r} is not of the form KIND:ADDRESS, e.g. socketcan:vcan0")
        if self.plant_node == self.controller_node:
            raise ValueError(f"plant_node and controller_node are both {self.controller_node}")
        if self.mv_limits.low < 0 or self.mv_limits.high > 100:
            raise ValueError("mv_limits must lie within 0..100 percent")
        if 2 * self.sp_deviation > self.pv_limits.high - self.pv_limits.low:
            raise ValueError(f"sp_deviation {self.sp_deviation:g} needs at least twice that between the pv_limits")
        check_step(self.sp_deviation, self.pv_limits.low, self.pv_limits.high)
        if self.outer_loop is not None and self.setpoint_from != "remote":
            raise ValueError(f"outer_loop {self.outer_loop} moves the set-point: add setpoint_from: remote")
        if self.outer_loop == self.tag:
            raise ValueError(f"outer_loop {self.outer_loop} is this loop itself")
        return self


class BusConfig(BaseModel):
    """The settings of a bus.

    at_once: maximum number of its loops that are tuned at the same time.
    listen: whether the process data of its loops are heard and kept as history.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    at_once: int = Field(default=8, ge=1, le=1000)
    listen: bool = True


@dataclass(frozen=True)
class Site:
    """The content of a configuration file: the loops by tag, and the settings of the buses that it names."""

    loops: dict[str, LoopConfig]
    buses: dict[str, BusConfig]

    def check_own_node(self, node: int, source: str) -> None:
        """Raises ConfigError when a device of the site has `node`, the node id of the service."""
        ours = [
            f"{loop.tag}: {name}_node is {node:#04x}, which is the service's own node id: start it with another --node"
            for loop in self.loops.values()
            for name, its in (("controller", loop.controller_node), ("plant", loop.plant_node))
            if its == node
        ]
        if ours:
            raise ConfigError(source, ours)


class _OnceEach(yaml.SafeLoader):
    """A YAML loader that refuses a duplicate key, of which PyYAML would silently use the last value.

    The loader looks for duplicates before keys are merged (`<<`), because a mapping may override merged keys.
    """

    def compose_mapping_node(self, anchor: dict[object, yaml.Node]) -> yaml.MappingNode:
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for name in (name for name, _ in node.value if isinstance(name, yaml.ScalarNode)):
            if name.value in seen:
                raise yaml.composer.ComposerError(None, None, f"{name.value!r} is given twice", name.start_mark)
            seen.add(name.value)
        return node


def load_site(path: Path) -> Site:
    """Reads the site from a file. Raises ConfigError with all errors of the file."""
    try:
        document = yaml.load(path.read_text(encoding="utf-8"), _OnceEach)
    except OSError as error:
        raise ConfigError(str(path), [error.strerror or str(error)]) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), [f"not YAML: {error}"]) from error
    except RecursionError:
        raise ConfigError(str(path), ["not a list of loops: nested too deeply"]) from None
    return parse_site(document, str(path))


def parse_site(document: object, source: str) -> Site:
    """The site of a parsed document `{"loops": [...], "buses": {BUS: {"at_once": ...}}}`."""
    if not isinstance(document, dict) or not isinstance(entries := document.get("loops"), list) or not entries:
        raise ConfigError(source, ["expected a list of loops under the key 'loops'"])
    problems = [f"{key}: unknown key" for key in document if key not in ("loops", "buses")]
    loops: list[LoopConfig] = []
    for number, entry in enumerate(entries):
        try:
            loops.append(LoopConfig.model_validate(entry))
        except ValidationError as error:
            problems += [_line(number, entry, e["loc"], e["msg"]) for e in error.errors(include_url=False)]
    problems += _repeated("tag", [_tag(entry) for entry in entries])
    problems += _repeated(
        "channel", [f"{loop.bus} node {loop.controller_node} channel {loop.channel}" for loop in loops]
    )
    buses = _buses(document.get("buses") or {}, {loop.bus for loop in loops}, problems)
    if problems:
        raise ConfigError(source, problems)
    return Site({loop.tag: loop for loop in loops}, buses)


def _buses(entries: object, known: set[str], problems: list[str]) -> dict[str, BusConfig]:
    if not isinstance(entries, dict):
        problems.append("buses: expected a mapping from the name of a bus to its settings")
        return {}
    found = {}
    for bus, entry in entries.items():
        if bus not in known:
            problems.append(f"buses.{bus}: no loop is on this bus")
        try:
            found[bus] = BusConfig.model_validate(entry)
        except ValidationError as error:
            problems += [f"buses.{bus}.{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
    return found


def _tag(entry: object) -> str | None:
    tag = entry.get("tag") if isinstance(entry, dict) else None
    return tag if isinstance(tag, str) else None


def _line(number: int, entry: object, where: tuple[int | str, ...], message: str) -> str:
    name = ".".join([f"loops[{number}]", *map(str, where)])
    tag = _tag(entry)
    return f"{name}{f' ({tag})' if tag else ''}: {message.removeprefix('Value error, ')}"


def _repeated(what: str, values: Sequence[str | None]) -> list[str]:
    counts = Counter(value for value in values if value is not None)
    return [f"{what} {value!r} is used by {n} loops" for value, n in counts.items() if n > 1]
