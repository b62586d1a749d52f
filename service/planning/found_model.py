"""The model that a job found on its loop, taken from the job's result or from the results of its stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from loopwright.service.results import TYPED_IN
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction
from loopwright.tuning.reasons import Reason

FoundModel = FOPDT | SOPDT | TransferFunction
DISPROVED = (
    Reason.WRONG_SIGN,
    Reason.MODEL_MISMATCH,
    Reason.DIVERGES,
    Reason.UNEXPLAINED,
    Reason.PV_ALTERED,
    Reason.MV_ALTERED,
    Reason.DISTURBED,
)
"""Reasons for which a job ends when its record contradicts the model that an earlier stage found."""


def found_model(row: Job, events: Sequence[JobEvent]) -> FoundModel | None:
    """Returns the model of the job's result, else the last that a stage found; an entered model does not count."""
    if row.result is not None and row.result.model is not None and not row.result.model.typed_in:
        return row.result.model.process_model()
    for done in (event.stage_ended() for event in reversed(events)):
        if done and done.result and TYPED_IN not in (done.result.get("structure"), done.result.get("k_source")):
            model = model_of(done.result)
            if model is not None:
                return model
    return None


def model_of(data: Mapping[str, object]) -> FoundModel | None:
    """Returns the model in a stage's result; None where there is none, or where the stage gave a reason against it."""
    K, T, L, zeta = (_number(data.get(name)) for name in ("K", "T_s", "L_s", "zeta"))
    if K is not None and T is not None and L is not None:
        return FOPDT(K, T, L) if zeta is None else SOPDT(K, T, zeta, L)
    num, den = data.get("num"), data.get("den")
    if isinstance(num, list) and isinstance(den, list) and num and den and not data.get("reason"):
        dead_time = _number(data.get("dead_time_s", data.get("L_s")))
        return TransferFunction(tuple(num), tuple(den), dead_time or 0.0)
    return None


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) else None
