"""A procedure rehearsed on a plant of one's own: any object whose step(mv) returns PV."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError

from loopwright.service.execution.guard import RunLimits
from loopwright.service.execution.rehearsal import loop_of, options_of, rehearsal_of
from loopwright.service.execution.rehearsed import Rehearsal, RehearsalRecord
from loopwright.service.inputs.plant_file import OwnPlant, PresentGains
from loopwright.service.inputs.plausible import Implausible, check_sampling
from loopwright.service.inputs.validation import lines
from loopwright.service.results import empty_result
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Event, Mode
from loopwright.tuning.reasons import Ended, Failed, Reason, Refused

REST_T95, BUMP_T95, MEAN_T95 = 5.0, 3.0, 0.5
"""How long MV is held until PV rests, how long it is moved to see the plant's gain, and the end of these that is
averaged, in T95."""
BUMP = 0.05
"""The move of MV that shows the gain, as a part of the room to its nearer limit."""


class HasStep(Protocol):
    """A plant of one's own."""

    def step(self, mv: float, /) -> float:
        """Holds MV for one sample time; returns PV at its end."""
        ...


def retune(
    plant: HasStep,
    method: str = FAST,
    *,
    on_event: Callable[[Event], None] | None = None,
    sample_time_s: float | None = None,
    t95_s: float | None = None,
    mv: float | None = None,
    pv: float | None = None,
    mv_limits: tuple[float, float] | None = None,
    pv_limits: tuple[float, float] | None = None,
    mv_step_max: float | None = None,
    directions: str | None = None,
    sp_rate_max_per_s: float | None = None,
    sp_deviation: float | None = None,
    gains: Gains | None = None,
    reverse_acting: bool | None = None,
    **options: Any,
) -> Rehearsal:
    """Retunes a loop on a plant of one's own, in memory: the procedures, the controller's algorithm and the runner are
    those of the service. A plant may have the arguments, but pv, as attributes of the same names.

    plant: an object with step(mv), which holds MV for one sample time and returns PV at its end.
    method: "fast", "setpoint", "five-stage", or a rule of `tuning.METHODS` in place of the fifth stage.
    sample_time_s: the time that one step takes, s.  t95_s: about the time in which PV covers 95 % of a step, s.
    mv: MV at rest, MV units; by default in the middle of mv_limits, which are 0 and 100.
    pv: PV at rest, the set-point, PV units. By default MV is held for five T95 first, which is not in the record.
    sp_deviation, gains, reverse_acting: how far the set-point may be moved (PV units), the present gains, and whether
    MV falls as PV rises. What is left out of these is chosen by the plant's gain, which a move of MV of 5 % of its room
    shows; neither is that in the record.
    pv_limits: PV at which the test ends, PV units.
    mv_step_max, directions, sp_rate_max_per_s: see `tuning.experiments.primitives.Facts`.
    options: those of the method (Ms=1.4, derivative=True, propose_anyway=True).
    Raises TypeError for what is no plant, or returns what is no number; Refused, BAD_INPUT, for a wrong argument. An
    error of the plant passes through. A PV that is not finite ends the rehearsal with the reason bad_sample.
    """
    process = _Process(plant)
    given = {
        "sample_time_s": sample_time_s, "t95_s": t95_s, "mv": mv, "mv_limits": mv_limits, "pv_limits": pv_limits,
        "mv_step_max": mv_step_max, "directions": directions, "sp_rate_max_per_s": sp_rate_max_per_s,
        "sp_deviation": sp_deviation, "gains": gains, "reverse_acting": reverse_acting,
    }  # fmt: skip
    known = {name: getattr(plant, name, None) if value is None else value for name, value in given.items()}
    known |= {"name": process.name, "pv": pv}
    try:
        own = OwnPlant.model_validate({name: value for name, value in known.items() if value is not None})
        check_sampling(0.0, own.t95_s or 0.0, own.sample_time_s or 0.0)
    except ValidationError as error:
        raise Refused(Reason.BAD_INPUT, lines(error).removeprefix(": ")) from None
    except Implausible as error:
        raise Refused(Reason.BAD_INPUT, str(error)) from None
    asked = options_of(method, None, options)
    try:
        own = _completed(own, process)
        facts = _facts(own)
    except Ended as ended:
        return Rehearsal(empty_result(method), ended, plant=own)
    loop = loop_of(process, facts, Mode.AUTOMATIC, process.setpoint, own.mv_at_rest)
    limits = RunLimits(
        facts.pv_low, facts.pv_high, facts.mv_low, facts.mv_high,
        max_time_s=500 * facts.T95_s, max_frozen_s=3 * facts.T95_s, sp_deviation=facts.sp_deviation,
    )  # fmt: skip
    hooks = on_event or (lambda event: None), lambda samples: None
    found = rehearsal_of(facts, asked, loop, limits, own, method, hooks, RehearsalRecord())
    if process.error is not None:
        raise process.error
    return found


