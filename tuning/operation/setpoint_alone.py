"""Ms by what the set-point alone moved, an estimate that noise and loads in the closed loop do not bias.

The set-point is an instrument: what it moves through the loop is independent of loads and noise, while MV in a closed
loop is not. One step of the instrumental-variable method from the fitted model corrects its parameters. Source: P. Van
den Hof, R. Schrama, Automatica 29, 1993; T. Soderstrom, P. Stoica, Instrumental Variable Methods, 1983.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from loopwright.tuning.analysis.step_response import step_response
from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.uncertainty import distance_from_instability, unknown_columns
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.proposal import delayed
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.identification.sensitivity import sensitivities
from loopwright.tuning.models import Reals, TransferFunction, sign
from loopwright.tuning.operation.history import SetpointChange

UNSEEN = 1e-3
"""Singular value, relative to the largest, below which the set-point does not show a direction of the parameters."""


def Ms_by_setpoint_alone(evaluation: Evaluation, changes: Sequence[SetpointChange], N: float) -> float:
    """Ms of the gains of an evaluation on the model corrected by what the set-point alone moved.

    changes: the set-point changes, the pieces of the record after the first.
    N: the derivative filter is Td/N.
    """
    fit, best = evaluation.fit, evaluation.chosen.best
    record, structure = fit.record, best.structure
    u = np.zeros(len(record.u))
    at = record.lengths[0]
    for change, length in zip(changes, record.lengths[1:], strict=True):
        u[at : at + length] = mv_of_setpoint(delayed(evaluation.model, evaluation.design_delay), change)
        at += length
    instruments = Fit(replace(record, u=u, u_earlier=()))
    moved = _moved_by(instruments, best)
    slopes = unknown_columns(fit, best)
    kept = np.concatenate((np.arange(structure.searched), len(best.theta) + np.arange(structure.inputs)))
    others = np.delete(slopes, kept, axis=1)
    basis = np.linalg.svd(others / np.maximum(np.linalg.norm(others, axis=0), 1e-300), full_matrices=False)[0]

    def apart(columns: Reals) -> Reals:
        return np.asarray(columns - basis @ (basis.T @ columns))

    Z, J, r = apart(moved[:, kept]), apart(slopes[:, kept]), apart(best.linear.residual)
    lengths = np.linalg.norm(J, axis=0)
    Z /= np.maximum(np.linalg.norm(Z, axis=0), 1e-300)
    step = np.linalg.pinv(Z.T @ (J / lengths), rcond=UNSEEN) @ (Z.T @ r) / lengths
    w = frequencies(evaluation.period)
    distance, along = distance_from_instability(fit, best, evaluation.best.gains, w, N, evaluation.design_delay)
    return float(np.max(1.0 / np.maximum(distance + step @ along, 0.05)))


def mv_of_setpoint(model: TransferFunction, change: SetpointChange) -> Reals:
    """MV, as a deviation, as the set-point alone moves it through the loop of the model and the gains in effect."""
    stretch, samples = change.stretch, change.end - change.first
    answer = step_response(model, stretch.gains, samples * stretch.Ts)
    unit = sign(model) * np.interp(np.arange(samples) * stretch.Ts, answer.t, answer.u)
    found = np.zeros(samples)
    sp = stretch.sp[change.samples]
    for k in np.flatnonzero(np.diff(sp)) + 1:
        found[k:] += (sp[k] - sp[k - 1]) * unit[: samples - k]
    return found


def _moved_by(instruments: Fit[ExperimentRecord], found: Fitted) -> Reals:
    """The sensitivities of PV to the parameters of the plant where MV is moved by the set-point alone."""
    inputs = found.structure.inputs
    plant_alone = np.where(np.arange(len(found.linear.coefficients)) < inputs, found.linear.coefficients, 0.0)
    columns = instruments.regressors(found.structure, found.hypothesis, found.theta[None]).dense()[0]
    linear = replace(found.linear, coefficients=plant_alone)
    return sensitivities(instruments, replace(found, columns=columns, linear=linear))
