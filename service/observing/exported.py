"""Gains from the file of a historian: the set-point changes in it, as `observe` takes them from the history."""

from __future__ import annotations

from pydantic import Field

from loopwright.service.jsonable import json_object
from loopwright.service.observing.observed import OperationView, operation_fields
from loopwright.service.offline.csv_record.record import Record
from loopwright.service.results import Figures
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.gains import Gains
from loopwright.tuning.operation.history import SetpointChange
from loopwright.tuning.operation.recorded_operation import observe
from loopwright.tuning.reasons import Reason, Refused


class ExportedChangeView(Figures):
    """A set-point change in the file."""

    t_s: float = Field(description="Time of its first move, as in the file, s")
    size: float = Field(description="Largest deviation of the set-point from before, PV units")


class ExportedView(OperationView):
    """What the set-point changes in a file tell of the gains."""

    samples: int
    sample_time_s: float
    reverse_acting: bool = Field(description="Action of the controller, as OP follows PV in the file")
    changes_used: list[ExportedChangeView]
    changes_dropped: list[ExportedChangeView]


def exported(record: Record, gains: Gains, spec: DesignSpec) -> ExportedView:
    """Evaluates a file. gains: those in effect throughout.

    Raises Refused: BAD_INPUT for a file that does not show the loop itself, SETPOINT_IS_DRIVEN.
    """
    if record.sp is None:
        text = f"{record.without_setpoint}, which the gains of a loop in automatic need: export SP with it"
        raise Refused(Reason.BAD_INPUT, text)
    observed = observe(record.t, record.sp, record.y, record.u, gains, spec)
    found = observed.observation
    fields: dict[str, object] = {
        "samples": len(observed.stretch.sp),
        "sample_time_s": observed.stretch.Ts,
        "reverse_acting": observed.reverse,
        "changes_used": [_change(each) for each in found.used],
        "changes_dropped": [_change(each) for each in found.dropped],
    }
    return ExportedView.model_validate(json_object(operation_fields(found, observed.comparison, gains) | fields))


def _change(change: SetpointChange) -> dict[str, float]:
    return {"t_s": change.t_s, "size": change.size}
