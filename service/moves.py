"""What the stages of a retune move, and how far at most: known before anything is moved.

Figures are what the procedures command by themselves (`tuning.fast.experiment`, `tuning.stages`). In automatic the
controller's feedback may take MV farther; the limits of the test hold there too.
"""

from __future__ import annotations

from dataclasses import dataclass

from service.config import LoopConfig
from service.request import RetuneRequest
from tuning.fast.experiment import BIAS, FIRST, MOST_RAISED, WIDEST_SPAN, most_amplitude
from tuning.fast.procedure import fast_stages
from tuning.fast.trial import trial_stages
from tuning.five_stage import stages_of
from tuning.gains import Gains
from tuning.stages.ultimate import RUN_MV_LIMIT
from tuning.stages.zn_pi import KICK_OF_ROOM

_COMPUTING = ("design", "redesign", "estimate", "optimise")
_STEPPING = ("baseline", "ultimate", "zn_pi", "verify")
_HAIR = 1e-6
"""Of a set-point: what a REAL32 on the bus cannot tell."""


@dataclass(frozen=True, slots=True)
class Moves:
    """What a stage moves. mv_down, mv_up: how far MV is moved away from where it is, percent, both positive.

    sp_up: largest step of the set-point, PV units.  first_mv: what the relay begins with, percent, None without one.
    """

    stage: str
    what: str
    mv_down: float = 0.0
    mv_up: float = 0.0
    sp_up: float = 0.0
    first_mv: float | None = None


def stages_asked(request: RetuneRequest) -> tuple[str, ...]:
    """The stages of the retune, in their order."""
    if request.fast:
        return trial_stages(request.verify) if request.start == "design" else fast_stages(request.verify)
    assert request.start != "design"  # the request has checked it
    return stages_of(request.start, request.baseline is not False, request.verify)


def broken_limits(config: LoopConfig, request: RetuneRequest, sp: float) -> list[str]:
    """The limits of PV that the test itself would break at this set-point, in words with the numbers.

    Whether MV has room is the procedures' own to say: they know its mean.

    config: with the limits of the job.
    """
    low, high, step, unit = config.pv_limits.low, config.pv_limits.high, config.sp_deviation, config.pv_unit
    hair = _HAIR * max(abs(sp), step)
    if not low - hair <= sp <= high + hair:
        return [f"the set-point {sp:.6g} {unit} is not within the PV limits {low:g} .. {high:g}"]
    stages, broken = stages_asked(request), []
    share = 1.0
    if "zn_pi" in stages:
        share += request.overshoot_window_pct[0] / 100.0
    if any(stage in stages for stage in _STEPPING) and sp + share * step > high + hair:
        overshoot = f" and an overshoot of {100 * (share - 1):g} % is looked for," if share > 1 else ","
        broken.append(
            f"the set-point is stepped from {sp:.6g} by up to {step:g} {unit} (sp_deviation),{overshoot} which takes "
            f"PV to {sp + share * step:.6g}, above the PV limit {high:g}: {_remedy((high - sp) / share, unit)}"
        )
    if request.fast and "relay" in stages and sp - step < low - hair:
        broken.append(
            f"the relay may move PV from {sp:.6g} by up to {step:g} {unit} (sp_deviation), which takes it to "
            f"{sp - step:.6g}, below the PV limit {low:g}: {_remedy(sp - low, unit)}"
        )
    return broken


def _remedy(most: float, unit: str) -> str:
    if most <= 0.0:
        return "move the set-point, or permit more PV"
    return f"ask for an sp_deviation of at most {most:.4g} {unit}, or permit more PV"


def moves(config: LoopConfig, request: RetuneRequest, gains: Gains | None, mv: float | None) -> list[Moves]:
    """Each stage's, in their order. config: with the limits of the job, MV limits those that hold.

    gains, mv: of the loop now; without them the figures are the largest that the limits leave room for.
    """
    one = _fast if request.fast else _five_stage
    found = []
    for stage in stages_asked(request):
        if stage == "preflight":
            found.append(Moves(stage, "Nothing is moved: the loop is listened to in automatic until it is at rest."))
        elif stage in _COMPUTING:
            found.append(Moves(stage, "Nothing is moved by the test: the record is computed on."))
        else:
            found.append(one(stage, config, request, gains, mv))
    return found


def _fast(stage: str, config: LoopConfig, request: RetuneRequest, gains: Gains | None, mv: float | None) -> Moves:
    limits, step, unit = config.mv_limits, config.sp_deviation, config.pv_unit
    width = limits.high - limits.low
    if stage == "relay" or request.start != "design":
        most = width / (1.0 + BIAS) if mv is None else max(0.0, most_amplitude(mv, limits.low, limits.high))
        given = request.amplitude_pct
        first = given or FIRST * most
        up = min(MOST_RAISED * given, most) if given else most
    if stage == "relay":
        size = "Its size stays"
        if given is None:
            size = f"Its size is adapted until PV clearly moves, by no more than {WIDEST_SPAN * step:g} {unit} in all"
        what = (
            f"A relay in the controller moves MV by +{first:.4g} and -{BIAS * first:.4g} % at first. {size}; a side on "
            "which PV stalls is raised, up to twice."
        )
        return Moves(stage, what, mv_down=BIAS * up, mv_up=up, first_mv=first)
    what = f"The set-point is stepped up by up to {step:g} {unit} under the new gains, on trial"
    if request.start == "design":
        room = _room(limits.low, limits.high, mv)
        return Moves(stage, what + ", and back.", KICK_OF_ROOM * room, KICK_OF_ROOM * room, step)
    more = "; it is stepped back where the record leaves doubt."
    return Moves(stage, what + more, up, up, step)


def _five_stage(stage: str, config: LoopConfig, request: RetuneRequest, gains: Gains | None, mv: float | None) -> Moves:
    room = _room(config.mv_limits.low, config.mv_limits.high, mv)
    step, unit, kick = config.sp_deviation, config.pv_unit, KICK_OF_ROOM * room
    if stage == "relay":
        what = f"A relay in the controller moves MV by +-{room:.4g} %, all the room there is, until PV swings evenly."
        return Moves(stage, what, room, room, first_mv=room)
    if stage == "ultimate":
        what = (
            f"Set-point steps of up to {step:g} {unit} under a P controller, two to five runs, until PV swings by "
            "itself; a run ends where MV comes to the end of its room. In between MV is held by hand."
        )
        return Moves(stage, what, RUN_MV_LIMIT * room, RUN_MV_LIMIT * room, step)
    if stage == "zn_pi":
        low, high = request.overshoot_window_pct
        what = (
            f"Set-point steps of up to {step:g} {unit} under a Ziegler-Nichols PI, until PV overshoots by {low:g} to "
            f"{high:g} %."
        )
        return Moves(stage, what, kick, kick, step)
    if gains is not None and gains.Kp > 0.0:
        step = min(step, kick / gains.Kp)  # `allowed_step` of the old gains bounds both of these
    which = "present" if stage == "baseline" else "new"
    what = f"The set-point is stepped up by up to {step:.4g} {unit} under the {which} gains, and back."
    return Moves(stage, what, kick, kick, step)


def _room(low: float, high: float, mv: float | None) -> float:
    """On the nearer side of MV, percent."""
    return 0.5 * (high - low) if mv is None else max(0.0, min(high - mv, mv - low))
