"""Which structure the record supports, and whether something beside MV moved PV.

Seven structures by BIC. What the noise does not explain is first taken for a step of the load at a free time, then for
two, or for a drift; such a story must earn its parameters clearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuning.fast.evidence import averaged
from tuning.fast.fit import QUIET, Fit, Fitted, Hypothesis
from tuning.models import Reals
from tuning.sampled import pulses
from tuning.structures import (
    FIRST,
    FIRST_FED,
    SECOND,
    SECOND_FED,
    SECOND_WITH_ZERO,
    THIRD_WITH_ZERO,
    THIRD_WITH_ZEROS,
    Structure,
)

STRUCTURES = (FIRST, FIRST_FED, SECOND, SECOND_WITH_ZERO, SECOND_FED, THIRD_WITH_ZERO, THIRD_WITH_ZEROS)
RIVAL = 10.0
"""Of BIC: structures this near to the best could be true as well."""
EARNED = 15.0
"""Of BIC: what a story beside MV must gain."""
UNEXPLAINED = 1.15
"""Of the noise at rest: a residual above it asks for a story."""
UNIMPORTANT = 0.0015
"""Of PV's span: a residual below it never does."""
SLOW = 2.0
"""Periods, of the slowest lag, from which a drift is tried in any case."""
STARTS = 2
THIRD_RATES = (1.0, 40.0)  # 1/period
THIRD_STARTS = 3
THIRD_DEAD_TIMES = (-0.12, -0.04, 0.02)  # periods, from that of two lags
EVERY = 0.1  # periods, between the first guesses of a load's time
FIRST_STEPS = 8
LOAD_DEAD_TIMES = (0.06, 0.14, 0.23, 0.41)  # periods


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """best: the fit to go on with.  rivals: others that could be true as well.  fits: all with the same story."""

    best: Fitted
    rivals: tuple[Fitted, ...]
    fits: tuple[Fitted, ...]


def choose(fit: Fit, known: Sequence[Fitted] = ()) -> Chosen:
    """known: fits of an earlier part of the same record, from which is started as well."""
    quiet = _all(fit, QUIET, known)
    found = quiet
    first = min(quiet, key=_bic)
    if _unexplained(fit, first):
        found = _better(found, _stories(fit, quiet, known))
    elif _slow(fit, first):
        # MV at rest is known as well as the noise lets it be; what it is off by is a drift to a slow plant
        drift = Hypothesis(drift=True)
        drifting = _all(fit, drift, [*known, *_under(drift, quiet)])
        found = drifting if min(map(_bic, drifting)) < first.bic else found
    ranked = sorted(found, key=_bic)
    # the record hardly shows the static gain of a slow plant; that it has the wrong sign is then no finding
    ranked = [each for each in ranked if fit.goes_right(each)] or ranked
    rivals = tuple(each for each in ranked[1:] if each.bic < ranked[0].bic + RIVAL)
    same = tuple(each for each in ranked if each.hypothesis == ranked[0].hypothesis)
    return Chosen(ranked[0], rivals, same)


def _stories(fit: Fit, quiet: list[Fitted], known: Sequence[Fitted]) -> list[Fitted]:
    """All structures with one step of the load; with a drift, or a second step, where that leaves something over."""
    found = _all(fit, Hypothesis(loads=1), (*known, *_with_load(fit, quiet, known)))
    if _unexplained(fit, min(found, key=_bic)):
        drift = Hypothesis(drift=True)
        twice = _all(fit, Hypothesis(loads=2), (*known, *_with_load(fit, found, known)))
        found = _better(_better(found, _all(fit, drift, [*known, *_under(drift, quiet)])), twice)
    return found


def _better(simple: list[Fitted], story: list[Fitted]) -> list[Fitted]:
    return story if min(map(_bic, story)) < min(map(_bic, simple)) - EARNED else simple


def _slow(fit: Fit, found: Fitted) -> bool:
    """The slowest lag is longer than the relay's record can show whole."""
    poles = np.roots(np.append(1.0, found.structure.monic(found.theta[: found.structure.searched])))
    return bool(np.min(np.abs(poles)) < 1.0 / (SLOW * fit.period))


