"""The starts of the search: for each denominator, every dead time of whole samples is evaluated at the cost of one.

A dead time of whole samples only shifts the response, so the correlations with PV for all of them are one convolution.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.fft import next_fast_len

from loopwright.tuning.analysis.zero_order_hold import states
from loopwright.tuning.identification.structures import Structure
from loopwright.tuning.models import Reals

RATIO = 2.0
DAMPING_RATIOS = (0.15, 0.4, 0.7)


def starts(structure: Structure, u: Reals, y: Reals, max_dead_time: int, nuisance: bool, keep: int) -> list[Reals]:
    """The `keep` best distinct theta, best first, from a coarse grid of denominators and every whole dead time.

    structure: the model structure.
    u, y: MV and PV in scaled units, shape (N,).
    max_dead_time: the longest dead time, in samples.
    nuisance: a load disturbance at the start of the record, with the same denominator, is allowed for.
    """
    found: list[tuple[float, Reals]] = []
    for logs in _denominators(structure, len(u)):
        monic = structure.monic(np.append(logs, 0.0))
        response = states(monic, 0.0, u, structure.inputs)
        others = np.ones((len(u), 1))
        if nuisance:
            others = np.concatenate((others, states(monic, 0.0, np.ones(len(u)), structure.order)), axis=1)
        rss = _of_all_shifts(response, y, others, max_dead_time)
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
    """The logarithms of the searched coefficients on the grid: time constants from half a sample to ten records."""
    count = 1 + math.ceil(math.log(20.0 * samples) / math.log(RATIO))
    times = np.geomspace(0.5, 10.0 * samples, count)
    if structure.lags == 0:
        return [np.empty(0)]
    if structure.lags == 1:
        return [np.log([1.0 / T]) for T in times]
    real = [np.log([1.0 / T1 + 1.0 / T2, 1.0 / (T1 * T2)]) for i, T1 in enumerate(times) for T2 in times[: i + 1]]
    within = times[(times > 1.0) & (times < samples)]
    return real + [np.log([2.0 * zeta / T, 1.0 / T**2]) for T in within for zeta in DAMPING_RATIOS]


def _of_all_shifts(responses: Reals, y: Reals, others: Reals, maximum: int) -> Reals:
    """The residual sums of squares of fits of y by the responses, shifted by 0, 1, ... `maximum` samples, and the
    other columns; shape (maximum + 1,)."""
    columns = responses / np.maximum(np.sqrt(np.sum(responses**2, axis=0)), 1e-300)
    basis = np.linalg.qr(others)[0]
    rest = y - basis @ (basis.T @ y)
    products = _shifted_products(np.column_stack((rest, basis)), columns, maximum)
    with_y, with_basis = products[:, 0], products[:, 1:]
    count = columns.shape[1]
    gram = 1e-9 * np.eye(count) - np.einsum("mqi,mqj->mij", with_basis, with_basis)
    for i in range(count):
        for j in range(count):
            # samples shifted beyond the end do not count
            gram[:, i, j] += np.cumsum(columns[:, i] * columns[:, j])[::-1][: maximum + 1]
    weights = np.linalg.solve(gram, with_y[:, :, None])[:, :, 0]
    return np.asarray(rest @ rest - np.sum(weights * with_y, axis=1))


def _shifted_products(fixed: Reals, shifted: Reals, maximum: int) -> Reals:
    """The sums over k of fixed[k, q]*shifted[k-m, i] for m = 0 ... maximum, shape (maximum + 1, columns of each)."""
    size = next_fast_len(2 * len(fixed), real=True)
    spectrum = np.fft.rfft(fixed, size, axis=0)[:, :, None] * np.fft.rfft(shifted, size, axis=0).conj()[:, None, :]
    return np.asarray(np.fft.irfft(spectrum, size, axis=0)[: maximum + 1])
