"""The two kinds of work a job can be: tuning the live loop, and rehearsing in memory. Injected into the jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from service.config import LoopConfig
from service.loop import Loop, LoopState
from service.moves import broken_limits
from service.plain import plain_object
from service.request import ProcessModel, RetuneRequest
from service.store.tables import EventRow
from tuning.fast.procedure import FAST
from tuning.models import Model
from tuning.plan import Event, Plan, Sample
from tuning.reasons import Aborted, Ended, Failed, Reason, Refused
from tuning.stages.common import Facts
from tuning.stages.settle import after_settling

if TYPE_CHECKING:
    from service.computing import Workers

TIME_BUDGET_T95 = {FAST: 100.0}
OTHER_BUDGET_T95 = 500.0
LEAST_BUDGET_SAMPLES = 1000
"""Of a loop whose T95 is a few samples: the time at rest alone is counted in samples."""
FROZEN_T95 = 3.0
_STOPPED = (Reason.OPERATOR, Reason.SERVICE_STOPPED)


@dataclass(frozen=True)
class Hooks:
    """How work reports, and how it learns that it should stop.

    remember: told the number of a session before it is opened.  on_home: told what the loop must come back to.
    earlier: what the earlier attempts of a job that is resumed have stored; a stage done there is not run again.
    """

    on_event: Callable[[Event], None]
    on_samples: Callable[[list[Sample]], None]
    stop: Callable[[], Reason | None]
    earlier: Sequence[EventRow] = ()
    remember: Callable[[int], None] = lambda session: None
    on_home: Callable[[LoopState], None] = lambda home: None


@dataclass(frozen=True)
class Outcome:
    """How work ended: a result, or the reason why not. Plain JSON values; plant times in s per stage."""

    result: dict[str, Any] | None
    ended: Ended | None
    restored: LoopState | None
    plant_time_s: dict[str, float]


class Tune(Protocol):
    """Tunes a live loop whose present state is `state`; restores it on every way out."""

    def __call__(
        self, config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks
    ) -> Outcome: ...


class Rehearse(Protocol):
    """Rehearses the same procedure on a model in memory."""

    def __call__(self, config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome: ...


def tune(
    config: LoopConfig,
    request: RetuneRequest,
    loop: Loop,
    state: LoopState,
    hooks: Hooks,
    workers: Workers | None = None,
) -> Outcome:
    """The procedure asked for on the live loop. workers: who computes, by default a thread."""
    from service.computing import Computing
    from service.runner import Watch, run

    facts = facts_of(config, state)
    broken = broken_limits(config, request, state.sp)
    if broken:
        raise Refused(Reason.BAD_LIMITS, "; ".join(broken))
    watch = Watch(
        pv_low=config.pv_limits.low,
        pv_high=config.pv_limits.high,
        mv_low=facts.mv_low,
        mv_high=facts.mv_high,
        max_time_s=request.max_time_s or time_budget_s(request.method, facts.T95_s, facts.sample_time_s),
        max_frozen_s=FROZEN_T95 * config.t95_s,
    )
    computing = Computing(loop, workers)
    ran = run(
        plan(request, facts, hooks.earlier),
        computing,
        watch=watch,
        on_event=hooks.on_event,
        on_samples=hooks.on_samples,
        stop=hooks.stop,
        start_work=computing.start,
        remember=hooks.remember,
        on_home=hooks.on_home,
    )
    return Outcome(plain_object(ran.value), ran.ended, ran.restored, dict(ran.plant_time_s))


def facts_of(config: LoopConfig, state: LoopState) -> Facts:
    """What the procedures know of a loop; the limits of MV are the narrower of the job's and the controller's own.

    Raises Refused: BAD_LIMITS, SAMPLING_TOO_SLOW.
    """
    return Facts(
        sample_time_s=state.sample_time_s,
        T95_s=config.t95_s,
        mv_low=max(config.mv_limits.low, state.mv_low),
        mv_high=min(config.mv_limits.high, state.mv_high),
        sp_deviation=config.sp_deviation,
        old_gains=state.gains,
        reverse=state.reverse_acting,
    )


def plan(request: RetuneRequest, facts: Facts, earlier: Sequence[EventRow] = ()) -> Plan[Any]:
    """earlier: events of attempts that were cut off, after which the loop gets time to come to rest. What fast had
    recorded by then is not gone on with: relay and set-point step are one record, of a loop not touched in between.
    """
    procedure = _procedure(request, facts, earlier)
    return after_settling(facts, procedure) if earlier else procedure


def _procedure(request: RetuneRequest, facts: Facts, earlier: Sequence[EventRow]) -> Plan[Any]:
    if request.fast:
        from tuning.fast.procedure import FastOptions, fast
        from tuning.fast.trial import trial

        wishes = FastOptions(**_options(request))
        known = _known_model(request)
        return fast(facts, wishes) if known is None else trial(facts, wishes, known)
    from service.checkpoints import finished
    from tuning.five_stage import Options, five_stage

    done = ((event.data["stage"], event.data["result"]) for event in earlier if event.kind == "stage_done")
    return five_stage(facts, Options(**_options(request)), finished(done))


def time_budget_s(method: str, t95_s: float, sample_time_s: float) -> float:
    """Plant time, s: several times what a loop of this T95 takes."""
    budget = TIME_BUDGET_T95.get(method, OTHER_BUDGET_T95) * t95_s
    return max(budget, LEAST_BUDGET_SAMPLES * sample_time_s)


def rehearse(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    """The same on a model in memory; answers as the live loop would."""
    from service.rehearsal import rehearse as rehearse_spec

    spec = rehearsal_spec(config, request)
    options = _options(request)
    if request.fast:
        options["model"] = _known_model(request)
    # A model typed in for a dry run is the plant itself; the procedure still starts where the request says.
    answer = rehearse_spec(spec, on_event=hooks.on_event, on_samples=hooks.on_samples, **options)
    times = {name: float(value) for name, value in (answer.get("plant_time_s") or {}).items() if name != "total"}
    if answer["outcome"] == "proposed":
        return Outcome(_as_proposal(answer), None, None, times)
    reason = _reason(answer.get("reason"))
    kind = Aborted if reason in _STOPPED else Refused if answer["outcome"] == "refused" else Failed
    return Outcome(None, kind(reason, str(answer.get("detail") or "")), None, times)


def _known_model(request: RetuneRequest) -> Model | None:
    """What fast designs for without a relay."""
    return request.model.plant() if request.start == "design" and request.model else None


def _options(request: RetuneRequest) -> dict[str, Any]:
    """The request in the words of tuning.fast.procedure.FastOptions or tuning.five_stage.Options."""
    if request.fast:
        return {
            "Ms": request.ms,
            "derivative": request.derivative,
            "amplitude": request.amplitude_pct,
            "careful": request.careful,
            "verify": request.verify,
        }
    model = request.model
    return {
        "start": request.start,
        "Ku": request.Ku,
        "Pu_s": request.Pu_s,
        "Kp": request.Kp,
        "Ti_s": request.Ti_s,
        "overshoot_pct": request.overshoot_pct,
        "model": model.plant() if isinstance(model, ProcessModel) else None,
        "k_source": request.k_source,
        "kp_step_factor": request.kp_step_factor,
        "overshoot_window_pct": request.overshoot_window_pct,
        "method": request.method,
        "method_options": request.method_options,
        "model_from": request.model_from,
        "baseline": request.baseline is not False,
        "verify": request.verify,
    }


def _as_proposal(answer: dict[str, Any]) -> dict[str, Any]:
    """A rehearsal's answer under the names of a live job's result."""
    ultimate, model, measured = (answer.get(key) or {} for key in ("ultimate", "model", "measured"))
    told = {
        "ultimate": {"Ku": ultimate["Ku"], "Pu_s": ultimate["Pu"]} if ultimate else None,
        "method": answer.get("method"),
        "chosen": answer.get("chosen") or {},
        "old_gains": (answer.get("input") or {}).get("gains"),
        "gains": answer.get("gains"),
        "predicted": answer.get("predicted"),
        "baseline": measured.get("before"),
        "verification": measured.get("after"),
        "notes": answer.get("notes") or [],
        "input": answer.get("input"),
    }
    if answer["method"] == FAST:
        return told | {name: answer.get(name) for name in ("model", "predicted_before", "found", "verified")}
    known = {"K": model["K"], "T_s": model["T"], "L_s": model["L"]}
    return told | {"model": known | {key: model.get(key) for key in ("zeta", "k_source", "fit_pct")}}


def rehearsal_spec(config: LoopConfig, request: RetuneRequest) -> dict[str, Any]:
    """The plant to rehearse on: the one given, else the model given, else a guess from the loop's configuration."""
    middle = 0.5 * (config.mv_limits.low + config.mv_limits.high)
    spec: dict[str, Any] = {
        "name": config.tag,
        "t95_s": config.t95_s,
        "sp_deviation": config.sp_deviation,
        "mv_limits": [config.mv_limits.low - middle, config.mv_limits.high - middle],
        "noise_std": config.noise_std_hint or 0.0,
        "seed": 1,
    }
    if request.plant is not None:
        return spec | request.plant.model_dump(exclude_none=True)
    if request.model is not None:
        plant = request.model.plant()
        return spec | {"num": list(plant.num), "den": list(plant.den), "dead_time_s": plant.L}
    # Nothing is known but T95 = L + 3 T (a FOPDT's 95 % time): a fifth of it as dead time is a typical loop, and a
    # tenth of the MV range for the permitted set-point step is a loop that was sized sensibly.
    dead_time = 0.2 * config.t95_s
    gain = config.sp_deviation / (0.1 * (config.mv_limits.high - config.mv_limits.low))
    return spec | {"num": [gain], "den": [(config.t95_s - dead_time) / 3.0, 1.0], "dead_time_s": dead_time}


def _reason(text: object) -> Reason:
    return Reason(text) if isinstance(text, str) and text in set(Reason) else Reason.INTERNAL
