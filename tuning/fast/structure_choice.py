"""The choice of the model structure that a fast record supports, and of the disturbances that also moved PV.

Seven structures are fitted, and the Bayesian information criterion (BIC) chooses among them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np

from loopwright.tuning.fast.design.uncertainty import durbin_watson_ratio, unknown_columns
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.identification.disturbances import (
    by_bic,
    disturbance_candidates,
    fit_structures,
    lowest_bic,
    preferred,
    with_drift,
    with_one_load,
)
from loopwright.tuning.identification.output_error import UNDISTURBED, Fit, Fitted

RIVAL_BIC = 10.0
"""Difference of BIC within which another structure is a rival: it explains the record almost as well as the best."""
MAX_RESIDUAL = 1.15
"""Residual, in standard deviations of the noise at rest, above which disturbance hypotheses are tried."""
NEGLIGIBLE_RESIDUAL = 0.0015
"""Residual, as a fraction of the range of PV, below which no disturbance hypothesis is tried."""
SLOW_LAG = 2.0
"""Slowest time constant, in periods, above which a drift is tried in any case."""


@dataclass(frozen=True, slots=True, eq=False)
class StructureChoice:
    """The structure chosen, with its competitors.

    best: the fit that the design uses.
    rivals: fits of other structures, in manual also of one load disturbance more or less, in operation also with or
    without a drift, whose BIC is within RIVAL_BIC of the best.
    fits: all fits under the disturbance hypothesis of the best one.
    """

    best: Fitted
    rivals: tuple[Fitted, ...]
    fits: tuple[Fitted, ...]


def choose_structure(fit: Fit[ExperimentRecord], known: Sequence[Fitted] = ()) -> StructureChoice:
    """The structure and the disturbance hypothesis that explain the record best.

    known: fits of an earlier part of the same record, which are further starts of the search.
    """
    undisturbed = fit_structures(fit, UNDISTURBED, known)
    found, others = undisturbed, list[Fitted]()
    first = min(undisturbed, key=by_bic)
    if _unexplained(fit, first):
        one_load, drift, *two = disturbance_candidates(fit, undisturbed, partial(_unexplained, fit), known)
        found = preferred(undisturbed, reduce(preferred, two, min(one_load, drift, key=lowest_bic)))
    elif fit.record.excitation is Excitation.MANUAL:
        # Nothing brings PV back from a load disturbance in manual: one near a pulse hides in the model.
        one_load = with_one_load(fit, undisturbed, known)
        found = preferred(undisturbed, one_load)
        others = undisturbed if found is one_load else one_load
    elif fit.record.excitation is Excitation.OBSERVE and (
        not _gain_has_the_right_sign(fit, first) or _drifts(fit, first) or _slow(fit, first)
    ):
        # Nobody waited for a steady load before an operator's change. What drifts leaves little in the residual, and
        # MV that makes up for it, which the model takes for a gain of the wrong sign, or for a lag that never ends.
        drift = with_drift(fit, undisturbed, known)
        found, less_likely = sorted((undisturbed, drift), key=partial(_bic_of_an_explanation, fit))
        others = [each for each in less_likely if _gain_has_the_right_sign(fit, each)]
    elif _slow(fit, first):
        # The noise limits how well MV at rest is known; an error of MV at rest makes a slow plant drift.
        found = min(undisturbed, with_drift(fit, undisturbed, known), key=lowest_bic)
    ranked = sorted(found, key=by_bic)
    # The record hardly shows the static gain of a slow plant, so a wrong sign alone does not rule a model out.
    ranked = [each for each in ranked if _gain_has_the_right_sign(fit, each)] or ranked
    rivals = tuple(each for each in [*ranked[1:], *others] if each.bic < ranked[0].bic + RIVAL_BIC)
    same = tuple(each for each in ranked if each.hypothesis == ranked[0].hypothesis)
    return StructureChoice(ranked[0], rivals, same)


def _gain_has_the_right_sign(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    """Whether the static gain has the sign that agrees with the controller's action."""
    return fit.static_gain(found) * fit.record.direction > 0.0


def _slow(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    """Whether the slowest lag is too long for the record of a relay, or a set-point change, to show it completely."""
    poles = np.roots(np.append(1.0, found.structure.monic(found.theta[: found.structure.searched])))
    return bool(np.min(np.abs(poles)) < 1.0 / (SLOW_LAG * fit.period))


def _drifts(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    """Whether a slope of PV in each piece explains more of the residual than chance would, by AIC: two variances of the
    noise for each of them."""
    structure, pieces = found.structure, len(fit.pieces)
    everything = fit.regressors(structure, replace(found.hypothesis, drift=True), found.theta[None]).dense()[0]
    slopes = everything[:, structure.inputs + pieces : structure.inputs + 2 * pieces]
    known = np.linalg.qr(unknown_columns(fit, found))[0]
    basis = np.linalg.qr(slopes - known @ (known.T @ slopes))[0]
    residual = found.linear.residual
    variance = found.linear.rss / max(fit.samples - found.parameters, 1) * durbin_watson_ratio(residual)
    return bool(np.sum((basis.T @ residual) ** 2) > 2.0 * pieces * variance)


def _bic_of_an_explanation(fit: Fit[ExperimentRecord], fits: Sequence[Fitted]) -> float:
    """The lowest BIC of a model whose static gain has the right sign."""
    return min((each.bic for each in fits if _gain_has_the_right_sign(fit, each)), default=math.inf)


def _unexplained(fit: Fit[ExperimentRecord], best: Fitted) -> bool:
    return best.rms > max(MAX_RESIDUAL * fit.record.noise / fit.record.output_range, NEGLIGIBLE_RESIDUAL)
