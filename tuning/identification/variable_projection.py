"""Separable least squares: the linear coefficients are solved for, the few other parameters are searched from starts.

The method is variable projection (Golub and Pereyra, 1973) with steps of Levenberg and Marquardt and Kaufman's slopes
(BIT 15, 1975): the slope of the projected residual without the term that vanishes with the residual, so that all slopes
cost one solution of the linear part. Starts are independent and evaluated as one batch, because call overhead
dominates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.identification.projection import Projection
from loopwright.tuning.identification.regressors import Regressors, Rows
from loopwright.tuning.models import Reals

MAX_TRIES = 12
FIRST_DAMPING, MIN_DAMPING = 1e-3, 1e-12
MIN_PROMISED_DECREASE = 0.1
"""Smallest decrease that a step must promise to be tried, as a fraction of the decrease at which a search ends."""
MIN_SLOPE = 1e-9
"""Smallest slope of a parameter, as a fraction of the largest slope; a smaller one is a rounding error."""
MIN_SINGULAR = 1e-9
"""Relative singular value, of columns of unit length, below which the data do not show a direction."""


@dataclass(frozen=True, slots=True)
class LinearFit:
    """A linear least-squares fit.

    coefficients: shape (columns,).
    residual: shape (N,).
    rss: the residual sum of squares.
    """

    coefficients: Reals
    residual: Reals
    rss: float


def solve(columns: Reals, y: Reals) -> LinearFit:
    """The linear least-squares fit of y, shape (N,), by the columns, shape (N, columns), scaled to unit length."""
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    found = np.linalg.lstsq(columns / lengths, y, rcond=1e-12)[0] / lengths
    residual = y - columns @ found
    return LinearFit(found, residual, float(residual @ residual))


@dataclass(frozen=True, slots=True, eq=False)
class SearchBounds:
    """The limits of the search for each parameter, arrays of shape (parameters,).

    low, high: the bounds.
    max_step: the longest step of one iteration.
    step: the step of the forward difference.
    """

    low: Reals
    high: Reals
    max_step: Reals
    step: Reals


def descend(
    regressors_of: Callable[[Reals], Regressors],
    y: Reals,
    starts: Reals,
    bounded: SearchBounds,
    max_steps: int,
    relative_decrease: float,
    sums_of: Callable[[Reals, Reals], Reals] | None = None,
) -> tuple[Reals, Reals]:
    """The local minimum of the sum of squares that each start leads to: (the points, the sums of squares there).

    regressors_of: gives a set of regressors for each point; points of shape (points, parameters).
    y: the output, shape (N,).
    starts: the starts, shape (starts, parameters).
    bounded: the limits of the search.
    max_steps: the largest number of iterations.
    relative_decrease: a search ends when an iteration lowers its sum of squares by less than this fraction.
    sums_of: gives the sums of the regressors for each point with coefficients of shape (points, columns), as shape
    (points, N), where this costs less than the regressors.
    """
    if sums_of is None:

        def sums_of(points: Reals, linear: Reals) -> Reals:
            return regressors_of(points).times(linear)

    low, high, max_step = bounded.low, bounded.high, bounded.max_step
    at = np.clip(starts, low, high)
    here = Projection.of(regressors_of(at), y)
    cost = here.rss
    damping = np.full(len(at), FIRST_DAMPING)
    one = np.eye(at.shape[1])
    going = np.arange(len(at))
    for _ in range(max_steps):
        slopes = _slopes(sums_of, at, here, going, bounded)
        turned = np.swapaxes(slopes, 1, 2)
        gradient = (turned @ here.rest[going, :, None])[:, :, 0]
        # a parameter pressed against its bound stays there
        now = at[going]
        free = ~(((now <= low) & (gradient > 0.0)) | ((now >= high) & (gradient < 0.0)))
        normal = turned @ slopes
        scale = np.sqrt(np.einsum("bii->bi", normal))
        free &= scale > MIN_SLOPE * scale.max(axis=1, keepdims=True)
        gradient = np.where(free, gradient, 0.0)
        normal = np.where(free[:, :, None] & free[:, None, :], normal, 0.0)
        scale[~free] = 1.0
        gradient /= scale
        normal /= scale[:, :, None] * scale[:, None, :]

        before = cost[going]
        trying = np.arange(len(going))
        for _ in range(MAX_TRIES):
            mine = going[trying]
            A, b = normal[trying], gradient[trying]
            move = -np.linalg.solve(A + damping[mine, None, None] * one, b[:, :, None])[:, :, 0]
            promised = -2.0 * np.einsum("bi,bi->b", b, move) - np.einsum("bi,bij,bj->b", move, A, move)
            promising = promised > MIN_PROMISED_DECREASE * relative_decrease * cost[mine]
            trying, mine, move = trying[promising], mine[promising], move[promising]
            if not len(trying):
                break
            new = np.clip(at[mine] + np.clip(move / scale[trying], -max_step, max_step), low, high)
            there = Projection.of(regressors_of(new), y)
            better = there.rss < cost[mine]
            won = mine[better]
            at[won], cost[won] = new[better], there.rss[better]
            here.replace(won, there, better)
            damping[won] = np.maximum(0.2 * damping[won], MIN_DAMPING)
            damping[mine[~better]] *= 4.0
            trying = trying[~better]
        going = going[before - cost[going] > relative_decrease * before]
        if not len(going):
            break
    return at, cost


def _slopes(
    sums_of: Callable[[Reals, Reals], Reals], at: Reals, here: Projection, which: Rows, bounded: SearchBounds
) -> Reals:
    """The slopes of the residuals at these points by each parameter, shape (points, N, parameters)."""
    points, count = at[which], at.shape[1]
    signed = np.where(points + bounded.step <= bounded.high, bounded.step, -bounded.step)
    # the points themselves in the same call, which rounds alike: the slope of a parameter without influence is then 0
    moved = np.repeat(points[:, None, :], count + 1, axis=1)
    moved[:, np.arange(count), np.arange(count)] += signed
    answers = sums_of(moved.reshape(-1, count), np.repeat(here.linear[which], count + 1, axis=0))
    answers = answers.reshape(len(points), count + 1, -1)
    change = np.swapaxes((answers[:, :-1] - answers[:, -1:]) / signed[:, :, None], 1, 2)
    return -here.beyond(change, which)


def covariance(columns: Reals, variance: float) -> Reals:
    """variance * (A'A)^-1 of the columns A; a direction that the data do not show gets a very large but finite
    value."""
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    _, singular, turned = np.linalg.svd(columns / lengths, full_matrices=False)
    weighted = turned.T / np.maximum(singular, MIN_SINGULAR * singular[0])
    return np.asarray(variance * (weighted @ weighted.T) / np.outer(lengths, lengths))
