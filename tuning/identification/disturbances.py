"""Fits every model structure under each disturbance hypothesis: none, one or two load disturbances, or a drift.

A residual larger than the noise is explained first by one step-shaped load disturbance at a free time or by a drift of
PV, then by two load disturbances. A disturbance hypothesis is accepted only if it lowers BIC by MIN_BIC_GAIN.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.analysis.zero_order_hold import pulses
from loopwright.tuning.identification.output_error import (
    UNDISTURBED,
    DisturbanceHypothesis,
    Fit,
    Fitted,
    RecordToFit,
    averaged,
)
from loopwright.tuning.identification.projection import Projection
from loopwright.tuning.identification.regressors import Regressors
from loopwright.tuning.identification.shifts import SAMPLES_TOGETHER, products_within, shifted_products
from loopwright.tuning.identification.structures import (
    FIRST,
    FIRST_WITH_FEED_THROUGH,
    INTEGRATOR,
    LAGGED_INTEGRATOR,
    SECOND,
    SECOND_WITH_FEED_THROUGH,
    SECOND_WITH_ZERO,
    THIRD_WITH_ZERO,
    THIRD_WITH_ZEROS,
    Structure,
)
from loopwright.tuning.models import Reals

STRUCTURES = (
    FIRST,
    FIRST_WITH_FEED_THROUGH,
    SECOND,
    SECOND_WITH_ZERO,
    SECOND_WITH_FEED_THROUGH,
    THIRD_WITH_ZERO,
    THIRD_WITH_ZEROS,
)
LAGS_ONLY = (FIRST, SECOND, INTEGRATOR, LAGGED_INTEGRATOR)
"""The structures without zeros, one for each denominator. Their fits start from a grid, and the structures with the
same denominator start from these fits."""
MIN_BIC_GAIN = 15.0
"""Smallest decrease of BIC for which a disturbance hypothesis, or a structure with more than lags, is accepted."""
STARTS = 2
THIRD_RATES = (1.0, 40.0)  # rates of the third lag, in 1/period
THIRD_STARTS = 3
THIRD_DEAD_TIMES = (-0.12, -0.04, 0.02)  # dead times of a third-order start less that of two lags, in periods
LOAD_TIME_SPACING = 0.1  # between the first guesses of the time of a load disturbance, in periods
FIRST_STEPS = 8
LOAD_DEAD_TIMES = (0.06, 0.14, 0.23, 0.41)  # periods
S = TypeVar("S", bound=RecordToFit)


def disturbance_candidates(
    fit: Fit[S],
    undisturbed: list[Fitted],
    unexplained: Callable[[Fitted], bool],
    known: Sequence[Fitted] = (),
    structures: Sequence[Structure] = STRUCTURES,
) -> list[list[Fitted]]:
    """The fits of all structures under disturbance hypotheses, one list for each hypothesis.

    The first hypotheses are one load disturbance and a drift; each can stand for a little of the other, and what is
    left then looks like a plant that is not linear. Two load disturbances are tried only where the best fit of these
    leaves a residual that is not explained.

    undisturbed: the fits without a disturbance.
    unexplained: tells whether a fit leaves a residual that is not explained.
    known: fits of an earlier part of the same record, which are further starts of the search.
    structures: the structures that are fitted.
    """
    one_load = with_one_load(fit, undisturbed, known, structures)
    drift = with_drift(fit, undisturbed, known, structures)
    if not unexplained(min((*one_load, *drift), key=by_bic)):
        return [one_load, drift]
    two_loads = fit_structures(
        fit, DisturbanceHypothesis(load_disturbances=2), (*known, *_with_load(fit, one_load, known)), structures
    )
    return [one_load, drift, two_loads]


def with_one_load(
    fit: Fit[S],
    undisturbed: list[Fitted],
    known: Sequence[Fitted] = (),
    structures: Sequence[Structure] = STRUCTURES,
) -> list[Fitted]:
    """The fits of all structures with one load disturbance; the arguments are those of `disturbance_candidates`."""
    started = _with_load(fit, undisturbed, known)
    return fit_structures(fit, DisturbanceHypothesis(load_disturbances=1), (*known, *started), structures)


def with_drift(
    fit: Fit[S],
    undisturbed: list[Fitted],
    known: Sequence[Fitted] = (),
    structures: Sequence[Structure] = STRUCTURES,
) -> list[Fitted]:
    """The fits of all structures with a drift of PV; the arguments are those of `disturbance_candidates`."""
    drift = DisturbanceHypothesis(drift=True)
    return fit_structures(fit, drift, [*known, *(replace(each, hypothesis=drift) for each in undisturbed)], structures)


def preferred(undisturbed: list[Fitted], disturbed: list[Fitted]) -> list[Fitted]:
    """The fits with the disturbance if their lowest BIC is at least MIN_BIC_GAIN lower, else those without."""
    return disturbed if lowest_bic(disturbed) < lowest_bic(undisturbed) - MIN_BIC_GAIN else undisturbed


def lowest_bic(fits: Sequence[Fitted]) -> float:
    """The BIC of the best of these fits."""
    return min(each.bic for each in fits)


def by_bic(fitted: Fitted) -> float:
    """The sort key of fits: BIC, the lower the better."""
    return fitted.bic


def fit_structures(
    fit: Fit[S],
    hypothesis: DisturbanceHypothesis,
    known: Sequence[Fitted] = (),
    structures: Sequence[Structure] = STRUCTURES,
) -> list[Fitted]:
    """The fits of every structure under this hypothesis. Structures with the same denominator share their starts.

    known: fits whose parameters are further starts of the search.
    """
    times = _times(hypothesis, known)
    begun: dict[tuple[int, bool], list[Reals]] = {}
    undisturbed = hypothesis == UNDISTURBED
    for lags in LAGS_ONLY:
        if lags not in structures:
            continue
        if hypothesis.load_disturbances == 1:
            begun[_poles(lags)] = fit.grid(lags, STARTS, float(times[0]))
        else:
            begun[_poles(lags)] = [np.append(theta, times) for theta in fit.grid(lags, STARTS, drift=hypothesis.drift)]
    found: list[Fitted] = []
    for structure in structures:
        same = [k.theta for k in known if _poles(k.structure) == _poles(structure) and k.hypothesis == hypothesis]
        exact = [k.theta for k in known if k.structure == structure and k.hypothesis == hypothesis]
        starts = [*exact, *same[:STARTS], *begun.get(_poles(structure), [])]
        if structure.lags == 3:
            simpler = [each for each in found if each.structure in (SECOND, SECOND_WITH_ZERO)]
            if undisturbed and _poles(structure) not in begun:
                # three lags have many local minima: the grid lies around the dead time fitted with two lags
                L = min(simpler, key=by_bic).theta[2] / fit.period
                around = [L + change for change in THIRD_DEAD_TIMES]
                begun[_poles(structure)] = fit.grid(THIRD_WITH_ZEROS, THIRD_STARTS, dead_times=around)
                starts += begun[_poles(structure)]
            starts += [_third(fit, each, rate) for each in simpler for rate in THIRD_RATES]
            starts += [each.theta for each in found if each.structure == THIRD_WITH_ZERO]
        elif structure not in LAGS_ONLY:
            starts += [each.theta for each in found if _poles(each.structure) == _poles(structure)]
        found.append(fit.search(structure, hypothesis, _distinct(starts)))
    return found


def _poles(structure: Structure) -> tuple[int, bool]:
    return structure.lags, structure.integrating


def _third(fit: Fit[S], simpler: Fitted, rate: float) -> Reals:
    """A third-order start: the simpler fit with one fast lag added, and with the dead time shortened by that lag."""
    theta = simpler.theta
    p = rate / fit.period
    L = max(theta[2] - 0.8 / p, 0.0)
    return np.concatenate((theta[:2], [np.log(p), L], theta[3:]))


def _distinct(starts: Sequence[Reals]) -> list[Reals]:
    kept: list[Reals] = []
    for theta in starts:
        if all(np.max(np.abs(theta - other)) > 1e-3 for other in kept):
            kept.append(theta)
    return kept


def _times(hypothesis: DisturbanceHypothesis, known: Sequence[Fitted]) -> Reals:
    """The best known times of the load disturbances, in samples; zeros where none are known."""
    best = min((k for k in known if k.hypothesis == hypothesis), key=by_bic, default=None)
    return best.theta[best.structure.searched :] if best is not None else np.zeros(hypothesis.load_disturbances)


def _with_load(fit: Fit[S], simpler: Sequence[Fitted], known: Sequence[Fitted]) -> list[Fitted]:
    """The fits with one load disturbance more than `simpler` has, started from the most promising times.

    The structures fitted are the second order and the one that has explained most so far.
    """
    loads = simpler[0].hypothesis.load_disturbances
    second = min((each for each in simpler if each.structure == SECOND), key=by_bic)
    thetas = [second.theta]
    if not loads:
        thetas += [np.append(logs, L * fit.period) for logs in fit.denominators(SECOND) for L in LOAD_DEAD_TIMES]
    found = _with_load_time(fit, SECOND, loads, thetas)
    likely = [min(simpler, key=by_bic), *(each for each in known if each.hypothesis.load_disturbances == loads)][:2]
    for each in likely:
        if each.structure != SECOND:
            found += _with_load_time(fit, each.structure, loads, [each.theta])
    return found


def _with_load_time(fit: Fit[S], structure: Structure, loads: int, thetas: Sequence[Reals]) -> list[Fitted]:
    """At most two fits of a structure with one load disturbance more than each theta has.

    loads: the number of load disturbances of each theta.
    """
    hypothesis = DisturbanceHypothesis(loads + 1)
    times = np.arange(0.0, len(fit.u) - 0.2 * fit.period, LOAD_TIME_SPACING * fit.period)
    shifts = np.round(times / fit.block).astype(np.int64)
    guesses: list[tuple[float, Reals]] = []
    together = max(1, SAMPLES_TOGETHER // fit.samples)
    for part in (thetas[i : i + together] for i in range(0, len(thetas), together)):
        for theta, rss in zip(part, rss_by_load_time(fit, structure, np.array(part), shifts), strict=True):
            guesses += [(float(rss[i]), np.append(theta, shifts[i] * fit.block)) for i in np.argsort(rss)[:3]]
    guesses.sort(key=lambda each: each[0])
    starts = fit.distinct([theta for _, theta in guesses], structure, 6)
    rough = sorted(fit.descended(structure, hypothesis, starts, FIRST_STEPS), key=by_bic)
    return [fit.search(structure, hypothesis, [each.theta]) for each in rough[:2]]


def search_last_load_again(fit: Fit[S], found: Fitted) -> list[Fitted]:
    """The fits with the last load disturbance searched again over the whole record, starting from the better model."""
    return _with_load_time(fit, found.structure, found.hypothesis.load_disturbances - 1, [found.theta[:-1]])


def answers_to_load(structure: Structure, thetas: Reals, samples: int, block: int) -> Reals:
    """The states of each plant after a step at its input, each in its largest value, averaged, shape (thetas, rows,
    states)."""
    monics = structure.monic(thetas[:, : structure.searched])
    answers = averaged(pulses(monics, np.zeros(len(thetas)), structure.order).drive(np.ones(samples)), block, 1)
    return np.asarray(answers / np.max(np.abs(answers), axis=1, keepdims=True))


def rss_by_load_time(fit: Fit[S], structure: Structure, thetas: Reals, shifts: NDArray[np.int64]) -> Reals:
    """The residual sums of squares of each theta with one more load disturbance at each of these rows, shape (thetas,
    shifts).

    The time of a load disturbance only shifts its response, so one response serves all times.
    """
    order = structure.order
    columns = fit.regressors(structure, DisturbanceHypothesis(thetas.shape[1] - structure.searched), thetas).dense()
    without = Projection.of(Regressors(columns), fit.y)
    basis, rest = np.swapaxes(without.common, 1, 2), without.rest
    answers = np.swapaxes(answers_to_load(structure, thetas, len(fit.u), fit.block), 1, 2)
    fixed, within = np.concatenate((rest[:, None], basis), axis=1), products_within(answers)
    products = np.empty((*fixed.shape[:2], order, len(shifts)))
    last = np.empty(len(shifts), dtype=np.int64)  # of the samples of the response that count
    for rows in fit.rows:
        mine = (shifts >= rows.start) & (shifts < rows.stop)
        if not mine.any():
            continue
        # the response to a load disturbance begins and ends in its piece
        within_piece = shifted_products(fixed[..., rows], answers[..., : rows.stop - rows.start])
        products[..., mine] = within_piece[..., shifts[mine] - rows.start]
        last[mine] = rows.stop - shifts[mine] - 1
    along, across = products[:, 0], products[:, 1:]
    gram = np.moveaxis(within[..., last] - np.einsum("pqis,pqjs->pijs", across, across), -1, 1)
    scale = np.maximum(np.einsum("psii->ps", gram), 1e-12)[:, :, None, None]
    along = np.swapaxes(along, 1, 2)
    weights = np.linalg.solve(gram + 1e-9 * scale * np.eye(order), along[..., None])[..., 0]
    return np.asarray(np.einsum("pn,pn->p", rest, rest)[:, None] - np.einsum("psi,psi->ps", weights, along))
