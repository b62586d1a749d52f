"""A loop's state and gains as a job's JSON, and back."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from loopwright.service.errors import Conflict
from loopwright.service.loop import LoopState
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode


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
