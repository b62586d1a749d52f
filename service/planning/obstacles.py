"""Lists every reason for which a retune would be refused now; a retune itself ends at the first of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from loopwright.service.errors import RemoteSetpoint
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import (
    RetuneRequest,
    check_setpoint_source,
    excitations,
    narrow,
    wrong_mode,
)
from loopwright.service.planning.facts import facts_of
from loopwright.service.planning.moves import broken_from, stages_asked
from loopwright.service.states.loop_state import OPERATIONAL, LoopState
from loopwright.tuning.experiments.preflight import MAX_ATTEMPTS, MAX_AWAY, MAX_NOISE, MIN_ROOM
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.ramp import check_ramp
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.relay_test import BIAS, max_amplitude
from loopwright.tuning.models import sign
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import ADVICE, Ended, Reason, Refused


class Occupied(StrEnum):
    """Reasons for which a start is answered with 409; no job ends for them."""

    BUSY = "busy"


_ADVICE = {Occupied.BUSY: "Wait for the end of the job that has the loop, or abort that job."}


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A reason for which a retune would not start, or would end before anything is moved; detail has the numbers."""

    reason: Reason | Occupied
    detail: str

    @property
    def advice(self) -> str:
        return _ADVICE[self.reason] if isinstance(self.reason, Occupied) else ADVICE[self.reason]


@dataclass(frozen=True, slots=True)
class Now:
    """What is known of a loop at present, beside its configuration.

    state: the state as read, or as found by the job that has the loop; None where it is not known.
    silent: why the controller could not be read; None where it answered.
    active_job: the id of the job that has the loop.
    locked: a sentence that says who has locked the loop; None where it is not locked.
    not_acknowledged: a sentence that says which test has found PV to be false, and how that is acknowledged; None where
    nothing is to be acknowledged.
    stopping: True while the service shuts down.
    """

    state: LoopState | None = None
    silent: Ended | None = None
    active_job: str | None = None
    locked: str | None = None
    not_acknowledged: str | None = None
    stopping: bool = False


