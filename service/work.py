"""The two kinds of work a job can be: tuning the live loop, and rehearsing in memory. Injected into the jobs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from service.config import LoopConfig
from service.loop import Loop, LoopState
from service.plain import plain_object
from service.request import RetuneRequest
from service.store.tables import EventRow
from tuning.plan import Event, Sample
from tuning.reasons import Aborted, Ended, Failed, Reason, Refused

TIME_BUDGET_T95 = 500.0
FROZEN_T95 = 3.0
_STOPPED = (Reason.OPERATOR, Reason.SERVICE_STOPPED)


@dataclass(frozen=True)
class Hooks:
    """How work reports, and how it learns that it should stop.

    earlier: what the earlier attempts of a job that is resumed have stored; a stage done there is not run again.
    """

    on_event: Callable[[Event], None]
    on_samples: Callable[[list[Sample]], None]
    stop: Callable[[], Reason | None]
    earlier: Sequence[EventRow] = ()


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


def tune(config: LoopConfig, request: RetuneRequest, loop: Loop, state: LoopState, hooks: Hooks) -> Outcome:
    """The five stages on the live loop."""
    from service.checkpoints import finished
    from service.runner import Watch, run
    from tuning.five_stage import Facts, Options, five_stage

    facts = Facts(
        sample_time_s=state.sample_time_s,
        T95_s=config.t95_s,
        mv_low=max(config.mv_limits.low, state.mv_low),
        mv_high=min(config.mv_limits.high, state.mv_high),
        sp_deviation=config.sp_deviation,
        old_gains=state.gains,
        reverse=state.reverse_acting,
    )
    options = Options(**_options(request))
    watch = Watch(
        pv_low=config.pv_limits.low,
        pv_high=config.pv_limits.high,
        mv_low=facts.mv_low,
        mv_high=facts.mv_high,
        max_time_s=request.max_time_s or TIME_BUDGET_T95 * config.t95_s,
        max_frozen_s=FROZEN_T95 * config.t95_s,
    )
    done = ((event.data["stage"], event.data["result"]) for event in hooks.earlier if event.kind == "stage_done")
    ran = run(
        five_stage(facts, options, finished(done)),
        loop,
        watch=watch,
        on_event=hooks.on_event,
        on_samples=hooks.on_samples,
        stop=hooks.stop,
        start_work=lambda work: threading.Thread(target=work, daemon=True, name="computation").start(),
    )
    return Outcome(plain_object(ran.value), ran.ended, ran.restored, dict(ran.plant_time_s))


def rehearse(config: LoopConfig, request: RetuneRequest, hooks: Hooks) -> Outcome:
    """The five stages on a model in memory; answers as the live loop would."""
    from service.rehearsal import rehearse as rehearse_spec

    spec = rehearsal_spec(config, request)
    # A model typed in for a dry run is the plant itself; the procedure still starts where the request says.
    answer = rehearse_spec(spec, on_event=hooks.on_event, **_options(request))
    times = {name: float(value) for name, value in (answer.get("plant_time_s") or {}).items() if name != "total"}
    if answer["outcome"] == "proposed":
        return Outcome(_as_proposal(answer), None, None, times)
    reason = _reason(answer.get("reason"))
    kind = Aborted if reason in _STOPPED else Refused if answer["outcome"] == "refused" else Failed
    return Outcome(None, kind(reason, str(answer.get("detail") or "")), None, times)


def _options(request: RetuneRequest) -> dict[str, Any]:
    """The request in the words of tuning.five_stage.Options."""
    model = request.model
    return {
        "start": request.start,
        "Ku": request.Ku,
        "Pu_s": request.Pu_s,
        "Kp": request.Kp,
        "Ti_s": request.Ti_s,
        "overshoot_pct": request.overshoot_pct,
        "model": model.plant() if model else None,
        "k_source": request.k_source,
        "kp_step_factor": request.kp_step_factor,
        "overshoot_window_pct": request.overshoot_window_pct,
        "method": request.method,
        "method_options": request.method_options,
        "model_from": request.model_from,
        "baseline": request.baseline,
        "verify": request.verify,
    }


def _as_proposal(answer: dict[str, Any]) -> dict[str, Any]:
    """A rehearsal's answer under the names of a live job's result."""
    ultimate, model, measured = (answer.get(key) or {} for key in ("ultimate", "model", "measured"))
    return {
        "ultimate": {"Ku": ultimate["Ku"], "Pu_s": ultimate["Pu"]} if ultimate else None,
        "method": answer.get("method"),
        "chosen": answer.get("chosen") or {},
        "model": model and {"K": model["K"], "T_s": model["T"], "L_s": model["L"]}
        | {key: model.get(key) for key in ("zeta", "k_source", "fit_pct")},
        "old_gains": (answer.get("input") or {}).get("gains"),
        "gains": answer.get("gains"),
        "predicted": answer.get("predicted"),
        "baseline": measured.get("before"),
        "verification": measured.get("after"),
        "notes": answer.get("notes") or [],
        "input": answer.get("input"),
    }


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
