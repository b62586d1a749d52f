"""Which set-point changes one plant explains without a disturbance.

A load disturbance in a change, or an older plant, would enter the model of all changes; operation offers others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from loopwright.tuning.fast.design.uncertainty import durbin_watson_ratio
from loopwright.tuning.fast.evaluation.evaluation import NEGLIGIBLE_RESIDUAL
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.disturbances import answers_to_load, by_bic, fit_structures
from loopwright.tuning.identification.output_error import UNDISTURBED, Fit, Fitted
from loopwright.tuning.models import Reals

MAX_RESIDUAL = 1.5
"""Largest residual of a change, in standard deviations of the noise at rest; of a loop almost without noise what
`evaluate` accepts in any case."""
MAX_BY_LOAD = 25.0
"""Largest part of the sum of squares of a change's residual, in variances of the noise, that one load disturbance may
explain."""
LOAD_TIME_SPACING = 0.25
"""Distance of the times at which a load disturbance is looked for, in periods."""
FIRST_CHANGES = 4
"""Number of changes with which a set of consistent ones is begun, one after the other, until it has half of all."""

Record = Callable[[Sequence[int]], ExperimentRecord]


def consistent(record: Record, changes: int) -> list[int]:
    """The numbers of the changes that belong together, ascending; of several such sets the one that begins latest.

    record: makes the record of some of the changes, by their numbers. changes: the number of changes, oldest first.
    All changes are returned where no two belong together.
    """
    everything = list(range(changes))
    fit = Fit(record(everything))
    found = min(fit_structures(fit, UNDISTURBED), key=by_bic)
    if _undisturbed(fit, found):
        return everything
    largest: list[int] = []
    for first in reversed(everything[-FIRST_CHANGES:]):
        kept = _around(first, record, everything, found)
        if len(kept) > len(largest):
            largest = kept
        if 2 * len(largest) >= changes:
            break
    return largest if len(largest) > 1 else everything


def _around(first: int, record: Record, changes: Sequence[int], start: Fitted) -> list[int]:
    """The changes that belong to the same plant as this one."""
    kept, theta = [first], start.theta
    for change in reversed(changes):
        if change == first:
            continue
        fit = Fit(record(sorted([change, *kept])))
        found = fit.search(start.structure, UNDISTURBED, [theta])
        if _undisturbed(fit, found):
            kept = sorted([change, *kept])
            theta = found.theta
    return kept


def _undisturbed(fit: Fit[ExperimentRecord], found: Fitted) -> bool:
    """Whether what the fit leaves of every change is noise, and no load disturbance in any of them explains much of
    it.

    A load just before the rest makes the noise at rest look larger than it is; half of the changes know better.
    """
    left_of_each = [float(np.sqrt(np.mean(found.linear.residual[rows] ** 2))) for rows in fit.rows[1:]]
    noise = min(fit.record.noise / fit.record.output_range, float(np.median(left_of_each)))
    noise = max(noise, NEGLIGIBLE_RESIDUAL / MAX_RESIDUAL)
    variance = noise**2 * max(fit.record.durbin_watson_ratio_at_rest, durbin_watson_ratio(found.linear.residual))
    longest = max(piece.stop - piece.start for piece in fit.pieces)
    answer = answers_to_load(found.structure, found.theta[None], longest, fit.block)[0]
    spacing = max(1, round(LOAD_TIME_SPACING * fit.period / fit.block))
    for rows, left in zip(fit.rows[1:], left_of_each, strict=True):
        if left > MAX_RESIDUAL * noise:
            return False
        if _explained_by_load(found.linear.residual[rows], answer, spacing) > MAX_BY_LOAD * variance:
            return False
    return True


def _explained_by_load(residual: Reals, answer: Reals, spacing: int) -> float:
    """The largest decrease of the sum of squares of a residual by a load disturbance at one of the times."""
    rows, order = len(residual), answer.shape[1]
    known = np.linalg.qr(np.column_stack((np.ones(rows), answer[:rows])))[0]
    largest = 0.0
    for at in range(spacing, rows - 2 * order, spacing):
        column = np.zeros((rows, order))
        column[at:] = answer[: rows - at]
        column -= known @ (known.T @ column)
        basis = np.linalg.qr(column)[0]
        largest = max(largest, float(np.sum((basis.T @ residual) ** 2)))
    return largest