class _Process:
    """A plant of one's own as a simulated process. Raises TypeError for what is no plant.

    pv: the last PV.  setpoint: PV at rest.  error: what the plant has raised; the runner would take it for its own.
    """

    def __init__(self, plant: HasStep) -> None:
        kind = type(plant).__name__
        if isinstance(plant, type):
            raise TypeError(f"{plant.__name__} is a class: give an object of it, {plant.__name__}(...)")
        if not callable(getattr(plant, "step", None)):
            raise TypeError(
                f"{kind} is no plant: give an object with step(mv), which holds MV for one sample time and returns PV "
                "at its end (a model is rehearsed by rehearse)"
            )
        self.name, self.pv, self.setpoint = kind, math.nan, math.nan
        self.error: Exception | None = None
        self._plant = plant

    def step(self, mv: float) -> float:
        try:
            found: object = self._plant.step(mv)
            if isinstance(found, np.ndarray) and found.size == 1:
                found = found.item()  # as state spaces return it
            if isinstance(found, bool) or not isinstance(found, Real):
                raise TypeError(f"{self.name}.step({mv:g}) returned {found!r}: PV must be a number")
        except Exception as error:
            if self.error is None:
                error.add_note(f"in {self.name}.step({mv:g}), of a rehearsal")
                self.error = error
            raise
        self.pv = float(found)
        return self.pv

    def held(self, mv: float, samples: int, averaged: int) -> float:
        """Holds MV; returns the mean of the last samples of PV. Raises Failed, BAD_SAMPLE."""
        values = [self.step(mv) for _ in range(samples)][-averaged:]
        mean = float(np.mean(values))
        if not math.isfinite(mean):
            raise Failed(Reason.BAD_SAMPLE, f"PV of {self.name} is {values[-1]:g} while MV is held at {mv:g}")
        return mean


def _completed(own: OwnPlant, process: _Process) -> OwnPlant:
    """Brings the plant to rest, and chooses what was left out. Raises Failed, BAD_SAMPLE; Refused, NO_RESPONSE."""
    assert own.sample_time_s and own.t95_s
    (low, high), mv = own.mv_limits, own.mv_at_rest
    samples = {name: max(1, round(part * own.t95_s / own.sample_time_s)) for name, part in _PARTS.items()}
    chosen: dict[str, object] = {}
    if own.pv is None:
        process.setpoint = process.held(mv, samples["rest"], samples["mean"])
    else:
        process.setpoint = process.pv = own.pv
    if own.sp_deviation is None or own.gains is None or own.reverse_acting is None:
        room = min(mv - low, high - mv)
        before = process.setpoint
        moved = process.held(mv + BUMP * room, samples["bump"], samples["mean"]) - before
        if moved == 0.0:
            raise Refused(Reason.NO_RESPONSE, f"PV of {process.name} stayed at {before:g} while MV moved by 5 %")
        gain = moved / (BUMP * room)
        process.setpoint = process.held(mv, samples["rest"], samples["mean"])
        chosen = {
            "sp_deviation": 0.2 * room * abs(gain),
            "gains": PresentGains(Kp=0.3 / abs(gain), Ti=own.t95_s / 3),
            "reverse_acting": gain > 0,
        }
    left_out = {name: value for name, value in chosen.items() if getattr(own, name) is None}
    return own.model_copy(update=left_out | {"pv": process.setpoint, "mv": mv})


_PARTS = {"rest": REST_T95, "bump": BUMP_T95, "mean": MEAN_T95}


def _facts(own: OwnPlant) -> Facts:
    """Raises Refused as `Facts`."""
    assert own.sample_time_s and own.t95_s and own.sp_deviation and own.gains and own.reverse_acting is not None
    (low, high), (pv_low, pv_high) = own.mv_limits, own.pv_limits or (-math.inf, math.inf)
    return Facts(
        own.sample_time_s, own.t95_s, low, high, own.sp_deviation, Gains(**own.gains.model_dump()), own.reverse_acting,
        pv_low, pv_high, own.mv_step_max or math.inf, own.directions, own.sp_rate_max_per_s or math.inf,
    )  # fmt: skip
