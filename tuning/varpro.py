"""Separable least squares: linear coefficients solved for, the few others searched by Levenberg and Marquardt.

Variable projection (Golub and Pereyra, 1973): the residual is taken after the best linear fit, so its derivative by the
searched parameters already contains how the linear ones follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tuning.models import Reals

MOST_STEPS = 60
RELATIVE_DECREASE = 1e-7
# directions weaker than this, in columns of unit length, are not seen in the data
LEAST_SINGULAR = 1e-9


@dataclass(frozen=True, slots=True)
class Linear:
    """coefficients: shape (columns,).  residual: shape (N,).  rss: its sum of squares."""

    coefficients: Reals
    residual: Reals
    rss: float


def solve(columns: Reals, y: Reals) -> Linear:
    """Least squares with columns of unit length."""
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    found = np.linalg.lstsq(columns / lengths, y, rcond=1e-12)[0] / lengths
    residual = y - columns @ found
    return Linear(found, residual, float(residual @ residual))


def search(
    residual: Callable[[Reals], Reals],
    start: Reals,
    low: Reals,
    high: Reals,
    reach: Reals,
    step: Reals,
    slopes_of: Callable[[Reals, Reals, Reals, Reals], Reals] | None = None,
    most_steps: int = MOST_STEPS,
    relative_decrease: float = RELATIVE_DECREASE,
) -> tuple[Reals, float]:
    """A local minimum of the sum of squares within the bounds: (where, the sum there).

    reach: the longest step of each parameter.  step: for its forward difference.  slopes_of: the residual's derivative
    at (theta, residual there, high, step), by default by differences of the residual itself.
    """
    at = np.clip(start, low, high)
    r = residual(at)
    cost, damping = float(r @ r), 1e-3
    for _ in range(most_steps):
        slopes = slopes_of(at, r, high, step) if slopes_of else jacobian(residual, at, r, high, step)
        normal, gradient = slopes.T @ slopes, slopes.T @ r
        scale = np.diag(normal).copy()
        scale[scale <= 0.0] = 1.0
        # a parameter pressed against its bound stays there
        free = ~(((at <= low) & (gradient > 0.0)) | ((at >= high) & (gradient < 0.0)))
        if not free.any():
            break
        before = cost
        for _ in range(12):
            move = np.zeros_like(at)
            lhs = normal[np.ix_(free, free)] + damping * np.diag(scale[free])
            move[free] = np.linalg.lstsq(lhs, -gradient[free], rcond=None)[0]
            new = np.clip(at + np.clip(move, -reach, reach), low, high)
            r_new = residual(new)
            if float(r_new @ r_new) < cost:
                at, r, cost = new, r_new, float(r_new @ r_new)
                damping = max(0.2 * damping, 1e-12)
                break
            damping *= 4.0
        if before - cost <= relative_decrease * before:
            break
    return at, cost


def jacobian(residual: Callable[[Reals], Reals], at: Reals, r: Reals, high: Reals, step: Reals) -> Reals:
    """Forward differences of the residual, backward at the upper bound; shape (N, parameters)."""
    columns = []
    for i, h in enumerate(step):
        moved = at.copy()
        signed = h if at[i] + h <= high[i] else -h
        moved[i] += signed
        columns.append((residual(moved) - r) / signed)
    return np.stack(columns, axis=1)


def covariance(columns: Reals, variance: float) -> Reals:
    """variance * (A'A)^-1 of the columns A; a direction the data do not show gets a very large but finite value."""
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    _, singular, turned = np.linalg.svd(columns / lengths, full_matrices=False)
    weighted = turned.T / np.maximum(singular, LEAST_SINGULAR * singular[0])
    return np.asarray(variance * (weighted @ weighted.T) / np.outer(lengths, lengths))
