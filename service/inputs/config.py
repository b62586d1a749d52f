"""The file loops.yaml: the loops, their addresses on the bus, and the limits of a retune.

All errors of a file are reported together, so that its author need not load it again for each mistake. A number in
quotes is a number here: to YAML 1.1 `1e-3`, without a point, is a text. `yes`, `on` and `true` are none.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from loopwright.service.inputs.plausible import Positive, SetpointWeight, Size, Time, Value, check_step, not_bool
from loopwright.service.inputs.validation import did_you_mean, listed, words
from loopwright.service.inputs.webhooks import WebhookConfig, repeated_names

if TYPE_CHECKING:
    from loopwright.service.inputs.yaml_file import Place

Whole = Annotated[int, BeforeValidator(not_bool)]
Node = Annotated[Whole, Field(ge=1, le=127)]
ExcitationName = Literal["observe", "setpoint", "relay", "manual"]
DirectionName = Literal["both", "up", "down"]
Tag = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]

_BUS_KINDS = ("socketcan", "socketcand", "virtual", "pcan", "kvaser", "ixxat", "vector", "slcan", "gs_usb")


class ConfigError(Exception):
    """The file cannot be used; `problems` holds every error found, one line each."""

    def __init__(self, source: str, problems: Sequence[str]) -> None:
        super().__init__(listed(source, len(problems), problems))
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
    setpoint_weight_max: the largest set-point weight b that gains are designed with; None: what a request says, or 1.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    tag: Tag
    description: str = ""
    bus: str
    controller_node: Node
    plant_node: Node | None = None
    channel: Whole = Field(default=1, ge=1, le=199)
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
    setpoint_weight_max: SetpointWeight | None = None
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

    at_once: Whole = Field(default=8, ge=1, le=1000)
    listen: bool = True


@dataclass(frozen=True)
class Site:
    """The content of a configuration file: the loops by tag, the settings of the buses that it names, and webhooks."""

    loops: dict[str, LoopConfig]
    buses: dict[str, BusConfig]
    webhooks: tuple[WebhookConfig, ...] = ()

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


def load_site(path: Path) -> Site:
    """Reads the site from a file. Raises ConfigError with all errors of the file."""
    from loopwright.service.inputs.yaml_file import NotYaml, YamlFile  # a rehearsal needs no YAML

    try:
        file = YamlFile(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(str(path), [error.strerror or str(error)]) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), [f"not YAML: {error}"]) from error
    except NotYaml as error:
        raise ConfigError(str(path), [str(error)]) from error
    except RecursionError:
        raise ConfigError(str(path), ["not a list of loops: nested too deeply"]) from None
    return parse_site(file.document, str(path), file.line_of)


def parse_site(document: object, source: str, line_of: Callable[[Place], int] | None = None) -> Site:
    """The site of a parsed document `{"loops": [...], "buses": {BUS: {"at_once": ...}}, "webhooks": [...]}`.

    line_of: the line of the file that a place of the document is on; None for a document that was in no file.
    """
    if not isinstance(document, dict) or not isinstance(entries := document.get("loops"), list) or not entries:
        raise ConfigError(source, ["expected a list of loops under the key 'loops'"])
    problems = _Problems(line_of)
    for key in document:
        if key not in _KEYS:
            problems.add((key,), str(key), f"unknown name{did_you_mean(str(key), _KEYS)}")
    loops: dict[int, LoopConfig] = {}
    for number, entry in enumerate(entries):
        try:
            loops[number] = LoopConfig.model_validate(entry)
        except ValidationError as error:
            for each in error.errors(include_url=False):
                name, tag = ".".join([f"loops[{number}]", *map(str, each["loc"])]), _tag(entry)
                problems.add(
                    ("loops", number, *each["loc"]), f"{name} ({tag})" if tag else name, words(each, _LOOP_NAMES)
                )
    problems.add_repeated("tag", {number: _tag(entry) for number, entry in enumerate(entries)})
    problems.add_repeated(
        "channel",
        {n: f"{loop.bus} node {loop.controller_node} channel {loop.channel}" for n, loop in loops.items()},
    )
    named = {bus for entry in entries if isinstance(entry, dict) and isinstance(bus := entry.get("bus"), str)}
    buses = _buses(document.get("buses") or {}, named, problems)
    webhooks = _webhooks(document.get("webhooks") or [], problems)
    if problems.found:
        raise ConfigError(source, problems.in_order())
    return Site({loop.tag: loop for loop in loops.values()}, buses, webhooks)


_KEYS = ("loops", "buses", "webhooks")
_LOOP_NAMES = sorted({name for kind in (LoopConfig, PermittedTest, Limits) for name in kind.model_fields})


class _Problems:
    """The errors of a file, each with its place."""

    def __init__(self, line_of: Callable[[Place], int] | None) -> None:
        self.found: list[tuple[int, str]] = []
        self._line_of = line_of

    def add(self, place: Place, name: str, text: str) -> None:
        """Adds one error.

        name: how the place is called in the message.
        """
        line = 0 if self._line_of is None else self._line_of(place)
        self.found.append((line, f"{f'line {line}: ' if line else ''}{name}: {text}"))

    def add_repeated(self, what: str, values: Mapping[int, str | None]) -> None:
        """Adds an error for each value that several loops have in common.

        values: the value by the number of the loop; None for a loop without one.
        """
        loops = defaultdict(list)
        for number, value in values.items():
            if value is not None:
                loops[value].append(number)
        for value, numbers in loops.items():
            if len(numbers) > 1:
                by = ", ".join(f"loops[{number}]" for number in numbers)
                self.add(("loops", numbers[-1], what), f"{what} {value!r}", f"it is used by {len(numbers)} loops: {by}")

    def in_order(self) -> list[str]:
        """Returns the errors in the order of the file."""
        return [text for _, text in sorted(self.found, key=lambda each: each[0])]


def _buses(entries: object, known: set[str], problems: _Problems) -> dict[str, BusConfig]:
    if not isinstance(entries, dict):
        problems.add(("buses",), "buses", "expected a mapping from the name of a bus to its settings")
        return {}
    found = {}
    for bus, entry in entries.items():
        if bus not in known:
            text = f"no loop is on this bus{did_you_mean(str(bus), sorted(known))}"
            problems.add(("buses", bus), f"buses.{bus}", text)
        try:
            found[bus] = BusConfig.model_validate(entry)
        except ValidationError as error:
            for each in error.errors(include_url=False):
                name = ".".join(["buses", str(bus), *map(str, each["loc"])])
                problems.add(("buses", bus, *each["loc"]), name, words(each, sorted(BusConfig.model_fields)))
    return found


def _webhooks(entries: object, problems: _Problems) -> tuple[WebhookConfig, ...]:
    if not isinstance(entries, list):
        problems.add(("webhooks",), "webhooks", "expected a list of webhooks")
        return ()
    found = []
    for number, entry in enumerate(entries):
        try:
            found.append(WebhookConfig.model_validate(entry))
        except ValidationError as error:
            for each in error.errors(include_url=False, include_input=False):
                name = ".".join([f"webhooks[{number}]", *map(str, each["loc"])])
                place = ("webhooks", number, *each["loc"])
                problems.add(place, name, words(each, sorted(WebhookConfig.model_fields)))
    for name in repeated_names(found):
        problems.add(("webhooks",), "webhooks", f"name {name!r} is used by several webhooks")
    return tuple(found)


def _tag(entry: object) -> str | None:
    tag = entry.get("tag") if isinstance(entry, dict) else None
    return tag if isinstance(tag, str) else None
