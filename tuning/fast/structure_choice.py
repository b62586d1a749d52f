"""Which structure a fast record supports, and whether something beside MV moved PV: seven structures by BIC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce

import numpy as np

from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.disturbances import better, by_bic, disturbance_candidates, fit_structures, under
from loopwright.tuning.identification.output_error import UNDISTURBED, DisturbanceHypothesis, Fit, Fitted

RIVAL = 10.0
"""Of BIC: structures this near to the best could be true as well."""
UNEXPLAINED = 1.15
"""Of the noise at rest: a residual above it asks for a story."""
UNIMPORTANT = 0.0015
"""Of PV's span: a residual below it never does."""
SLOW = 2.0
"""Periods, of the slowest lag, from which a drift is tried in any case."""


@dataclass(frozen=True, slots=True, eq=False)
class StructureChoice:
    """best: the fit to go on with.  rivals: others that could be true as well.  fits: all with the same story."""

    best: Fitted
    rivals: tuple[Fitted, ...]
    fits: tuple[Fitted, ...]


def choose_structure(fit: Fit[ExperimentRecord], known: Sequence[Fitted] = ()) -> StructureChoice:
    """known: fits of an earlier part of the same record, from which is started as well."""
    quiet = fit_structures(fit, UNDISTURBED, known)
    found = quiet
    first = min(quiet, key=by_bic)
    if _unexplained(fit, first):
        found = better(found, reduce(better, disturbance_candidates(fit, quiet, partial(_unexplained, fit), known)))
    elif _slow(fit, first):
        # MV at rest is known as well as the noise lets it be; what it is off by is a drift to a slow plant
        drift = DisturbanceHypothesis(drift=True)
        drifting = fit_structures(fit, drift, [*known, *under(drift, quiet)])
        found = drifting if min(map(by_bic, drifting)) < first.bic else found
    ranked = sorted(found, key=by_bic)
    # the record hardly shows the static gain of a slow plant; that it has the wrong sign is then no finding
    ranked = [each for each in ranked if _goes_right(fit, each)] or ranked
    rivals = tuple(each for each in ranked[1:] if each.bic < ranked[0].bic + RIVAL)
    same = tuple(each for each in ranked if each.hypothesis == ranked[0].hypothesis)
    return StructureChoice(ranked[0], rivals, same)


def _goes_right(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    """The static gain has the sign that the controller's action says."""
    return fit.static_gain(found) * fit.record.direction > 0.0


def _slow(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    """The slowest lag is longer than the relay's record can show whole."""
    poles = np.roots(np.append(1.0, found.structure.monic(found.theta[: found.structure.searched])))
    return bool(np.min(np.abs(poles)) < 1.0 / (SLOW * fit.period))


def _unexplained(fit: Fit[ExperimentRecord], best: Fitted) -> bool:
    return best.rms > max(UNEXPLAINED * fit.record.noise / fit.record.output_range, UNIMPORTANT)
