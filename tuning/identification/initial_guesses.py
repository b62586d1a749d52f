"""The starts of the search: for each denominator, every dead time of whole samples is evaluated at the cost of one.

A dead time of whole samples only shifts the response, so the correlations with PV for all of them are one convolution.
"""

from __future__ import annotations

import math

import numpy as np

from loopwright.tuning.analysis.zero_order_hold import pulses
from loopwright.tuning.identification.shifts import SAMPLES_TOGETHER, products_within, shifted_products
from loopwright.tuning.identification.structures import Structure
from loopwright.tuning.models import Reals

RATIO = 2.0
DAMPING_RATIOS = (0.15, 0.4, 0.7)
REDUNDANT = 1e-9
"""Size of a response of unit length, less what the other columns show of it, below which it adds nothing."""


def starts(structure: Structure, u: Reals, y: Reals, max_dead_time: int, nuisance: bool, keep: int) -> list[Reals]:
    """The `keep` best distinct theta, best first, from a coarse grid of denominators and every whole dead time.

    structure: the model structure.
    u, y: MV and PV in scaled units, shape (N,).
    max_dead_time: the longest dead time, in samples.
    nuisance: a load disturbance at the start of the record, with the same denominator, is allowed for.
    """
    found: list[tuple[float, Reals]] = []
    denominators = _denominators(structure, len(u))
    together = max(1, SAMPLES_TOGETHER // len(u))
    for part in (denominators[i : i + together] for i in range(0, len(denominators), together)):
        monics = structure.monic(np.array([np.append(logs, 0.0) for logs in part]))
        plants = pulses(monics, np.zeros(len(part)), structure.order)
        responses = np.swapaxes(plants.drive(u, structure.inputs), 1, 2)
        others = np.ones((len(u), 1))[None]
        if nuisance:
            loads = plants.drive(np.ones(len(u)))
            others = np.concatenate((np.broadcast_to(others, (len(part), len(u), 1)), loads), axis=2)
        rss = _of_all_shifts(responses, y, others, max_dead_time)
        for logs, row in zip(part, rss, strict=True):
            m = int(np.argmin(row))
            found.append((float(row[m]), np.append(logs, float(m))))
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
    """The residual sums of squares of fits of y by the responses of each plant, shifted by 0, 1, ... `maximum` samples,
    and the other columns; shape (plants, maximum + 1).

    responses: shape (plants, responses, N).  others: shape (plants, N, columns), or (1, N, columns) for all plants.
    """
    lengths = np.sqrt(np.einsum("prn,prn->pr", responses, responses))
    rows = responses / np.maximum(lengths, 1e-300)[:, :, None]
    basis = np.swapaxes(np.linalg.qr(others)[0], 1, 2)
    rest = y - (np.swapaxes(basis, 1, 2) @ (basis @ y)[:, :, None])[:, :, 0]
    products = shifted_products(np.concatenate((rest[:, None], basis), axis=1), rows)[..., : maximum + 1]
    with_y, with_basis = products[:, 0], products[:, 1:]
    gram = products_within(rows)[..., ::-1][..., : maximum + 1] - np.einsum("pqim,pqjm->pijm", with_basis, with_basis)
    left = np.einsum("bn,bn->b", rest, rest)[:, None]
    if rows.shape[1] == 1:
        return np.asarray(left - with_y[:, 0] ** 2 / (gram[:, 0, 0] + REDUNDANT))
    gram = np.moveaxis(gram, -1, 1) + REDUNDANT * np.eye(rows.shape[1])
    weights = np.linalg.solve(gram, np.swapaxes(with_y, 1, 2)[..., None])[..., 0]
    return np.asarray(left - np.einsum("pmi,pim->pm", weights, with_y))
