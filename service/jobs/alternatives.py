"""The gains of other methods, or for another Ms, from a job's model, each with the request that tries them on the
loop."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.service.errors import Conflict
from loopwright.service.inputs.model_json import dump_model, parse_model
from loopwright.service.jobs.stored_record import StoredRecord
from loopwright.service.jsonable import JsonObject, json_object
from loopwright.service.offline.tunings import MethodResult, answer, tune_each
from loopwright.service.planning.curves import horizons, loop_curves
from loopwright.service.planning.found_model import DISPROVED, FoundModel, found_model
from loopwright.service.results import DESIGNED
from loopwright.service.states.job_state import ACTIVE
from loopwright.service.states.loop_state import gains_of, loop_state
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.tuning.analysis.assessment import Assessment, assess
from loopwright.tuning.fast.design.design import Aim, DesignSpec, OptimalGains, aim_of
from loopwright.tuning.fast.design.options import weights_up_to
from loopwright.tuning.fast.evaluation.proposal import delayed
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.fast.known_plant.by_model import BY_MODEL
from loopwright.tuning.fast.known_plant.design_trial import designed_on
from loopwright.tuning.fast.relay.procedure import FAST
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Ended, Reason, Refused
from loopwright.tuning.rules.design import MIN_GM, MAX_Ms
from loopwright.tuning.rules.registry import METHODS

ANYWAY = {"propose_anyway": True}
"""Option of such a request: the operator who chooses the gains has seen their figures."""
NO_GAINS = (Reason.WRONG_SIGN, Reason.CONTROLLER_MISMATCH)
"""Reasons for which a job ends that speak against gains for this controller on any model."""


def alternatives(row: Job, events: Sequence[JobEvent], method: str | None = None) -> JsonObject:
    """Returns the JSON object of GET /jobs/{id}/alternatives, for the named method, else for all that are not slow.

    Raises Conflict for a job that has no model (yet) or has disproved it, BadTuning for an unknown method.
    """
    model = designable(row, events, has_record=False)
    names = [method] if method else [name for name, each in METHODS.items() if not each.slow]
    results = tune_each(model, names)
    body = answer(model, results)
    Ts = _sample_time_s(row)
    for each, shown in zip(results, body["methods"], strict=True):
        curves = _curves(row, delayed(model, 0.5 * Ts), each.gains, Ts)
        shown |= {"retune": _retune(each, model), "uncertainty": None, "ambiguity": None, "curves": curves}
    return json_object({"job": row.id, "loop": row.loop, **body})


def redesigned(row: Job, events: Sequence[JobEvent], record: StoredRecord | None, spec: DesignSpec) -> JsonObject:
    """Returns the same object with the gains of fast for another specification, without a new experiment.

    record: the job's record, if it is stored; without it, and for a job of another method, the gains are designed for
    the job's model.
    Raises Conflict as `alternatives` does; a record is evaluated again.
    """
    doubt: dict[str, float | None] = {"uncertainty": None, "ambiguity": None}
    Ts = _sample_time_s(row)
    evidence = record.experiment_record() if record and row.request.get("method") in DESIGNED else None
    model = designable(row, events, evidence is not None)
    try:
        if evidence is not None:
            evaluation = evaluate_again(evidence, spec)
            model, best = evaluation.model, evaluation.best
            doubt = {"uncertainty": evaluation.uncertainty, "ambiguity": evaluation.ambiguity}
            if evaluation.reason is not None:
                raise Refused(evaluation.reason, evaluation.detail)
            sampled: Model = delayed(model, evaluation.design_delay)
        else:
            sampled = delayed(model, 0.5 * Ts)
            best = designed_on(model, spec, Ts)
        result = _tuned(best, spec, assess(sampled, best.gains))
    except Ended as refusal:
        result = MethodResult(BY_MODEL, refusal=refusal)
    body = answer(model, [result])
    retune = curves = None
    if result.gains is not None:
        curves = _curves(row, sampled, result.gains, Ts)
        asked = {"num": list(model.num), "den": list(model.den), "dead_time_s": model.L}
        retune = json_object({"method": FAST, "start": "design", **options_of(spec), "model": asked} | ANYWAY)
    body["methods"][0] |= {"retune": retune, **doubt, "curves": curves}
    return json_object({"job": row.id, "loop": row.loop, **body})


def _sample_time_s(row: Job) -> float:
    return loop_state(row.found).sample_time_s if row.found else 0.0


def _curves(row: Job, sampled: Model, gains: Gains | None, Ts: float) -> JsonObject | None:
    """Returns the curves of gains on the model with the delay of the sampling, as long as those of the job's own."""
    if gains is None:
        return None
    found = loop_curves(sampled, gains, horizons(sampled, (new_gains(row), gains), Ts), Ts)
    return None if found is None else json_object(found.model_dump())