def _all(fit: Fit, hypothesis: Hypothesis, known: Sequence[Fitted]) -> list[Fitted]:
    """Every structure under this hypothesis; those with the same denominator share where they begin."""
    times = _times(hypothesis, known)
    begun: dict[int, list[Reals]] = {}
    quiet = hypothesis == QUIET
    for plain in (FIRST, SECOND):
        if hypothesis.loads == 1:
            begun[plain.lags] = fit.grid(plain, STARTS, float(times[0]))
        else:
            begun[plain.lags] = [np.append(theta, times) for theta in fit.grid(plain, STARTS)]
    found: list[Fitted] = []
    for structure in STRUCTURES:
        same = [k.theta for k in known if k.structure.lags == structure.lags and k.hypothesis == hypothesis]
        exact = [k.theta for k in known if k.structure is structure and k.hypothesis == hypothesis]
        starts = [*exact, *same[:STARTS], *begun.get(structure.lags, [])]
        if structure.lags == 3:
            simpler = [each for each in found if each.structure in (SECOND, SECOND_WITH_ZERO)]
            if quiet and 3 not in begun:
                # three lags have many local minima: a grid around the dead time that two lags have come to
                L = min(simpler, key=_bic).theta[2] / fit.period
                around = [L + change for change in THIRD_DEAD_TIMES]
                begun[3] = fit.grid(THIRD_WITH_ZEROS, THIRD_STARTS, dead_times=around)
                starts += begun[3]
            starts += [_third(fit, each, rate) for each in simpler for rate in THIRD_RATES]
            starts += [each.theta for each in found if each.structure is THIRD_WITH_ZERO]
        elif structure is not FIRST and structure is not SECOND:
            starts += [each.theta for each in found if each.structure.lags == structure.lags]
        found.append(fit.search(structure, hypothesis, _distinct(starts)))
    return found


def _third(fit: Fit, simpler: Fitted, rate: float) -> Reals:
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


def _times(hypothesis: Hypothesis, known: Sequence[Fitted]) -> Reals:
    """Of the loads, as best known."""
    best = min((k for k in known if k.hypothesis == hypothesis), key=_bic, default=None)
    return best.theta[best.structure.searched :] if best is not None else np.zeros(hypothesis.loads)


def _under(hypothesis: Hypothesis, found: Sequence[Fitted]) -> list[Fitted]:
    """The same parameters to begin with under a hypothesis that has as many."""
    return [replace(each, hypothesis=hypothesis) for each in found if not each.hypothesis.loads]


def _with_load(fit: Fit, simpler: Sequence[Fitted], known: Sequence[Fitted]) -> list[Fitted]:
    """Fits with one step of the load more than `simpler`, from the most promising times.

    Of the second order, and of the structure that has explained most so far.
    """
    loads = simpler[0].hypothesis.loads
    second = min((each for each in simpler if each.structure is SECOND), key=_bic)
    thetas = [second.theta]
    if not loads:
        thetas += [np.append(logs, L * fit.period) for logs in fit.denominators(SECOND) for L in LOAD_DEAD_TIMES]
    found = _timed(fit, SECOND, loads, thetas)
    likely = [min(simpler, key=_bic), *(each for each in known if each.hypothesis.loads == loads)][:2]
    for each in likely:
        if each.structure is not SECOND:
            found += _timed(fit, each.structure, loads, [each.theta])
    return found


def _timed(fit: Fit, structure: Structure, loads: int, thetas: Sequence[Reals]) -> list[Fitted]:
    """Two fits at most with one step of the load more than each theta has."""
    hypothesis = Hypothesis(loads + 1)
    times = np.arange(0.0, len(fit.u) - 0.2 * fit.period, EVERY * fit.period)
    shifts = np.round(times / fit.block).astype(np.int64)
    guesses: list[tuple[float, Reals]] = []
    for theta in thetas:
        rss = _by_time(fit, structure, theta, shifts)
        guesses += [(float(rss[i]), np.append(theta, shifts[i] * fit.block)) for i in np.argsort(rss)[:3]]
    guesses.sort(key=lambda each: each[0])
    starts = fit.differing([theta for _, theta in guesses], structure, 6)
    rough = sorted(fit.followed(structure, hypothesis, starts, FIRST_STEPS), key=_bic)
    return [fit.search(structure, hypothesis, [each.theta]) for each in rough[:2]]


def _by_time(fit: Fit, structure: Structure, theta: Reals, shifts: NDArray[np.int64]) -> Reals:
    """Sum of squares left with one step of the load more at each of these rows; a load only shifts its response."""
    order = structure.order
    base = fit.regressors(structure, Hypothesis(len(theta) - structure.searched), theta[None])[0]
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


def _unexplained(fit: Fit, best: Fitted) -> bool:
    return best.rms > max(UNEXPLAINED * fit.evidence.noise / fit.evidence.span, UNIMPORTANT)


def _bic(fitted: Fitted) -> float:
    return fitted.bic
