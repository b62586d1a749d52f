"""The evaluation of the records of either excitation.

The relay's record has a time scale, the period of the oscillation. That of pulses is found with the model: it begins
with `first_period`, or with what a look at the same record, shorter then, has found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import Evaluation, evaluate
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.identification.output_error import UNDISTURBED
from loopwright.tuning.identification.problem import IdentificationProblem
from loopwright.tuning.identification.record import recorded_test
from loopwright.tuning.identification.structures import SECOND
from loopwright.tuning.models import Reals, TransferFunction, time_constants
from loopwright.tuning.reasons import Ended, Refused

PERIOD_IS_RIGHT = (0.6, 1.25)
"""Ratio of the model's own ultimate period to the time scale of the fit outside which the record is fitted again."""
MAX_REFITS = 2
AS_GOOD = 1.03
"""Largest ratio of the residual of a fit with another time scale to the residual of the fit before it."""
MIN_PERIOD = 8.0
"""Shortest time scale of a record, in samples; the longest is the record."""


def evaluate_excitation(record: ExperimentRecord, spec: DesignSpec, test_follows: bool = False) -> Evaluation:
    """Evaluates the record of an excitation without the steps that follow it. Raises Refused as `evaluate`.

    test_follows: whether the gains are to be tested next, see `evaluate`.

    Under pulses the record is fitted again where the model's own ultimate period is another one than its time scale.
    """
    if record.excitation is Excitation.RELAY:
        return evaluate(record, spec, test_follows=test_follows)
    found = evaluate(record, spec, test_follows=test_follows)
    for _ in range(MAX_REFITS):
        own = own_period(found)
        if own is None:
            break
        try:
            again = evaluate(replace(record, period=own), spec, test_follows=test_follows)
        except Refused:
            break
        if again.residual > AS_GOOD * found.residual:
            break
        found = again
    return found


def own_period(found: Evaluation) -> float | None:
    """The ultimate period of the model, in samples, where it is another one than the time scale of its fit."""
    own = found.period / found.fit.record.Ts
    low, high = PERIOD_IS_RIGHT
    return None if low <= own / found.fit.period <= high else own


def evaluate_again(record: ExperimentRecord, spec: DesignSpec) -> Evaluation:
    """Evaluates a whole record as the procedure does: the part of the excitation first, then all of it.

    Raises Refused, NOT_ROBUST.
    """
    if not record.steps:
        return evaluate_excitation(record, spec)
    until = slice(record.excited)
    excitation = replace(record, u=record.u[until], y=record.y[until], steps=())
    first = evaluate_excitation(excitation, spec, test_follows=True)
    return evaluate(replace(record, period=first.fit.period), spec, first)


def first_period(u: Reals, y: Reals, Ts: float) -> float:
    """The ultimate period, in samples, of two lags fitted to a record without any idea of its time scale.

    u, y: MV and PV as deviations from rest, shape (N,). Ts: the sample time, s.
    Where the model has no ultimate point its dead time and lags give the time scale. Raises Refused as `recorded_test`.
    """
    problem = IdentificationProblem(recorded_test(Ts * np.arange(len(u)), u, y, 0.0))
    model = problem.model(problem.fit(SECOND, UNDISTURBED))
    plant = TransferFunction(model.num, model.den, model.L + 0.5 * Ts)
    try:
        found = ultimate_point(plant)[1] / Ts
    except Ended:
        found = 4.0 * (plant.L + float(np.min(time_constants(plant), initial=0.0))) / Ts
    return min(max(found, MIN_PERIOD), float(len(u)))
