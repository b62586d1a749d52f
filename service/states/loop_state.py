"""A loop's state and gains: compared as the bus lets them be compared, and as a job's JSON, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pydantic import JsonValue, TypeAdapter

from loopwright.protocol.real32 import TOLERANCE, same
from loopwright.service.errors import Conflict
from loopwright.service.jsonable import JsonObject, json_object, number
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode

OPERATIONAL = "operational"


@dataclass(frozen=True, slots=True)
class LoopState:
    """What a loop is and must come back to. MV and PV in the loop's units, limits as the controller holds them.

    gains: of a live loop the accepted ones, those that a trial ends with.
    node_state: operational, or the state in which a node of the loop controls nothing.
    fail_action: what the plant's I/O does when the controller falls silent ("holds MV where it is"); empty: not known.
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
    fail_action: str = ""

    @property
    def held_mv(self) -> float:
        """Returns the MV that the loop has, or is on its way to, where no control law moves it, MV units."""
        return self.manual_output if self.mode is Mode.MANUAL else self.mv


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


def after_false_pv(state: LoopState) -> str:
    """Returns in words what a loop was left in by a test that has found PV to be false, and who has to act."""
    if state.mode is Mode.AUTOMATIC:
        return (
            "PV is false, and the loop was left in automatic: an operator has to look at it now, and put it in manual"
        )
    return (
        f"PV is false: the loop was left in {state.mode.name.lower()} at MV {state.held_mv:.6g}, and nothing controls "
        "PV until an operator has mended the sensor and puts the loop in automatic"
    )


def same_gains(one: Gains, other: Gains) -> bool:
    """Whether the gains are the same as far as REAL32 tells. Kp is compared by the ratio alone: where PV has a large
    span, Kp is smaller than what counts as 0 elsewhere."""
    others = (name for name in Gains.__dataclass_fields__ if name != "Kp")
    return math.isclose(one.Kp, other.Kp, rel_tol=TOLERANCE) and all(
        same(getattr(one, name), getattr(other, name)) for name in others
    )


_LOOP_STATE = TypeAdapter(LoopState)


def gains_of(data: JsonValue) -> Gains:
    """Returns the gains in the JSON of a job. Raises Conflict where there are none."""
    if not data or not isinstance(data, dict):
        raise Conflict("the job has kept no previous gains, so that none can be written or taken back; retune the loop")
    return Gains(**{name: number(data[name]) for name in Gains.__dataclass_fields__ if data.get(name) is not None})


def state_json(state: LoopState) -> JsonObject:
    """Returns the state of a loop as JSON, the mode by name."""
    return json_object(state) | {"mode": state.mode.name.lower()}


def loop_state(data: JsonObject) -> LoopState:
    """Returns the state of a loop from its JSON. A PV or MV that was not a number is 0."""
    numbers = {name: 0.0 if data[name] is None else data[name] for name in ("pv", "mv")}
    mode, gains = Mode[str(data["mode"]).upper()], gains_of(data["gains"])
    return _LOOP_STATE.validate_python(data | numbers | {"mode": mode, "gains": gains})
