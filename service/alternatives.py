"""What other methods would make of the model that a job found, each with the wish that tries it on the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from service.errors import Conflict
from service.request import ProcessModel
from service.states import ACTIVE, JobState
from service.store.tables import EventRow, JobRow
from service.tunings import Tuned, answer, tune_each
from tuning.design import LEAST_GM, MOST_Ms
from tuning.methods import METHODS
from tuning.models import FOPDT, SOPDT


def alternatives(row: JobRow, events: Sequence[EventRow], method: str | None = None) -> dict[str, Any]:
    """The JSON object of GET /jobs/{id}/alternatives: by the method named, else by all that are not slow.

    Raises Conflict for a job that has no model (yet), BadTuning for an unknown method.
    """
    model = job_model(row, events)
    names = [method] if method else [name for name, each in METHODS.items() if not each.slow]
    found = tune_each(model, names)
    told = answer(model, found)
    for each, shown in zip(found, told["methods"], strict=True):
        shown["retune"] = _retune(each, model)
    return {"job": row.id, "loop": row.loop, **told}


def job_model(row: JobRow, events: Sequence[EventRow]) -> FOPDT | SOPDT:
    """The model of the job's result, else the last that a stage found, else the one typed in; or Conflict."""
    if JobState(row.state) in ACTIVE:
        raise Conflict(f"job {row.id} is not over: it has no model to compare methods on yet")
    results = [event.data.get("result") for event in reversed(events) if event.kind == "stage_done"]
    for data in [(row.result or {}).get("model"), *results, row.request.get("model")]:
        if data and all(isinstance(data.get(name), int | float) for name in ("K", "T_s", "L_s")):
            K, T, L, zeta = data["K"], data["T_s"], data["L_s"], data.get("zeta")
            return FOPDT(K, T, L) if zeta is None else SOPDT(K, T, zeta, L)
    raise Conflict(f"job {row.id} ended as {row.state} before it had a model")


def _retune(found: Tuned, model: FOPDT | SOPDT) -> dict[str, Any] | None:
    """None for gains that the service would not try on a loop (see `tuning.design`)."""
    if found.assessment is None:
        return None
    m = found.assessment.margins
    if not (m.stable and m.Ms <= MOST_Ms and (m.GM is None or m.GM >= LEAST_GM)):
        return None
    asked = ProcessModel(K=model.K, T_s=model.T, L_s=model.L, zeta=model.zeta if isinstance(model, SOPDT) else None)
    return {"start": "optimise", "method": found.method.name, "model": asked.model_dump(exclude_none=True)}
