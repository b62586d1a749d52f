"""What a dry run rehearses on: which plant and which controller, and where each of the two is known from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from numpy.linalg import LinAlgError

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import RetuneRequest
from loopwright.service.loop_state import LoopState
from loopwright.service.planning.found_model import FoundModel
from loopwright.service.results import GainsSource, PlantSource, RehearsedOnView
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Model
from loopwright.tuning.reasons import Ended

TAMEST_Ms = 2.5
"""Of the present gains on a plant that is guessed: they work, so that a plant on which they would not is no guess."""
LOWER, MAX_LOWERED = 0.5, 20
"""The gain of a guess is lowered by so much, so often at most."""
MAX_SAMPLES_IN_T95 = 20_000
"""Samples: of more, a rehearsal takes long, and shows nothing else."""


@dataclass(frozen=True, slots=True)
class LastModel:
    """The last model found on a loop. ended_at: of the job that found it, UTC, ISO 8601."""

    model: FoundModel
    job: str
    ended_at: str


@dataclass(frozen=True, slots=True)
class Ground:
    """What is known of a loop before a dry run of it.

    state: the controller as it answered, or as the job `state_job` had found it; None: neither.
    silence: why the controller did not answer; empty where it did.
    """

    last_model: LastModel | None = None
    state: LoopState | None = None
    state_job: str | None = None
    silence: str = "it was not asked"

    @property
    def gains_source(self) -> GainsSource:
        if self.state is None:
            return GainsSource.ASSUMED
        return GainsSource.LAST_JOB if self.silence else GainsSource.CONTROLLER


def rehearsal_spec(
    config: LoopConfig, request: RetuneRequest, ground: Ground
) -> tuple[dict[str, Any], RehearsedOnView]:
    """The fields of `service.execution.rehearsal.PlantFile`: the plant given, else the last model found, else a guess;
    with the gains, the sample time, the limits and the action of the loop's own controller, where these are known."""
    state, low, high = ground.state, config.mv_limits.low, config.mv_limits.high
    spec: dict[str, Any] = {
        "name": config.tag,
        "t95_s": config.t95_s,
        "sp_deviation": config.sp_deviation,
        "noise_std": config.noise_std_hint or 0.0,
        "seed": 1,
    }
    if state is not None:
        low, high = max(low, state.mv_low), min(high, state.mv_high)
        spec |= {"gains": _fields(state.gains), "reverse_acting": state.reverse_acting}
        if config.t95_s / MAX_SAMPLES_IN_T95 <= state.sample_time_s:
            spec["sample_time_s"] = state.sample_time_s
    middle = 0.5 * (low + high)
    spec["mv_limits"] = [low - middle, high - middle]

    last = ground.last_model
    source, job, ended_at = PlantSource.GIVEN, None, None
    if request.plant is not None:
        spec |= request.plant.model_dump(exclude_none=True)
        text = "the plant given"
    elif request.model is not None:
        spec |= _plant(request.model.plant())
        text = "the model given"
    elif last is not None:
        source, job, ended_at = PlantSource.LAST_MODEL, last.job, last.ended_at
        spec |= _plant(last.model)
        text = f"the model that job {last.job} found ({last.ended_at[:16].replace('T', ' ')} UTC)"
    else:
        source = PlantSource.GUESSED
        guess, lowered = _guess(config, state)
        spec |= _plant(guess)
        text = f"a guessed plant (from T95 {config.t95_s:g} s, MV {low:g} to {high:g} %, step {config.sp_deviation:g}"
        text += ", and such that the present gains are stable on it)" if lowered else ")"
    num, den = ([float(c) for c in spec[name]] for name in ("num", "den"))
    on = RehearsedOnView(
        plant_source=source,
        plant_job=None if job is None else f"/jobs/{job}",
        plant_job_ended_at=ended_at,
        num=num,
        den=den,
        dead_time_s=spec["dead_time_s"],
        gains_source=ground.gains_source,
        gains_job=None if ground.state_job is None else f"/jobs/{ground.state_job}",
        plant_text=text,
        gains_text=_gains_text(ground, spec.get("sample_time_s")),
    )
    return spec, on


def _gains_text(ground: Ground, sample_time_s: float | None) -> str:
    slower = ""
    if ground.state is not None and sample_time_s is None:
        slower = f"; its sample time, {ground.state.sample_time_s:g} s, is too short beside T95, a longer one is taken"
    if ground.gains_source is GainsSource.CONTROLLER:
        return "gains, sample time, limits and action as the controller has them" + slower
    known = f"as job {ground.state_job} had found them" if ground.state_job else "assumed"
    return f"gains, sample time and action {known}: the controller did not answer ({ground.silence}){slower}"


def _guess(config: LoopConfig, state: LoopState | None) -> tuple[FOPDT, bool]:
    """A plant from what the configuration says, and whether its gain was lowered for the sake of the present gains.

    T95 = L + 3 T (a FOPDT's 95 % time): a fifth of it as dead time is a typical loop, and a tenth of the MV range for
    the permitted set-point step is a loop that was sized sensibly.
    """
    dead_time = 0.2 * config.t95_s
    gain = config.sp_deviation / (0.1 * (config.mv_limits.high - config.mv_limits.low))
    plant = FOPDT(gain, (config.t95_s - dead_time) / 3.0, dead_time)
    if state is None:
        return plant, False
    steps = (n for n in range(MAX_LOWERED) if _works(replace(plant, K=LOWER**n * plant.K), state.gains))
    lowered = next(steps, 0)  # of gains that work on none the rehearsal says what is wrong with them
    K = LOWER**lowered * plant.K
    return replace(plant, K=K if state.reverse_acting else -K), lowered > 0


def _works(plant: FOPDT, gains: Gains) -> bool:
    try:
        found = margins(plant, gains)
    except (Ended, ArithmeticError, LinAlgError):
        return False
    return found.stable and found.Ms <= TAMEST_Ms


def _plant(model: Model) -> dict[str, Any]:
    return {"num": list(model.num), "den": list(model.den), "dead_time_s": model.L}


def _fields(gains: Gains) -> dict[str, float]:
    return {name: float(getattr(gains, name)) for name in Gains.__dataclass_fields__}
