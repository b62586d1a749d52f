"""States before a test what each stage of a retune moves, and how far at most.

The figures are the moves that the procedures command (`tuning.fast.relay_test`, `tuning.five_stage`). In automatic the
controller's feedback may take MV farther; the limits of the test apply there too. How far PV goes is told by
`planning.expected`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from loopwright.protocol.real32 import TOLERANCE
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest, excitations
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.experiments.step_test import KICK_OF_ROOM
from loopwright.tuning.fast.manual.manual_test import LONGEST_PULSE_T95
from loopwright.tuning.fast.manual.procedure import MANUAL
from loopwright.tuning.fast.manual.sizes import first_pulse, largest_pulse
from loopwright.tuning.fast.pulses.pulse_test import pulse_size
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.relay_test import BIAS, FIRST_AMPLITUDE, MAX_OUTPUT_RANGE, MAX_RAISE, max_amplitude
from loopwright.tuning.five_stage.ultimate_gain import RUN_MV_LIMIT
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode

_COMPUTING = ("design", "redesign", "estimate", "optimise")
_STEPPING = ("baseline", "ultimate", "zn_pi", "verify", "trial")


@dataclass(frozen=True, slots=True)
class Moves:
    """What a stage moves.

    mv_down, mv_up: largest moves of MV from its present value, percent, both positive.
    sp_up, sp_down: largest moves of the set-point from its present value, PV units, both positive.
    first_mv: initial amplitude of the relay, or size of the first pulse of the manual output, percent; None without.
    """

    stage: str
    what: str
    mv_down: float = 0.0
    mv_up: float = 0.0
    sp_up: float = 0.0
    sp_down: float = 0.0
    first_mv: float | None = None


def stages_asked(config: LoopConfig, request: RetuneRequest, mode: Mode = Mode.AUTOMATIC) -> tuple[str, ...]:
    """Returns the stages that the retune may have, in their order.

    config: the configuration with the limits of the job.
    mode: the mode of the loop.
    """
    return request.stages(excitations(config, request, mode))


def broken_from(config: LoopConfig, request: RetuneRequest, state: LoopState) -> list[str]:
    """Returns a sentence with the numbers for each PV limit that the test itself would break from this state.

    Pulses of the manual output are sized to keep the PV limits, so that PV has to be within them, and no more.
    """
    low, high = config.pv_limits.low, config.pv_limits.high
    if MANUAL not in stages_asked(config, request, state.mode):
        return broken_limits(config, request, state.sp)
    if low < state.pv < high or not math.isfinite(state.pv):
        return []
    return [f"PV {state.pv:.6g} {config.pv_unit} is not within the PV limits {low:g} .. {high:g}"]


def broken_limits(config: LoopConfig, request: RetuneRequest, sp: float) -> list[str]:
    """Returns a sentence with the numbers for each PV limit that the test itself would break at this set-point.

    The procedures check the room of MV themselves, because they know its mean.

    config: the configuration with the limits of the job.
    """
    low, high, step, unit = config.pv_limits.low, config.pv_limits.high, config.sp_deviation, config.pv_unit
    hair = TOLERANCE * max(abs(sp), step)
    if not low - hair <= sp <= high + hair:
        return [f"the set-point {sp:.6g} {unit} is not within the PV limits {low:g} .. {high:g}"]
    stages, broken = stages_asked(config, request), []
    share = 1.0
    if "zn_pi" in stages:
        share += request.overshoot_asked_pct[0] / 100.0
    up, down = (config.test.directions in ("both", way) for way in ("up", "down"))
    stepping = any(stage in stages for stage in (*_STEPPING, "pulses"))
    if up and stepping and sp + share * step > high + hair:
        overshoot = f" and an overshoot of {100 * (share - 1):g} % is looked for," if share > 1 else ","
        broken.append(
            f"the set-point is stepped from {sp:.6g} by up to {step:g} {unit} (sp_deviation),{overshoot} which takes "
            f"PV to {sp + share * step:.6g}, above the PV limit {high:g}: {_remedy((high - sp) / share, unit)}"
        )
    if down and ("pulses" in stages or (stepping and not up)) and sp - step < low - hair:
        broken.append(
            f"the set-point is moved from {sp:.6g} down by up to {step:g} {unit} (sp_deviation), which takes PV to "
            f"{sp - step:.6g}, below the PV limit {low:g}: {_remedy(sp - low, unit)}"
        )
    if request.adapts_relay and "relay" in stages and sp - step < low - hair:
        broken.append(
            f"the relay may move PV from {sp:.6g} by up to {step:g} {unit} (sp_deviation), which takes it to "
            f"{sp - step:.6g}, below the PV limit {low:g}: {_remedy(sp - low, unit)}"
        )
    return broken


def _remedy(maximum: float, unit: str) -> str:
    if maximum <= 0.0:
        return "move the set-point, or permit more PV"
    return f"ask for an sp_deviation of at most {maximum:.4g} {unit}, or permit more PV"


@dataclass(frozen=True, slots=True)
class Before:
    """The loop before the test; a quantity that is not known is None.

    gains: the gains in effect.
    mv: the present MV, percent.
    mode: the mode; automatic where it is not known.
    reverse: whether MV has to fall as PV rises.
    begins_with: the amplitude with which the relay begins in place of its own, percent.
    """

    gains: Gains | None = None
    mv: float | None = None
    mode: Mode = Mode.AUTOMATIC
    reverse: bool = True
    begins_with: float | None = None


def moves(config: LoopConfig, request: RetuneRequest, before: Before) -> list[Moves]:
    """Returns the moves of each stage, in the order of the stages.

    Where the present gains or MV are not known, the figures are the largest that the limits permit.

    config: the configuration with the limits of the job, and the MV limits in effect.
    """
    found = []
    stages = stages_asked(config, request, before.mode)
    mode = "manual" if MANUAL in stages else "automatic"
    for stage in stages:
        if stage == "preflight":
            found.append(Moves(stage, f"Nothing is moved: the loop is observed in {mode} until it is at rest."))
        elif stage == MANUAL:
            found.append(_manual(config, before))
        elif stage in _COMPUTING:
            found.append(Moves(stage, "Nothing is moved by the test: the gains are computed from the record."))
        else:
            found.append(_moving(stage, config, request, before))
    return found


def _moving(stage: str, config: LoopConfig, request: RetuneRequest, before: Before) -> Moves:
    if request.pulses_setpoint:
        return _setpoint(stage, config, before)
    if request.known_model is not None:
        return _trial(stage, config, before)
    if request.chooses_excitation:
        return _by_excitation(stage, config, request, before)
    return _five_stage(stage, config, request, before)


def _by_excitation(stage: str, config: LoopConfig, request: RetuneRequest, before: Before) -> Moves:
    """The moves of a stage of fast. Where relay or pulses may have made the record, the larger moves of the two."""
    tried = excitations(config, request)
    if stage == "trial":
        return _known_trial(config, before)
    if Excitation.SETPOINT not in tried:
        return _fast(stage, config, request, before)
    if Excitation.RELAY not in tried or stage == "pulses":
        return _setpoint(stage, config, before)
    relay = _fast(stage, config, request, before)
    if stage == "relay":
        return replace(relay, what=f"Only where the pulses tell too little: {relay.what}")
    pulses = _setpoint(stage, config, before)
    what = f"After pulses: {pulses.what} After the relay: {relay.what}"
    return Moves(
        stage, what, max(pulses.mv_down, relay.mv_down), max(pulses.mv_up, relay.mv_up),
        max(pulses.sp_up, relay.sp_up), max(pulses.sp_down, relay.sp_down),
    )  # fmt: skip


def _fast(stage: str, config: LoopConfig, request: RetuneRequest, before: Before) -> Moves:
    low, high, step, unit = config.mv_limits.low, config.mv_limits.high, config.sp_deviation, config.pv_unit
    jump = config.test.mv_step_max or math.inf
    mv = low + BIAS / (1.0 + BIAS) * (high - low) if before.mv is None else before.mv
    maximum = max(0.0, max_amplitude(mv, low, high, jump))
    given = request.relay_amplitude_pct
    first = given or before.begins_with or FIRST_AMPLITUDE * maximum
    up = min(MAX_RAISE * given, maximum) if given else maximum
    if stage != "relay":
        what = (
            f"The set-point is stepped up by up to {step:g} {unit} under the new gains, on trial; it is stepped back "
            f"where the record is not conclusive.{_ramp(config, step)}"
        )
        return Moves(stage, what, up, up, step)
    size = "The size stays"
    if given is None:
        most = MAX_OUTPUT_RANGE * step
        smaller = " Smaller than usual, so that PV keeps its limits." if before.begins_with else ""
        size = (
            f"{smaller} Where the first wave moves PV by more than {most:g} {unit} from end to end, the later ones are "
            "made smaller; where PV hardly shows, larger"
        ).strip()
    what = (
        f"A relay in the controller moves MV by +{first:.4g} and -{BIAS * first:.4g} % at first. {size}; a side on "
        "which PV stalls is raised, up to twice."
    )
    return Moves(stage, what, BIAS * up, up, first_mv=first)


def _setpoint(stage: str, config: LoopConfig, before: Before) -> Moves:
    step, unit, room, gains = config.sp_deviation, config.pv_unit, _room(config, before.mv), before.gains
    one_sided, way = config.test.directions != "both", config.test.directions
    if gains is not None and gains.Kp * gains.b > 0.0:
        step = pulse_size(step, room, gains, one_sided)
    if stage == "pulses":
        pulses = f"{way}, back and {way} again" if one_sided else "up, down and up again"
        what = (
            f"The set-point moves {pulses} by up to {step:.4g} {unit} under the present gains, and on so while the "
            f"record is not conclusive; the loop stays in automatic.{_ramp(config, step)}"
        )
        if one_sided:
            what += " A gain that differs above and below where it begins is not seen."
        return Moves(stage, what, room, room, *_sides(config, step, step))
    again = "once more, by half as much"
    what = (
        f"The set-point goes back by {step:.4g} {unit} to where it was, under the new gains, on trial; it is stepped "
        f"{again}, where the record is not conclusive.{_ramp(config, step)}"
    )
    return Moves(stage, what, room, room, *_sides(config, step, 0.0))


def _manual(config: LoopConfig, before: Before) -> Moves:
    low, high, step, way = config.mv_limits.low, config.mv_limits.high, config.sp_deviation, config.test.directions
    side = None if way == "both" else 1.0 if (way == "up") is before.reverse else -1.0
    mv = 0.5 * (low + high) if before.mv is None else before.mv
    most = largest_pulse(mv, low, high, config.test.mv_step_max or math.inf, side)
    first = first_pulse(before.gains.Kp * step if before.gains else math.inf, most)
    sides = "to both sides in turn" if side is None else f"{'up' if side > 0.0 else 'down'} only"
    what = (
        f"The manual output moves by {first:.4g} % at first and by up to {most:.4g} %, {sides}, and back to where it "
        f"is: pulses of {LONGEST_PULSE_T95 * config.t95_s:.3g} s at most, the later ones sized so that PV moves by "
        f"up to {step:g} {config.pv_unit}. The loop stays in manual; the new gains are not tried."
    )
    if side is not None:
        what += " A gain that differs above and below where MV is is not seen."
    up, down = (0.0 if side is not None and side * sign < 0.0 else most for sign in (1.0, -1.0))
    return Moves(MANUAL, what, down, up, first_mv=first)


def _known_trial(config: LoopConfig, before: Before) -> Moves:
    kick, step = KICK_OF_ROOM * _room(config, before.mv), config.sp_deviation
    what = (
        f"Only where operation has shown the plant well enough: the set-point is stepped {_first(config)} by up to "
        f"{step:g} {config.pv_unit} under the gains that follow from it, on trial, and back where the record is not "
        f"conclusive. A plant that is another one by now shows in it; the present gains then take over again."
        f"{_ramp(config, step)}"
    )
    return Moves("trial", what, kick, kick, *_sides(config, step, 0.0))


def _trial(stage: str, config: LoopConfig, before: Before) -> Moves:
    kick, step = KICK_OF_ROOM * _room(config, before.mv), config.sp_deviation
    what = (
        f"The set-point is stepped {_first(config)} by up to {step:g} {config.pv_unit} under the new gains, on trial, "
        "and back."
    )
    return Moves(stage, what, kick, kick, *_sides(config, step, 0.0))


def _first(config: LoopConfig) -> str:
    """Returns the side to which the set-point is moved first."""
    return "down" if config.test.directions == "down" else "up"


def _sides(config: LoopConfig, first: float, second: float) -> tuple[float, float]:
    """Returns the largest moves of the set-point up and down.

    first, second: its moves to the side to which it goes first, and to the other one where that is permitted.
    """
    if config.test.directions == "both":
        return first, second
    return (first, 0.0) if config.test.directions == "up" else (0.0, first)


def _ramp(config: LoopConfig, step: float) -> str:
    """Returns the sentence on the time that moves of the set-point take; empty where they are steps."""
    rate = config.test.sp_rate_max_per_s
    if rate is None:
        return ""
    return f" It is moved at {rate:g} {config.pv_unit}/s at most: {step / rate:.3g} s for {step:.4g} {config.pv_unit}."


def _five_stage(stage: str, config: LoopConfig, request: RetuneRequest, before: Before) -> Moves:
    room, step, unit, gains = _room(config, before.mv), config.sp_deviation, config.pv_unit, before.gains
    kick = KICK_OF_ROOM * room
    if stage == "relay":
        what = (
            f"A relay in the controller moves MV by +-{room:.4g} %, all the room there is, until PV oscillates evenly."
        )
        return Moves(stage, what, room, room, first_mv=room)
    if stage == "ultimate":
        what = (
            f"Set-point steps of up to {step:g} {unit} under a P controller, two to five runs, until PV "
            "oscillates by itself; a run ends where MV reaches its limit. In between MV is held in manual."
        )
        run = RUN_MV_LIMIT * room
        return Moves(stage, what, run, run, step)
    if stage == "zn_pi":
        low, high = request.overshoot_asked_pct
        what = (
            f"Set-point steps of up to {step:g} {unit} under a Ziegler-Nichols PI, until PV overshoots by {low:g} to "
            f"{high:g} %."
        )
        return Moves(stage, what, kick, kick, step)
    if gains is not None and gains.Kp > 0.0:
        step = min(step, kick / gains.Kp)  # `allowed_step` of the previous gains bounds both steps
    which = "present" if stage == "baseline" else "new"
    what = f"The set-point is stepped up by up to {step:.4g} {unit} under the {which} gains, and back."
    return Moves(stage, what, kick, kick, step)


def _room(config: LoopConfig, mv: float | None) -> float:
    """Returns the room of MV for a test, percent, see `OperatingPoint.room`."""
    low, high = config.mv_limits.low, config.mv_limits.high
    room = 0.5 * (high - low) if mv is None else max(0.0, min(high - mv, mv - low))
    return min(room, 0.5 * (config.test.mv_step_max or math.inf))
