"""Operation under accepted gains, as the watch compares it with the model of the proposal. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sqlalchemy.orm import Session

from loopwright.service.inputs.config import LoopConfig
from loopwright.service.observing.observed import Question
from loopwright.service.observing.stretches import HeardStretch
from loopwright.service.results import FastResult, FiveStageResult
from loopwright.service.states.acceptance_watch import AcceptanceWatch, WatchedChange
from loopwright.service.states.loop_state import same_gains
from loopwright.service.store import watches
from loopwright.service.store.clock import now
from loopwright.service.store.tables import JobRow
from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.operation.accepted_model import AcceptedModel
from loopwright.tuning.operation.compared_change import AFTER, compare_change
from loopwright.tuning.operation.false_pv import FalseOperation, false_operation
from loopwright.tuning.operation.growing_oscillation import Growing, growing
from loopwright.tuning.operation.load_changes import load_changes
from loopwright.tuning.reasons import Ended

PERIOD_OF_T95 = 0.7
"""Ultimate period where no model tells it, in T95."""


@dataclass(frozen=True, slots=True)
class Compared:
    """The changes that were compared, and up to when changes were looked for, wall time, s."""

    changes: tuple[WatchedChange, ...]
    looked_to_s: float


def watched(by: str, auto_rollback: bool, config: LoopConfig) -> Callable[[Session, JobRow], None]:
    """Begins the watch of an acceptance in its transaction."""

    def write(session: Session, job: JobRow) -> None:
        model = None if job.result is None else accepted_model(job.result, 0.0)
        watches.begin(
            session,
            job,
            AcceptanceWatch(
                since=now(),
                by=by,
                auto_rollback=auto_rollback,
                period_s=PERIOD_OF_T95 * config.t95_s if model is None else model.period_s,
                model="the job has no model with an ultimate period" if model is None else None,
            ),
        )

    return write


def accepted_model(result: FastResult | FiveStageResult, sample_time_s: float) -> AcceptedModel | None:
    """The model of a proposal with its gains; None where there is none with an ultimate period.

    sample_time_s: that of the controller, s.
    """
    if result.model is None or result.new_gains is None:
        return None
    found = result.model.process_model()
    plant = TransferFunction(found.num, found.den, found.L)
    if result.ultimate is not None:
        period_s = result.ultimate.Pu_s
    else:
        try:
            period_s = ultimate_point(plant)[1]
        except Ended:
            return None
    covariance = result.model.covariance if isinstance(result, FastResult) and result.model is not None else None
    return AcceptedModel(plant, result.new_gains.gains(), period_s, 0.5 * sample_time_s, covariance)


def compared(question: Question, model: AcceptedModel, from_s: float) -> Compared:
    """Compares the set-point changes and the loads since a time, wall time, s; a computation of a tenth of a second
    for each."""
    found, looked_to_s = [], from_s
    for each in under_accepted_gains(question.heard(), model.gains):
        after = round(AFTER * model.period_s / each.stretch.Ts)
        moves = [(move, False) for move in each.stretch.moves]
        for move, by_load in sorted(moves + [(at, True) for at in load_changes(each.stretch, model.period_s)]):
            end = move + after
            if each.at_s[move] <= looked_to_s or end > len(each.stretch.sp):
                continue
            change = compare_change(model, each.stretch, move, end, by_load)
            found.append(WatchedChange(at_s=float(each.at_s[move]), compared=change))
            looked_to_s = float(each.at_s[end - 1])
    return Compared(tuple(found), looked_to_s)


def oscillation(question: Question, gains: Gains, period_s: float, from_s: float) -> Growing | None:
    """The oscillation that grows at the end of the history, under the accepted gains; None where there is none.

    from_s: the wall time before which it does not count, s.
    """
    heard = question.heard()
    if not heard or not same_gains(heard[-1].stretch.gains, gains):
        return None
    stretch, later = heard[-1].stretch, heard[-1].at_s >= from_s
    return growing(replace(stretch, mv=stretch.mv[later], pv=stretch.pv[later], sp=stretch.sp[later]), period_s)


def false_pv(question: Question, period_s: float, from_s: float) -> FalseOperation | None:
    """How PV is false since a time, wall time, s; None where it is not.

    period_s: the ultimate period, s.
    """
    heard = question.heard()
    if not heard or heard[-1].at_s[-1] < from_s:
        return None
    stretch = heard[-1].stretch
    return false_operation(stretch.pv, period_s / stretch.Ts)


def under_accepted_gains(heard: Sequence[HeardStretch], gains: Gains) -> list[HeardStretch]:
    """The stretches in which these gains were in effect, oldest first."""
    return [each for each in heard if same_gains(each.stretch.gains, gains)]
