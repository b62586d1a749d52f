"""What hides in the PV or in the MV of a record that was refused: it is named before anything is said of the plant."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from loopwright.tuning.analysis.pv_faults import pv_faults, without_wrong_samples
from loopwright.tuning.analysis.window import SHOWS, oscillation_at_rest
from loopwright.tuning.experiments.primitives import Unexplained
from loopwright.tuning.fast.experiment import Experiment
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.score_tests.mv_faults import find_mv_fault
from loopwright.tuning.fast.structure_choice import choose_structure
from loopwright.tuning.identification.output_error import Fit
from loopwright.tuning.models import Reals
from loopwright.tuning.plan import Plan, worked
from loopwright.tuning.reasons import Reason, Refused

T = TypeVar("T")
OF_THE_RECORD = (
    Reason.UNEXPLAINED,
    Reason.DISTURBED,
    Reason.UNCERTAIN,
    Reason.AMBIGUOUS,
    Reason.MODEL_MISMATCH,
    Reason.NOT_ROBUST,
    Reason.STALLED,
)
"""Reasons that a record may have because PV or MV is not what it seems."""
COARSE = 0.04
"""Rounding step of PV, as a part of its range in the test, from which on a refused record is called a coarse one."""
MIN_WRONG = 2


def naming_what_hides(test: Experiment, plan: Callable[[], Plan[T]]) -> Plan[T]:
    """The plan, whose refusal names what hides in the PV or in the MV of the test. Raises Refused as the plan."""
    try:
        return (yield from plan())
    except Refused as error:
        refused = (yield from worked(error.search)) if isinstance(error, Unexplained) else error
        if refused.reason not in OF_THE_RECORD or type(refused) is not Refused:
            raise refused from None
        try:
            record = test.experiment_record()
        except Refused:
            raise refused from None
        rest = slice(0, test.listened)
        pv, mv_at_rest = np.asarray(test.trace.pv), float(np.mean(test.trace.mv[rest]))
        raise (yield from worked(partial(with_what_hides, refused, record, pv, mv_at_rest))) from None


def while_open(test: Experiment, refused: Refused) -> str:
    """What is said of a record while its test goes on: what hides in PV, and of the plant only where nothing does."""
    named = of_pv(np.asarray(test.trace.pv), test.facts.sample_time_s)
    return refused.detail if named is None or refused.reason not in OF_THE_RECORD else named


def with_what_hides(refused: Refused, record: ExperimentRecord, pv: Reals, mv_at_rest: float) -> Refused:
    """The refusal of a record, which names what hides in its PV or its MV.

    pv: as it came, PV units. mv_at_rest: MV units.
    """
    if (named := of_pv(pv, record.Ts)) is not None:
        return Refused(Reason.PV_ALTERED, named)
    step = pv_faults(pv).rounded
    if step > COARSE * record.output_range and refused.reason is not Reason.STALLED:
        text = f"PV is rounded to {step:.3g}, and the test moved it by {record.output_range:.3g} only"
        return Refused(Reason.PV_ALTERED, text)
    rest = slice(0, record.listened)
    swings = oscillation_at_rest(without_wrong_samples(pv)[rest], record.u[rest] + mv_at_rest, record.Ts, SHOWS)
    if swings is not None and swings.by_window:
        return Refused(Reason.MV_ALTERED, swings.in_words)
    if not record.period:  # the test ended before the record had a time scale, which a fit needs
        return refused
    fit = Fit(record)
    fault = find_mv_fault(fit, choose_structure(fit).best, mv_at_rest)
    if fault is not None:
        return Refused(Reason.MV_ALTERED, f"{fault.what}; the record is explained so, and not by MV as it is")
    if swings is None:
        return refused
    if refused.reason is Reason.UNEXPLAINED:  # what was found of the plant may be of this
        return Refused(Reason.DISTURBED, f"{swings.in_words}, before the test moved it")
    return Refused(refused.reason, f"{swings.in_words}; {refused.detail}")


def of_pv(pv: Reals, Ts: float) -> str | None:
    """What hides in PV, in words; None where nothing does that shows. pv: PV units, shape (N,). Ts: s."""
    faults = pv_faults(pv)
    if (renewal := faults.of_renewal(Ts)) is not None:
        return f"{renewal}: no model of the plant explains what PV does in between"
    return faults.of_wrong_samples if len(faults.wrong) >= MIN_WRONG else None