def obstacles(config: LoopConfig, request: RetuneRequest, now: Now) -> list[Obstacle]:
    """Returns every reason for which a retune of this loop would not start, or would end before anything is moved.

    A dry run touches no loop, so only the limits count for it.
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
    if now.not_acknowledged is not None:
        found.append(Obstacle(Reason.NOT_ACKNOWLEDGED, now.not_acknowledged))
    try:
        check_setpoint_source(narrowed, request, None if now.state is None else now.state.mode)
    except RemoteSetpoint as remote:
        found.append(Obstacle(remote.reason, remote.detail))
    if now.silent is not None:
        found.append(Obstacle(now.silent.reason, now.silent.detail))
    if now.state is not None:
        found += _state_obstacles(narrowed, request, now.state)
    noise, step = config.noise_std_hint or 0.0, narrowed.sp_deviation
    if noise > MAX_NOISE * step:
        text = f"the noise of {noise:g} {config.pv_unit} (noise_std_hint) is above {MAX_NOISE:.0%} of the step {step:g}"
        found.append(Obstacle(Reason.NOISE_TOO_HIGH, text))
    return found


def _ramp_obstacles(config: LoopConfig, request: RetuneRequest, facts: Facts, mode: Mode) -> list[Obstacle]:
    """Returns the obstacle where ramps of the set-point are too slow for pulses, and nothing may follow them."""
    pulses = request.pulses_setpoint or excitations(config, request, mode) == (Excitation.SETPOINT,)
    if not pulses:
        return []
    try:
        check_ramp(facts, config.noise_std_hint or 0.0)
    except Refused as refused:
        return [Obstacle(refused.reason, refused.detail)]
    return []


def _state_obstacles(config: LoopConfig, request: RetuneRequest, state: LoopState) -> list[Obstacle]:
    """Returns the obstacles in the state of the loop. config: the configuration with the limits of the job."""
    found: list[Obstacle] = []
    if state.node_state != OPERATIONAL:
        found.append(Obstacle(Reason.NODE_NOT_OPERATIONAL, state.node_state))
    if state.on_trial or state.mode is Mode.EXPERIMENT:
        text = "gains are on trial, or a relay is running, that no job of this service has started"
        found.append(Obstacle(Reason.LOOP_IN_USE, text))
    elif (wrong := wrong_mode(config, request, state.mode)) is not None:
        found.append(Obstacle(Reason.WRONG_MODE, wrong))
    found += [Obstacle(Reason.BAD_LIMITS, text) for text in broken_from(config, request, state)]
    try:
        facts = facts_of(config, state)
    except Refused as refused:
        return [*found, Obstacle(refused.reason, refused.detail)]
    if not math.isfinite(state.pv) or not math.isfinite(state.mv):
        return [*found, Obstacle(Reason.BAD_SAMPLE, f"PV is {state.pv}, MV is {state.mv}")]
    mv = _mv_obstacles(config, request, state, facts.mv_low, facts.mv_high)
    return found + mv + _pv_obstacles(config, request, state) + _ramp_obstacles(config, request, facts, state.mode)


def _mv_obstacles(
    config: LoopConfig, request: RetuneRequest, state: LoopState, low: float, high: float
) -> list[Obstacle]:
    mv = state.mv
    room, minimum = min(high - mv, mv - low), MIN_ROOM * (high - low)
    if room < minimum:
        text = f"MV {mv:.4g} leaves {room:.3g} of room within {low:.4g} .. {high:.4g}; at least {minimum:.3g} is needed"
        return [Obstacle(Reason.SATURATED, text)]
    maximum = max_amplitude(mv, low, high, config.test.mv_step_max or math.inf)
    asked = request.relay_amplitude_pct
    fits_nowhere = asked is not None and (1.0 + BIAS) * asked > high - low  # `narrow` has reported this already
    by_relay = "relay" in stages_asked(config, request, state.mode)
    if asked is not None and asked > maximum and not fits_nowhere and by_relay:
        text = (
            f"a relay of amplitude_pct {asked:g} moves MV from {mv:.4g} to {mv - BIAS * asked:.4g} and "
            f"{mv + asked:.4g} %, which is not within {low:.4g} .. {high:.4g}: at most {maximum:.4g} fits"
        )
        return [Obstacle(Reason.BAD_LIMITS, text)]
    return []


def _pv_obstacles(config: LoopConfig, request: RetuneRequest, state: LoopState) -> list[Obstacle]:
    found: list[Obstacle] = []
    step, noise = config.sp_deviation, config.noise_std_hint
    # one reading is not a mean: a noise that the configuration does not state may be as large as is permitted
    maximum = MAX_AWAY * step + 4.0 * (MAX_NOISE * step if noise is None else noise)
    in_manual = Excitation.MANUAL in excitations(config, request, state.mode)
    away = 0.0 if in_manual else state.pv - state.sp
    limits, unit = config.pv_limits, config.pv_unit
    if not limits.low <= state.pv <= limits.high:
        text = f"PV {state.pv:.5g} {unit} is outside {limits.low:g} .. {limits.high:g}"
        found.append(Obstacle(Reason.PV_LIMIT, text))
    if abs(away) > maximum:
        text = (
            f"PV is {away:+.3g} {unit} off the set-point at this moment, and at most {maximum:.3g} would be at rest; a "
            f"retune tries {MAX_ATTEMPTS} times, half a T95 each, before it gives up"
        )
        found.append(Obstacle(Reason.NOT_AT_REST, text))
    if request.model is not None and (sign(request.model.plant()) > 0.0) != state.reverse_acting:
        acts = "reverse" if state.reverse_acting else "direct"
        found.append(Obstacle(Reason.WRONG_SIGN, f"the sign of the model's gain does not agree with a {acts} action"))
    return found
