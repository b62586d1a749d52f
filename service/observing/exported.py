"""Gains from the file of a historian: the set-point changes in it, as `observe` takes them from the history."""

from __future__ import annotations

from pydantic import Field

from loopwright.service.jsonable import json_object
from loopwright.service.observing.observed import OperationView, operation_fields
from loopwright.service.offline.csv_record.record import Record
from loopwright.service.results import Figures
from loopwright.tuning.analysis.comparison import Comparison
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.fast.evaluation import Evaluation
from loopwright.tuning.fast.proposal import comparison_of
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.record import sample_time
from loopwright.tuning.operation.export import action_of, require_raw
from loopwright.tuning.operation.history import SetpointChange, Stretch
from loopwright.tuning.operation.observation import Observation, observe
from loopwright.tuning.reasons import Reason, Refused

FEWEST = 100
"""Smallest number of samples of a file."""


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
    if len(record.t) < FEWEST:
        raise Refused(Reason.BAD_INPUT, f"the file has {len(record.t)} samples; at least {FEWEST} are needed")
    stretch = Stretch(float(record.t[0]), sample_time(record.t), record.u, record.y, record.sp, gains)
    require_raw(stretch)
    reverse = action_of(stretch)
    found = observe([stretch], reverse, spec)
    evaluation = found.evaluation
    compared: Comparison | None = None
    if found.reason is None and evaluation is not None:
        try:
            compared = comparison_of(evaluation, _facts(stretch, evaluation, reverse), spec, False)
        except Refused as refused:
            found = Observation(refused.reason, refused.detail, evaluation, found.used, found.dropped)
    fields: dict[str, object] = {
        "samples": len(stretch.sp),
        "sample_time_s": stretch.Ts,
        "reverse_acting": reverse,
        "changes_used": [_change(each) for each in found.used],
        "changes_dropped": [_change(each) for each in found.dropped],
    }
    return ExportedView.model_validate(json_object(operation_fields(found, compared, gains) | fields))


def _facts(stretch: Stretch, evaluation: Evaluation, reverse: bool) -> Facts:
    low, high = float(stretch.mv.min()), float(stretch.mv.max())
    T95 = max(evaluation.period, 5.0 * stretch.Ts)
    return Facts(stretch.Ts, T95, low, high, float(stretch.sp.max() - stretch.sp.min()), stretch.gains, reverse)


def _change(change: SetpointChange) -> dict[str, float]:
    return {"t_s": change.t_s, "size": change.size}
