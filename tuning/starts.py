"""Where to start the search: every whole dead time of a denominator at the cost of one.

A dead time of whole samples only shifts the response, so its correlation with PV for all of them is one convolution.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import correlate

from tuning.models import Reals
from tuning.sampled import states
from tuning.structures import Structure

RATIO = 2.0
DAMPING_RATIOS = (0.15, 0.4, 0.7)


def starts(structure: Structure, u: Reals, y: Reals, most_dead_time: int, nuisance: bool, keep: int) -> list[Reals]:
    """The `keep` best theta that differ, best first, of a coarse grid of denominators and every whole dead time.

    nuisance: a load step from the start is allowed for, with the same denominator.
    """
    found: list[tuple[float, Reals]] = []
    for logs in _denominators(structure, len(u)):
        monic = structure.monic(np.append(logs, 0.0))
        response = states(monic, 0.0, u, 1)[:, 0]
        others = np.ones((len(u), 1))
        if nuisance:
            others = np.concatenate((others, states(monic, 0.0, np.ones(len(u)), structure.order)), axis=1)
        rss = _of_all_shifts(response, y, others, most_dead_time)
        m = int(np.argmin(rss))
        found.append((float(rss[m]), np.append(logs, float(m))))
    found.sort(key=lambda each: each[0])
    kept: list[Reals] = []
    for _, theta in found:
        if all(_differ(theta, other) for other in kept):
            kept.append(theta)
        if len(kept) == keep:
            break
    return kept


def _differ(a: Reals, b: Reals) -> bool:
    apart = np.abs(a - b)
    return bool(apart[-1] > 0.1 * (1.0 + max(a[-1], b[-1])) or np.any(apart[:-1] > 1.5))


def _denominators(structure: Structure, samples: int) -> list[Reals]:
    """Logs of the searched coefficients; time constants from half a sample to ten records."""
    count = 1 + math.ceil(math.log(20.0 * samples) / math.log(RATIO))
    times = np.geomspace(0.5, 10.0 * samples, count)
    if structure.lags == 0:
        return [np.empty(0)]
    if structure.lags == 1:
        return [np.log([1.0 / T]) for T in times]
    real = [np.log([1.0 / T1 + 1.0 / T2, 1.0 / (T1 * T2)]) for i, T1 in enumerate(times) for T2 in times[: i + 1]]
    within = times[(times > 1.0) & (times < samples)]
    return real + [np.log([2.0 * zeta / T, 1.0 / T**2]) for T in within for zeta in DAMPING_RATIOS]


def _of_all_shifts(x: Reals, y: Reals, others: Reals, most: int) -> Reals:
    """Sum of squares that is left of y after a fit by x shifted by 0, 1, ... `most` samples and by the others."""
    basis = np.linalg.qr(others)[0]
    rest = y - basis @ (basis.T @ y)
    size = np.cumsum(x * x)[::-1][: most + 1].copy()
    whole = size[0]
    for column in basis.T:
        size -= _shifted_products(column, x, most) ** 2
    with_y = _shifted_products(rest, x, most)
    seen = size > 1e-9 * whole
    return np.asarray(rest @ rest - np.where(seen, with_y**2 / np.where(seen, size, 1.0), 0.0))


def _shifted_products(y: Reals, x: Reals, most: int) -> Reals:
    """Sum over k of y[k]*x[k-m] for m = 0 ... most."""
    full = correlate(y, x, mode="full", method="fft")
    return np.asarray(full[len(x) - 1 : len(x) + most])
