"""A loop's state and gains: compared as the bus lets them be compared, and as a job's JSON, and back."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from loopwright.protocol.real32 import same
from loopwright.service.errors import Conflict
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode

OPERATIONAL = "operational"


@dataclass(frozen=True, slots=True)
class LoopState:
    """What a loop is and must come back to. MV and PV in the loop's units, limits as the controller holds them.

    gains: of a live loop the accepted ones, those that a trial ends with.
    node_state: operational, or the state in which a node of the loop controls nothing.
    when_silent: what the plant's I/O does when the controller falls silent ("holds MV where it is"); empty: not known.
    """

    mode: Mode
    sp: float
    pv: float
    mv: float
    gains: Gains
    on_trial: bool
    mv_low: float
    mv_high: float
    sample_time_s: float
    reverse_acting: bool
    manual_output: float = 0.0
    node_state: str = OPERATIONAL
    when_silent: str = ""


def differences(state: LoopState, home: LoopState) -> dict[str, str]:
    """In what the loop is not as it was, each in words."""
    pairs = (
        ("mode", state.mode.name.lower(), home.mode.name.lower(), state.mode is home.mode),
        ("set-point", f"{state.sp:.6g}", f"{home.sp:.6g}", same(state.sp, home.sp)),
        ("gains", state.gains, home.gains, same_gains(state.gains, home.gains)),
        ("trial", state.on_trial, home.on_trial, state.on_trial == home.on_trial),
    )
    found = {name: f"{name} is {is_}, was {was}" for name, is_, was, equal in pairs if not equal}
    if home.mode is Mode.MANUAL and not same(state.manual_output, home.manual_output):
        found["output"] = f"manual output is {state.manual_output:.6g}, was {home.manual_output:.6g}"
    return found


def same_gains(one: Gains, other: Gains) -> bool:
    return all(same(getattr(one, name), getattr(other, name)) for name in Gains.__dataclass_fields__)


def gains_of(data: dict[str, Any] | None) -> Gains:
    """Gains from a job's JSON."""
    if not data:
        raise Conflict("the job has no gains to put")
    return Gains(**{name: float(data[name]) for name in Gains.__dataclass_fields__ if data.get(name) is not None})


def state_json(state: LoopState) -> dict[str, Any]:
    """A loop's state as JSON, the mode by name."""
    return asdict(state) | {"mode": state.mode.name.lower()}


def loop_state(data: dict[str, Any]) -> LoopState:
    """A loop's state from its JSON. PV and MV that were not numbers are of no account."""
    numbers = {name: 0.0 if data[name] is None else data[name] for name in ("pv", "mv")}
    known = {name: value for name, value in data.items() if name in LoopState.__dataclass_fields__}
    return LoopState(**known | numbers | {"mode": Mode[data["mode"].upper()], "gains": gains_of(data["gains"])})
