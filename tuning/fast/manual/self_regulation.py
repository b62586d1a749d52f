"""Whether a plant comes to rest by itself, by the record of a pulse of MV that a load disturbance has come into.

After a pulse PV of a self-regulating plant comes back, that of an integrating one stays. A load disturbance may hide
the difference: PV then comes to rest elsewhere. Lags and integrators are both fitted with such a load, and BIC decides.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import chain

from loopwright.tuning.fast.evaluation.record_evaluation import first_period
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.disturbances import (
    LAGS_ONLY,
    by_bic,
    disturbance_candidates,
    fit_structures,
)
from loopwright.tuning.identification.output_error import UNDISTURBED, Fit, Fitted
from loopwright.tuning.reasons import Refused

MIN_BIC_GAIN = 15.0
"""By how much BIC of a self-regulating plant has to be lower than that of an integrating one."""
MAX_RESIDUAL = 1.35
"""Largest residual, in standard deviations of the noise at rest, of a fit that explains the record."""


def comes_to_rest(record: ExperimentRecord) -> bool:
    """Whether the record shows that the plant comes to rest by itself. record: its time scale is not used."""
    pulses = slice(record.listened, record.excited)
    try:
        found = replace(record, period=first_period(record.u[pulses], record.y[pulses], record.Ts))
    except Refused:
        return False
    fit = Fit(found)
    unexplained = partial(_unexplained, fit)
    undisturbed = fit_structures(fit, UNDISTURBED, structures=LAGS_ONLY)
    others = disturbance_candidates(fit, undisturbed, unexplained, structures=LAGS_ONLY)
    every = [*undisturbed, *chain.from_iterable(others)]
    lags, integrators = (
        min((each for each in every if each.structure.integrating is integrating), key=by_bic)
        for integrating in (False, True)
    )
    return not unexplained(lags) and lags.bic <= integrators.bic - MIN_BIC_GAIN


def _unexplained(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    return found.rms > MAX_RESIDUAL * fit.record.noise / fit.record.output_range
