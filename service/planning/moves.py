"""What the stages of a retune move, and how far at most: known before anything is moved.

Figures are what the procedures command by themselves (`tuning.fast.relay_test`, `tuning.five_stage`). In automatic the
controller's feedback may take MV farther; the limits of the test hold there too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from loopwright.protocol.real32 import TOLERANCE
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import FastRetune, FiveStages, RetuneRequest
from loopwright.tuning.experiments.step_test import KICK_OF_ROOM
from loopwright.tuning.fast.design_trial import trial_stages
from loopwright.tuning.fast.procedure import fast_stages
from loopwright.tuning.fast.relay_test import BIAS, FIRST_AMPLITUDE, MAX_OUTPUT_RANGE, MAX_RAISE, max_amplitude
from loopwright.tuning.five_stage.procedure import stages_of
from loopwright.tuning.five_stage.ultimate_gain import RUN_MV_LIMIT
from loopwright.tuning.gains import Gains

_COMPUTING = ("design", "redesign", "estimate", "optimise")
_STEPPING = ("baseline", "ultimate", "zn_pi", "verify")
_UNDER_PRESENT_GAINS, _UNDER_NEW_GAINS = 2.0, 1.4
"""Of a set-point step: as far as PV goes in a loop that is just stable, and as `verification` lets it go."""


@dataclass(frozen=True, slots=True)
class Moves:
    """What a stage moves. mv_down, mv_up: how far MV is moved away from where it is, percent, both positive.

    sp_up: largest step of the set-point, PV units.  pv: how far PV is expected to go from the set-point as it is now,
    PV units, None where nobody can tell.  first_mv: what the relay begins with, percent, None without one.
    """

    stage: str
    what: str
    mv_down: float = 0.0
    mv_up: float = 0.0
    sp_up: float = 0.0
    pv: float | None = 0.0
    first_mv: float | None = None


def stages_asked(request: RetuneRequest) -> tuple[str, ...]:
    """The stages of the retune, in their order."""
    if isinstance(request, FastRetune):
        return trial_stages(request.verify) if request.start == "design" else fast_stages(request.verify)
    return stages_of(request.start, request.options.baseline, request.verify)


def broken_limits(config: LoopConfig, request: RetuneRequest, sp: float) -> list[str]:
    """The limits of PV that the test itself would break at this set-point, in words with the numbers.

    Whether MV has room is the procedures' own to say: they know its mean.

    config: with the limits of the job.
    """
    low, high, step, unit = config.pv_limits.low, config.pv_limits.high, config.sp_deviation, config.pv_unit
    hair = TOLERANCE * max(abs(sp), step)
    if not low - hair <= sp <= high + hair:
        return [f"the set-point {sp:.6g} {unit} is not within the PV limits {low:g} .. {high:g}"]
    stages, broken = stages_asked(request), []
    share = 1.0
    if isinstance(request, FiveStages) and "zn_pi" in stages:
        share += request.overshoot_window_pct[0] / 100.0
    if any(stage in stages for stage in _STEPPING) and sp + share * step > high + hair:
        overshoot = f" and an overshoot of {100 * (share - 1):g} % is looked for," if share > 1 else ","
        broken.append(
            f"the set-point is stepped from {sp:.6g} by up to {step:g} {unit} (sp_deviation),{overshoot} which takes "
            f"PV to {sp + share * step:.6g}, above the PV limit {high:g}: {_remedy((high - sp) / share, unit)}"
        )
    adapted = isinstance(request, FastRetune) and request.amplitude_pct is None
    if adapted and "relay" in stages and sp - step < low - hair:
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
    """What is known of the loop before the test; what is not is None.

    gains: in effect.  mv: now, percent.  Ku: ultimate gain of the last model, percent per PV unit.
    """

    gains: Gains | None = None
    mv: float | None = None
    Ku: float | None = None


def moves(config: LoopConfig, request: RetuneRequest, before: Before) -> list[Moves]:
    """Each stage's, in their order. config: with the limits of the job, MV limits those that hold.

    Where the present gains or MV are not known, the figures are the largest that the limits leave room for.
    """
    found = []
    for stage in stages_asked(request):
        if stage == "preflight":
            found.append(Moves(stage, "Nothing is moved: the loop is listened to in automatic until it is at rest."))
        elif stage in _COMPUTING:
            found.append(Moves(stage, "Nothing is moved by the test: the record is computed on."))
        else:
            found.append(_moving(stage, config, request, before))
    return found


def _moving(stage: str, config: LoopConfig, request: RetuneRequest, before: Before) -> Moves:
    if not isinstance(request, FastRetune):
        return _five_stage(stage, config, request, before)
    return _trial(stage, config, before) if request.start == "design" else _fast(stage, config, request, before)


def _fast(stage: str, config: LoopConfig, request: FastRetune, before: Before) -> Moves:
    low, high, step, unit = config.mv_limits.low, config.mv_limits.high, config.sp_deviation, config.pv_unit
    maximum = (high - low) / (1.0 + BIAS) if before.mv is None else max(0.0, max_amplitude(before.mv, low, high))
    given = request.amplitude_pct
    first = given or FIRST_AMPLITUDE * maximum
    up = min(MAX_RAISE * given, maximum) if given else maximum
    if stage != "relay":
        what = (
            f"The set-point is stepped up by up to {step:g} {unit} under the new gains, on trial; it is stepped back "
            "where the record leaves doubt."
        )
        return Moves(stage, what, up, up, step, _UNDER_NEW_GAINS * step)
    size, mean = "Its size stays", 0.5 * (1.0 + BIAS)
    pv = _swing(mean * first, before.Ku)
    if given is None:
        size = (
            f"After its first wave it is adapted, so that PV moves by at most {MAX_OUTPUT_RANGE * step:g} {unit} in all"
        )
        if pv is not None:  # nothing bounds the first wave but MV
            pv = max(pv, min(0.5 * MAX_OUTPUT_RANGE * step, pv * maximum / first if first else 0.0))
    what = (
        f"A relay in the controller moves MV by +{first:.4g} and -{BIAS * first:.4g} % at first. {size}; a side on "
        "which PV stalls is raised, up to twice."
    )
    return Moves(stage, what, BIAS * up, up, pv=pv, first_mv=first)


def _trial(stage: str, config: LoopConfig, before: Before) -> Moves:
    kick, step = KICK_OF_ROOM * _room(config, before.mv), config.sp_deviation
    what = f"The set-point is stepped up by up to {step:g} {config.pv_unit} under the new gains, on trial, and back."
    return Moves(stage, what, kick, kick, step, _UNDER_NEW_GAINS * step)


def _five_stage(stage: str, config: LoopConfig, request: FiveStages, before: Before) -> Moves:
    room, step, unit, gains = _room(config, before.mv), config.sp_deviation, config.pv_unit, before.gains
    kick = KICK_OF_ROOM * room
    if stage == "relay":
        what = f"A relay in the controller moves MV by +-{room:.4g} %, all the room there is, until PV swings evenly."
        return Moves(stage, what, room, room, pv=_swing(room, before.Ku), first_mv=room)
    if stage == "ultimate":
        what = (
            f"Set-point steps of up to {step:g} {unit} under a P controller, two to five runs, until PV swings by "
            "itself; a run ends where MV comes to the end of its room. In between MV is held by hand."
        )
        run = RUN_MV_LIMIT * room
        return Moves(stage, what, run, run, step, _UNDER_PRESENT_GAINS * step)
    if stage == "zn_pi":
        low, high = request.overshoot_window_pct
        what = (
            f"Set-point steps of up to {step:g} {unit} under a Ziegler-Nichols PI, until PV overshoots by {low:g} to "
            f"{high:g} %."
        )
        return Moves(stage, what, kick, kick, step, (1.0 + high / 100.0) * step)
    if gains is not None and gains.Kp > 0.0:
        step = min(step, kick / gains.Kp)  # `allowed_step` of the old gains bounds both of these
    which, farthest = ("present", _UNDER_PRESENT_GAINS) if stage == "baseline" else ("new", _UNDER_NEW_GAINS)
    what = f"The set-point is stepped up by up to {step:.4g} {unit} under the {which} gains, and back."
    return Moves(stage, what, kick, kick, step, farthest * step)


def _swing(amplitude: float, Ku: float | None) -> float | None:
    """Of PV to each side under a relay, by its describing function, PV units."""
    return 4.0 * amplitude / (math.pi * Ku) if Ku else None


def _room(config: LoopConfig, mv: float | None) -> float:
    """On the nearer side of MV, percent."""
    low, high = config.mv_limits.low, config.mv_limits.high
    return 0.5 * (high - low) if mv is None else max(0.0, min(high - mv, mv - low))
