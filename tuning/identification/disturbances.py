"""What moved PV beside MV, and through which structure: every structure under a story, and the stories themselves.

What the noise does not explain is first taken for a step of the load at a free time, then for two, or for a drift; such
a story must earn its parameters clearly.
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
"""Of each denominator the one without a zero: fitted from a grid, and the others begin where it has come to."""
MIN_BIC_GAIN = 15.0
"""Of BIC: what a story beside MV must gain."""
STARTS = 2
THIRD_RATES = (1.0, 40.0)  # 1/period
THIRD_STARTS = 3
THIRD_DEAD_TIMES = (-0.12, -0.04, 0.02)  # periods, from that of two lags
EVERY = 0.1  # periods, between the first guesses of a load's time
FIRST_STEPS = 8
LOAD_DEAD_TIMES = (0.06, 0.14, 0.23, 0.41)  # periods
S = TypeVar("S", bound=RecordToFit)


def disturbance_candidates(
    fit: Fit[S],
    quiet: list[Fitted],
    unexplained: Callable[[Fitted], bool],
    known: Sequence[Fitted] = (),
    structures: Sequence[Structure] = STRUCTURES,
) -> list[list[Fitted]]:
    """All structures with one step of the load; and, where that leaves something over, with a drift and with two steps.

    quiet: the same without a story.  unexplained: whether a fit leaves something over.  known: fits of an earlier part
    of the same record, from which is started as well.
    """
    once = fit_structures(
        fit, DisturbanceHypothesis(load_disturbances=1), (*known, *_with_load(fit, quiet, known)), structures
    )
    if not unexplained(min(once, key=by_bic)):
        return [once]
    drift = DisturbanceHypothesis(drift=True)
    twice = fit_structures(
        fit, DisturbanceHypothesis(load_disturbances=2), (*known, *_with_load(fit, once, known)), structures
    )
    return [once, fit_structures(fit, drift, [*known, *under(drift, quiet)], structures), twice]


def better(simple: list[Fitted], story: list[Fitted]) -> list[Fitted]:
    """The story, if it has earned its parameters."""
    return story if min(map(by_bic, story)) < min(map(by_bic, simple)) - MIN_BIC_GAIN else simple


def by_bic(fitted: Fitted) -> float:
    return fitted.bic


def under(hypothesis: DisturbanceHypothesis, found: Sequence[Fitted]) -> list[Fitted]:
    """The same parameters to begin with under a hypothesis that has as many."""
    return [replace(each, hypothesis=hypothesis) for each in found if not each.hypothesis.load_disturbances]


def fit_structures(
    fit: Fit[S],
    hypothesis: DisturbanceHypothesis,
    known: Sequence[Fitted] = (),
    structures: Sequence[Structure] = STRUCTURES,
) -> list[Fitted]:
    """Every structure under this hypothesis; those with the same denominator share where they begin."""
    times = _times(hypothesis, known)
    begun: dict[tuple[int, bool], list[Reals]] = {}
    quiet = hypothesis == UNDISTURBED
    for lags in LAGS_ONLY:
        if lags not in structures:
            continue
        if hypothesis.load_disturbances == 1:
            begun[_poles(lags)] = fit.grid(lags, STARTS, float(times[0]))
        else:
            begun[_poles(lags)] = [np.append(theta, times) for theta in fit.grid(lags, STARTS)]
    found: list[Fitted] = []
    for structure in structures:
        same = [k.theta for k in known if _poles(k.structure) == _poles(structure) and k.hypothesis == hypothesis]
        exact = [k.theta for k in known if k.structure == structure and k.hypothesis == hypothesis]
        starts = [*exact, *same[:STARTS], *begun.get(_poles(structure), [])]
        if structure.lags == 3:
            simpler = [each for each in found if each.structure in (SECOND, SECOND_WITH_ZERO)]
            if quiet and _poles(structure) not in begun:
                # three lags have many local minima: a grid around the dead time that two lags have come to
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
    """A fast lag more, and as much less dead time."""
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
    """Of the loads, as best known."""
    best = min((k for k in known if k.hypothesis == hypothesis), key=by_bic, default=None)
    return best.theta[best.structure.searched :] if best is not None else np.zeros(hypothesis.load_disturbances)


def _with_load(fit: Fit[S], simpler: Sequence[Fitted], known: Sequence[Fitted]) -> list[Fitted]:
    """Fits with one step of the load more than `simpler`, from the most promising times.

    Of the second order, and of the structure that has explained most so far.
    """
    loads = simpler[0].hypothesis.load_disturbances
    second = min((each for each in simpler if each.structure == SECOND), key=by_bic)
    thetas = [second.theta]
    if not loads:
        thetas += [np.append(logs, L * fit.period) for logs in fit.denominators(SECOND) for L in LOAD_DEAD_TIMES]
    found = _timed(fit, SECOND, loads, thetas)
    likely = [min(simpler, key=by_bic), *(each for each in known if each.hypothesis.load_disturbances == loads)][:2]
    for each in likely:
        if each.structure != SECOND:
            found += _timed(fit, each.structure, loads, [each.theta])
    return found


def _timed(fit: Fit[S], structure: Structure, loads: int, thetas: Sequence[Reals]) -> list[Fitted]:
    """Two fits at most with one step of the load more than each theta has."""
    hypothesis = DisturbanceHypothesis(loads + 1)
    times = np.arange(0.0, len(fit.u) - 0.2 * fit.period, EVERY * fit.period)
    shifts = np.round(times / fit.block).astype(np.int64)
    guesses: list[tuple[float, Reals]] = []
    for theta in thetas:
        rss = _by_time(fit, structure, theta, shifts)
        guesses += [(float(rss[i]), np.append(theta, shifts[i] * fit.block)) for i in np.argsort(rss)[:3]]
    guesses.sort(key=lambda each: each[0])
    starts = fit.distinct([theta for _, theta in guesses], structure, 6)
    rough = sorted(fit.descended(structure, hypothesis, starts, FIRST_STEPS), key=by_bic)
    return [fit.search(structure, hypothesis, [each.theta]) for each in rough[:2]]


def search_last_load_again(fit: Fit[S], found: Fitted) -> list[Fitted]:
    """The last step of the load looked for once more over the whole record, with the plant now better known."""
    return _timed(fit, found.structure, found.hypothesis.load_disturbances - 1, [found.theta[:-1]])


def _by_time(fit: Fit[S], structure: Structure, theta: Reals, shifts: NDArray[np.int64]) -> Reals:
    """Sum of squares left with one step of the load more at each of these rows; a load only shifts its response."""
    order = structure.order
    base = fit.regressors(structure, DisturbanceHypothesis(len(theta) - structure.searched), theta[None])[0]
    q = np.linalg.qr(base)[0]
    rest = fit.y - q @ (q.T @ fit.y)
    monic = structure.monic(theta[: structure.searched])[None, :]
    answer = averaged(pulses(monic, [0.0], order).drive(np.ones(len(fit.u)))[0], fit.block)
    answer = answer / np.max(np.abs(answer), axis=0)
    shifted = np.zeros((len(shifts), fit.samples, order))
    for i, m in enumerate(shifts):
        shifted[i, m:] = answer[: fit.samples - m]
    across = np.einsum("nk,snj->skj", q, shifted, optimize=True)
    gram = np.swapaxes(shifted, 1, 2) @ shifted - np.swapaxes(across, 1, 2) @ across
    scale = np.maximum(np.einsum("sii->s", gram), 1e-12)[:, None, None]
    along = np.einsum("snj,n->sj", shifted, rest, optimize=True)
    weights = np.linalg.solve(gram + 1e-9 * scale * np.eye(order), along[:, :, None])[:, :, 0]
    return np.asarray(rest @ rest - np.einsum("si,si->s", weights, along))