def options_of(spec: DesignSpec) -> dict[str, bool | float | str]:
    """Returns the options of a request for gains of this specification."""
    return {"Ms": spec.Ms, "derivative": spec.derivative, "aim": spec.aim, **spec.requirements}


def _tuned(best: OptimalGains, spec: DesignSpec, assessed: Assessment) -> MethodResult:
    notes = ("Margins and figures are of the model and half a sample's delay.",)
    return MethodResult(BY_MODEL, best.gains, {"Ms": best.Ms, **spec.requirements}, notes, assessed)


def asked_spec(row: Job, Ms: float) -> DesignSpec:
    """Returns the specification that the job asked for, with another Ms; the defaults where a job of another method
    has asked for nothing. The settling time is left out: it is a way to choose an Ms."""

    def number(name: str) -> float | None:
        value = row.request.get(name)
        return float(value) if isinstance(value, int | float) else None

    aim = aim_of(str(row.request.get("aim", Aim.BALANCED)))
    derivative = bool(row.request.get("derivative"))
    weights = weights_up_to(number("setpoint_weight_max"))
    return DesignSpec(
        Ms, derivative, noise_gain=number("noise_gain"), aim=aim, mv_peak=number("mv_peak"), weights=weights
    )


def new_gains(row: Job) -> Gains | None:
    """Returns the gains of the result of a job; None where it has none."""
    return None if row.result is None or row.result.new_gains is None else row.result.new_gains.gains()


def previous_gains(row: Job) -> Gains | None:
    """Returns the gains before a job; of a rehearsal, which finds none on a loop, those of its result. None where
    neither is known."""
    if row.previous_gains:
        return gains_of(row.previous_gains)
    return None if row.result is None or row.result.previous_gains is None else row.result.previous_gains.gains()


def job_model(row: Job, events: Sequence[JobEvent]) -> FoundModel:
    """Returns the model of the job's result, else the last one of a stage, else the one entered. Raises Conflict."""
    if row.state in ACTIVE:
        raise Conflict(f"job {row.id} is not over: it has no model to compare methods on yet; ask again when it is")
    model = found_model(row, events) or _typed_in(row)
    if model is not None:
        return model
    raise Conflict(f"job {row.id} ended as {row.state} before it had a model to compare methods on; the job says why")


def designable(row: Job, events: Sequence[JobEvent], has_record: bool) -> FoundModel:
    """Returns the model of a job, if gains may be designed on it. Raises Conflict as `alternatives` does.

    has_record: whether the record is evaluated again; then its evaluation finds what else speaks against the model.
    """
    model = job_model(row, events)
    _not_disproved(row, NO_GAINS if has_record else (*DISPROVED, *NO_GAINS))
    return model


def _typed_in(row: Job) -> FoundModel | None:
    asked = row.request.get("model")
    model = parse_model(asked) if asked else None
    return TransferFunction(model.num, model.den, model.L) if isinstance(model, Integrating) else model


def _not_disproved(row: Job, reasons: Sequence[Reason]) -> None:
    if row.reason in reasons:
        what = "its controller" if row.reason == Reason.CONTROLLER_MISMATCH else "its model"
        text = f"job {row.id} ended as {row.reason}, which speaks against {what} ({row.detail})"
        raise Conflict(f"{text}: retune instead")


def _retune(result: MethodResult, model: FoundModel) -> JsonObject | None:
    """Returns the request that tries the gains on the loop; None for gains that the service would not try (see
    `tuning.rules.design`), and for those of a rule on a model that the five stages do not take."""
    if result.assessment is None or isinstance(model, TransferFunction):
        return None
    m = result.assessment.margins
    if not (m.stable and m.Ms <= MAX_Ms and (m.GM is None or m.GM >= MIN_GM)):
        return None
    return json_object({"start": "optimise", "method": result.method.name, "model": dump_model(model)} | ANYWAY)
