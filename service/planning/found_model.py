"""The model that a job found on its loop, from its result or from the stages it came through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from loopwright.service.results import TYPED_IN
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction
from loopwright.tuning.reasons import Reason

FoundModel = FOPDT | SOPDT | TransferFunction
DISPROVED = (Reason.WRONG_SIGN, Reason.MODEL_MISMATCH, Reason.DIVERGES, Reason.UNEXPLAINED, Reason.DISTURBED)
"""How a job ends whose own record speaks against the model that an earlier stage had found."""


def found_model(row: Job, events: Sequence[JobEvent]) -> FoundModel | None:
    """The model of the job's result, else the last that a stage found; none that was typed in."""
    if row.result is not None and row.result.model is not None and not row.result.model.typed_in:
        return row.result.model.process_model()
    for data in (event.data.get("result") for event in reversed(events) if event.kind == "stage_done"):
        if data and TYPED_IN not in (data.get("structure"), data.get("k_source")):
            model = model_of(data)
            if model is not None:
                return model
    return None


def model_of(data: Mapping[str, Any]) -> FoundModel | None:
    """The model of a stage's result or of a request; None where it has none, or one that is not to be trusted."""
    if all(isinstance(data.get(name), int | float) for name in ("K", "T_s", "L_s")):
        K, T, L, zeta = data["K"], data["T_s"], data["L_s"], data.get("zeta")
        return FOPDT(K, T, L) if zeta is None else SOPDT(K, T, zeta, L)
    if data.get("num") and data.get("den") and not data.get("reason"):
        dead_time = data.get("dead_time_s", data.get("L_s", 0.0))
        return TransferFunction(tuple(data["num"]), tuple(data["den"]), dead_time)
    return None
