"""What other methods, or another Ms, would make of what a job found, each with the wish that tries it on the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from loopwright.service.errors import Conflict
from loopwright.service.job_states import ACTIVE
from loopwright.service.jobs.relay_record import RelayRecord
from loopwright.service.offline.tunings import MethodResult, answer, tune_each
from loopwright.service.planning.found_model import DISPROVED, FoundModel, found_model, model_of
from loopwright.service.request import ProcessModel
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.tuning.analysis.assessment import Assessment, assess
from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.fast.design_trial import designed_on
from loopwright.tuning.fast.evaluation import evaluate_again
from loopwright.tuning.fast.procedure import FAST, FastOptions
from loopwright.tuning.fast.proposal import delayed
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction
from loopwright.tuning.reasons import Ended, Reason, Refused
from loopwright.tuning.rules.design import MIN_GM, MAX_Ms
from loopwright.tuning.rules.registry import METHODS, Method
from loopwright.tuning.rules.setting import Setting


def _rule(model: Model, Ms: float = 1.6, derivative: bool = False) -> Setting:
    return Setting(designed_on(model, FastOptions(Ms=Ms, derivative=derivative), 0.0).gains, {"Ms": Ms})


ANYWAY = {"propose_anyway": True}
"""Who chooses one of several has seen what it is worth."""
FAST_DESIGN = Method(
    name=FAST,
    title="The design of fast",
    source="docs/fast.md",
    for_what="The best set-point and load answers for a robustness that is asked for.",
    needs="any stable model, or integrating",
    takes=(FOPDT, SOPDT, Integrating, TransferFunction),
    rule=_rule,
)


def alternatives(row: Job, events: Sequence[JobEvent], method: str | None = None) -> dict[str, Any]:
    """The JSON object of GET /jobs/{id}/alternatives: by the method named, else by all that are not slow.

    Raises Conflict for a job that has no model (yet) or has disproved it, BadTuning for an unknown method.
    """
    model = job_model(row, events)
    _not_disproved(row, DISPROVED)
    names = [method] if method else [name for name, each in METHODS.items() if not each.slow]
    found = tune_each(model, names)
    told = answer(model, found)
    for each, shown in zip(found, told["methods"], strict=True):
        shown |= {"retune": _retune(each, model), "uncertainty": None, "ambiguity": None}
    return {"job": row.id, "loop": row.loop, **told}


def redesigned(
    row: Job, events: Sequence[JobEvent], record: RelayRecord | None, ms: float, derivative: bool
) -> dict[str, Any]:
    """The same object with the gains of fast for another Ms: no new experiment.

    record: the job's, if it is kept; else, and for a job of another method, the model that it found is designed on.
    Raises Conflict as `alternatives` does; a record is judged anew.
    """
    model = job_model(row, events)
    doubt: dict[str, float | None] = {"uncertainty": None, "ambiguity": None}
    evidence = record.experiment_record() if record and row.request.get("method") == FAST else None
    _not_disproved(row, (Reason.WRONG_SIGN,) if evidence else DISPROVED)
    try:
        if evidence is not None:
            evaluation = evaluate_again(evidence, DesignSpec(ms, derivative))
            model, gains = evaluation.model, evaluation.best.gains
            doubt = {"uncertainty": evaluation.uncertainty, "ambiguity": evaluation.ambiguity}
            if evaluation.reason is not None:
                raise Refused(evaluation.reason, evaluation.detail)
            sampled: Model = delayed(model, evaluation.design_delay)
        else:
            Ts = (row.found or {}).get("sample_time_s") or 0.0
            sampled = delayed(model, 0.5 * Ts)
            gains = designed_on(model, FastOptions(Ms=ms, derivative=derivative), Ts).gains
        found = _tuned(gains, ms, assess(sampled, gains))
    except Ended as refusal:
        found = MethodResult(FAST_DESIGN, refusal=refusal)
    told = answer(model, [found])
    retune = None
    if found.gains is not None:
        asked = {"num": list(model.num), "den": list(model.den), "dead_time_s": model.L}
        retune = {"method": FAST, "start": "design", "ms": ms, "derivative": derivative, "model": asked} | ANYWAY
    told["methods"][0] |= {"retune": retune, **doubt}
    return {"job": row.id, "loop": row.loop, **told}


def _tuned(gains: Gains, ms: float, assessed: Assessment) -> MethodResult:
    notes = ("Margins and figures are of the model and half a sample's delay.",)
    return MethodResult(FAST_DESIGN, gains, {"Ms": ms}, notes, assessed)


def job_model(row: Job, events: Sequence[JobEvent]) -> FoundModel:
    """The model of the job's result, else the last that a stage found, else the one typed in; or Conflict."""
    if row.state in ACTIVE:
        raise Conflict(f"job {row.id} is not over: it has no model to compare methods on yet")
    model = found_model(row, events) or model_of(row.request.get("model") or {})
    if model is not None:
        return model
    raise Conflict(f"job {row.id} ended as {row.state} before it had a model")


def _not_disproved(row: Job, reasons: Sequence[Reason]) -> None:
    if row.reason in reasons:
        text = f"job {row.id} ended as {row.reason}, which speaks against its model ({row.detail})"
        raise Conflict(f"{text}: retune instead")


def _retune(found: MethodResult, model: FoundModel) -> dict[str, Any] | None:
    """None for gains that the service would not try on a loop (see `tuning.rules.design`), and for those of a rule on a
    model that the five stages do not take."""
    if found.assessment is None or isinstance(model, TransferFunction):
        return None
    m = found.assessment.margins
    if not (m.stable and m.Ms <= MAX_Ms and (m.GM is None or m.GM >= MIN_GM)):
        return None
    asked = ProcessModel(K=model.K, T_s=model.T, L_s=model.L, zeta=model.zeta if isinstance(model, SOPDT) else None)
    return {"start": "optimise", "method": found.method.name, "model": asked.model_dump(exclude_none=True)} | ANYWAY
