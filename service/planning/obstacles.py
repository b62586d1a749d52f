"""What stands in the way of a retune now: everything at once, where a retune itself ends at the first."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import FastRetune, RetuneRequest, narrow
from loopwright.service.loop_state import OPERATIONAL, LoopState
from loopwright.service.planning.facts import facts_of
from loopwright.service.planning.moves import broken_limits, stages_asked
from loopwright.tuning.experiments.preflight import MAX_ATTEMPTS, MAX_AWAY, MAX_NOISE, MIN_ROOM
from loopwright.tuning.fast.relay_test import BIAS, max_amplitude
from loopwright.tuning.models import sign
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import ADVICE, Ended, Reason, Refused


class Occupied(StrEnum):
    """Why a start is answered with 409, which is no reason for which a job ends."""

    BUSY = "busy"


_ADVICE = {Occupied.BUSY: "Wait for the end of the job that has the loop, or abort it."}


@dataclass(frozen=True, slots=True)
class Obstacle:
    """reason: for which a retune would not start, or would end before anything is moved.  detail: with the numbers."""

    reason: Reason | Occupied
    detail: str

    @property
    def advice(self) -> str:
        return _ADVICE[self.reason] if isinstance(self.reason, Occupied) else ADVICE[self.reason]


@dataclass(frozen=True, slots=True)
class Now:
    """What is known of a loop at the moment, beside its configuration.

    state: as read, or as the job that has the loop has found it; None where nobody can tell.  silent: why the
    controller could not be read.  active_job: the id of the job that has the loop.  locked: who has locked the loop, in
    words.  stopping: the service is.
    """

    state: LoopState | None = None
    silent: Ended | None = None
    active_job: str | None = None
    locked: str | None = None
    stopping: bool = False


def obstacles(config: LoopConfig, request: RetuneRequest, now: Now) -> list[Obstacle]:
    """Everything for which a retune of this loop would not start, or would end before anything is moved.

    A dry run touches no loop: the limits alone count.
    """
    narrowed, problems = narrow(config, request)
    found = [Obstacle(Reason.SERVICE_STOPPED, "the service is shutting down")] if now.stopping else []
    found += [Obstacle(Reason.BAD_LIMITS, problem) for problem in problems]
    if request.dry_run:
        return found
    if now.active_job is not None:
        found.append(Obstacle(Occupied.BUSY, f"loop {config.tag} is busy with job {now.active_job}"))
    if now.locked is not None:
        found.append(Obstacle(Reason.LOCKED, now.locked))
    if now.silent is not None:
        found.append(Obstacle(now.silent.reason, now.silent.detail))
    if now.state is not None:
        found += _of_the_loop(narrowed, request, now.state)
    noise, step = config.noise_std_hint or 0.0, narrowed.sp_deviation
    if noise > MAX_NOISE * step:
        text = f"the noise of {noise:g} {config.pv_unit} (noise_std_hint) is above {MAX_NOISE:.0%} of the step {step:g}"
        found.append(Obstacle(Reason.NOISE_TOO_HIGH, text))
    return found


def _of_the_loop(config: LoopConfig, request: RetuneRequest, state: LoopState) -> list[Obstacle]:
    """What the state of the loop shows. config: with the limits of the job."""
    found: list[Obstacle] = []
    if state.node_state != OPERATIONAL:
        found.append(Obstacle(Reason.NODE_NOT_OPERATIONAL, state.node_state))
    if state.on_trial or state.mode is Mode.EXPERIMENT:
        text = "gains are on trial, or a relay runs, that no job here has started"
        found.append(Obstacle(Reason.LOOP_IN_USE, text))
    elif state.mode is not Mode.AUTOMATIC:
        text = f"the controller is in mode {state.mode.name.lower()}, not automatic"
        found.append(Obstacle(Reason.WRONG_MODE, text))
    found += [Obstacle(Reason.BAD_LIMITS, text) for text in broken_limits(config, request, state.sp)]
    try:
        facts = facts_of(config, state)
    except Refused as refused:
        return [*found, Obstacle(refused.reason, refused.detail)]
    if not math.isfinite(state.pv) or not math.isfinite(state.mv):
        return [*found, Obstacle(Reason.BAD_SAMPLE, f"PV is {state.pv}, MV is {state.mv}")]
    return found + _of_mv(request, state.mv, facts.mv_low, facts.mv_high) + _of_pv(config, request, state)


def _of_mv(request: RetuneRequest, mv: float, low: float, high: float) -> list[Obstacle]:
    room, minimum = min(high - mv, mv - low), MIN_ROOM * (high - low)
    if room < minimum:
        text = f"MV {mv:.4g} leaves {room:.3g} of room within {low:.4g} .. {high:.4g}; at least {minimum:.3g} is needed"
        return [Obstacle(Reason.SATURATED, text)]
    maximum = max_amplitude(mv, low, high)
    asked = request.amplitude_pct if isinstance(request, FastRetune) else None
    fits_nowhere = asked is not None and (1.0 + BIAS) * asked > high - low  # `narrow` has told that
    if asked is not None and asked > maximum and not fits_nowhere and "relay" in stages_asked(request):
        text = (
            f"a relay of amplitude_pct {asked:g} moves MV from {mv:.4g} to {mv - BIAS * asked:.4g} and "
            f"{mv + asked:.4g} %, which is not within {low:.4g} .. {high:.4g}: at most {maximum:.4g} fits"
        )
        return [Obstacle(Reason.BAD_LIMITS, text)]
    return []


def _of_pv(config: LoopConfig, request: RetuneRequest, state: LoopState) -> list[Obstacle]:
    found: list[Obstacle] = []
    step, noise = config.sp_deviation, config.noise_std_hint
    # one reading is not the mean of many: a noise that nobody has told may be as large as is permitted
    maximum = MAX_AWAY * step + 4.0 * (MAX_NOISE * step if noise is None else noise)
    away = state.pv - state.sp
    limits, unit = config.pv_limits, config.pv_unit
    if not limits.low <= state.pv <= limits.high:
        text = f"PV {state.pv:.5g} {unit} is outside {limits.low:g} .. {limits.high:g}"
        found.append(Obstacle(Reason.PV_LIMIT, text))
    if abs(away) > maximum:
        text = (
            f"PV is {away:+.3g} {unit} off the set-point in this moment, and at most {maximum:.3g} would be at rest; a "
            f"retune looks {MAX_ATTEMPTS} times, half a T95 each, before it gives up"
        )
        found.append(Obstacle(Reason.NOT_AT_REST, text))
    if request.model is not None and (sign(request.model.plant()) > 0.0) != state.reverse_acting:
        acts = "reverse" if state.reverse_acting else "direct"
        found.append(Obstacle(Reason.WRONG_SIGN, f"the sign of the model's gain does not go with a {acts} action"))
    return found
