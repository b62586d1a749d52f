"""Chooses the plant and the controller that a dry run rehearses on, and states where each of the two comes from."""

from __future__ import annotations

from dataclasses import dataclass, replace

from numpy.linalg import LinAlgError

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import PlantModel, RetuneRequest
from loopwright.service.planning.found_model import FoundModel
from loopwright.service.results import GainsSource, PlantSource, RehearsedOnView
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, Model
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Ended

MAX_GUESS_Ms = 2.5
"""Largest Ms of the present gains on a guessed plant: the loop works today, so the guess must let it work."""
LOWER, MAX_LOWERED = 0.5, 20
"""Factor by which the gain of a guessed plant is lowered, and how often at most."""
MAX_SAMPLES_IN_T95 = 20_000
"""More samples in T95 make a rehearsal slow and do not change its result."""


@dataclass(frozen=True, slots=True)
class LastModel:
    """The last model found on a loop.

    job: the id of the job that found the model.
    ended_at: the end of that job, UTC, ISO 8601.
    """

    model: FoundModel
    job: str
    ended_at: str


@dataclass(frozen=True, slots=True)
class Ground:
    """What is known of a loop before a dry run of it.

    last_model: the last model found on the loop; None where there is none.
    state: the state that the controller answered, or that the job `state_job` found; None where neither is known.
    silence: why the controller did not answer; empty where it answered.
    """

    last_model: LastModel | None = None
    state: LoopState | None = None
    state_job: str | None = None
    silence: str = "the controller was not asked"

    @property
    def mode(self) -> Mode:
        """Returns the mode of the loop; automatic where it is not known."""
        return Mode.AUTOMATIC if self.state is None else self.state.mode

    @property
    def gains_source(self) -> GainsSource:
        if self.state is None:
            return GainsSource.ASSUMED
        return GainsSource.LAST_JOB if self.silence else GainsSource.CONTROLLER


def rehearsal_spec(
    config: LoopConfig, request: RetuneRequest, ground: Ground
) -> tuple[dict[str, object], RehearsedOnView]:
    """Returns the fields of `service.execution.rehearsal.PlantFile`, and the description of the plant and the gains.

    The plant is the one given, else the last model found, else a guess. Gains, sample time, limits and action are those
    of the loop's controller where they are known.
    """
    state, low, high = ground.state, config.mv_limits.low, config.mv_limits.high
    spec: dict[str, object] = {
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
    spec |= config.test.model_dump(include={"mv_step_max", "directions", "sp_rate_max_per_s"})

    last = ground.last_model
    source, job, ended_at = PlantSource.GIVEN, None, None
    if request.plant is not None:
        spec |= request.plant.model_dump(exclude_none=True)
        plant: PlantModel | Model = request.plant
        dead_time_s = request.plant.dead_time_s
        text = "the plant given"
    elif request.model is not None:
        plant = request.model.plant()
        text = "the model given"
    elif last is not None:
        source, job, ended_at = PlantSource.LAST_MODEL, last.job, last.ended_at
        plant = last.model
        text = f"the model that job {last.job} found ({last.ended_at[:16].replace('T', ' ')} UTC)"
    else:
        source = PlantSource.GUESSED
        plant, lowered = _guess(config, state)
        text = f"a guessed plant (from T95 {config.t95_s:g} s, MV {low:g} to {high:g} %, step {config.sp_deviation:g}"
        text += ", and such that the present gains are stable on it)" if lowered else ")"
    if not isinstance(plant, PlantModel):
        dead_time_s = plant.L
        spec |= {"num": list(plant.num), "den": list(plant.den), "dead_time_s": plant.L}
    on = RehearsedOnView(
        plant_source=source,
        plant_job=None if job is None else f"/jobs/{job}",
        plant_job_ended_at=ended_at,
        num=[float(c) for c in plant.num],
        den=[float(c) for c in plant.den],
        dead_time_s=dead_time_s,
        gains_source=ground.gains_source,
        gains_job=None if ground.state_job is None else f"/jobs/{ground.state_job}",
        plant_text=text,
        gains_text=_gains_text(ground, too_fast="sample_time_s" not in spec),
    )
    return spec, on


def _gains_text(ground: Ground, too_fast: bool) -> str:
    slower = ""
    if ground.state is not None and too_fast:
        slower = (
            f"; the sample time {ground.state.sample_time_s:g} s is too short for this T95, so a longer one is used"
        )
    if ground.gains_source is GainsSource.CONTROLLER:
        return "gains, sample time, limits and action as the controller has them" + slower
    known = f"as job {ground.state_job} found them" if ground.state_job else "assumed"
    return f"gains, sample time and action {known}: the controller did not answer ({ground.silence}){slower}"


def _guess(config: LoopConfig, state: LoopState | None) -> tuple[FOPDT, bool]:
    """Returns a plant guessed from the configuration, and whether its gain was lowered to suit the present gains.

    T95 = L + 3 T, the 95 % time of a FOPDT. A dead time of a fifth of T95 is typical; in a well-sized loop the
    permitted set-point step takes about a tenth of the MV range.
    """
    dead_time = 0.2 * config.t95_s
    gain = config.sp_deviation / (0.1 * (config.mv_limits.high - config.mv_limits.low))
    plant = FOPDT(gain, (config.t95_s - dead_time) / 3.0, dead_time)
    if state is None:
        return plant, False
    steps = (n for n in range(MAX_LOWERED) if _works(replace(plant, K=LOWER**n * plant.K), state.gains))
    lowered = next(steps, 0)  # gains that work on no such plant are refused by the rehearsal itself, with the reason
    K = LOWER**lowered * plant.K
    return replace(plant, K=K if state.reverse_acting else -K), lowered > 0


def _works(plant: FOPDT, gains: Gains) -> bool:
    try:
        found = margins(plant, gains)
    except (Ended, ArithmeticError, LinAlgError):
        return False
    return found.stable and found.Ms <= MAX_GUESS_Ms


def _fields(gains: Gains) -> dict[str, float]:
    return {name: float(getattr(gains, name)) for name in Gains.__dataclass_fields__}
