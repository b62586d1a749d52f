"""Whether the last piece of a record shows the same plant as the pieces before it.

A score test, without a new fit: the plant of the last piece may have parameters of its own. What all pieces together
explain is projected out of the sensitivities of the last piece to the plant's parameters, and of the residual; the
regression of the one on the other tells by how much the plant has changed. Source: the Lagrange multiplier test, C. R.
Rao, Proc. Cambridge Phil. Soc. 44, 1948, for a change of parameters at a known time, G. C. Chow, Econometrica 28, 1960.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.fast.design.uncertainty import (
    durbin_watson_ratio,
    unknown_columns,
)
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.models import Reals

UNSEEN = 1e-6
"""Singular value, of columns of unit length, below which the last piece does not show a direction by itself."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the plant of the last piece compares with that of the pieces before.

    gain: the plant's gain in the last piece over that of the pieces before, and its standard deviation, where nothing
    else has changed.
    later_s: by how much the dead time is longer in the last piece, and its standard deviation, s, where nothing else
    has changed.
    chi: how much of the residual a plant of its own for the last piece explains, in variances of the residual.
    parameters: the number of parameters of such a plant that the last piece shows.
    """

    gain: tuple[float, float]
    later_s: tuple[float, float]
    chi: float
    parameters: int


def agreement(evaluation: Evaluation) -> Agreement:
    """Compares the last piece of the record of an evaluation with those before it."""
    fit, found = evaluation.fit, evaluation.chosen.best
    structure, inputs = found.structure, found.structure.inputs
    columns = unknown_columns(fit, found)
    plant = np.concatenate((np.arange(structure.searched), len(found.theta) + np.arange(inputs)))
    rows = fit.rows[-1]
    alone = np.zeros((len(columns), len(plant)))
    alone[rows] = columns[rows][:, plant]
    answer = np.zeros((len(columns), 1))
    answer[rows, 0] = found.columns[rows, :inputs] @ found.linear.coefficients[:inputs]
    basis = _basis(columns)
    residual = found.linear.residual - basis @ (basis.T @ found.linear.residual)
    variance = found.linear.rss / max(fit.samples - found.parameters, 1) * durbin_watson_ratio(found.linear.residual)

    def apart(further: Reals) -> Reals:
        return np.asarray(further - basis @ (basis.T @ further))

    def one(further: Reals) -> tuple[float, float]:
        left = apart(further)[:, 0]
        power = float(left @ left)
        return (float(left @ residual) / power, math.sqrt(variance / power)) if power > 0.0 else (0.0, math.inf)

    gain, dead_time = one(answer), one(alone[:, [structure.lags]])
    own = _basis(apart(alone / np.maximum(np.linalg.norm(alone, axis=0), 1e-300)), UNSEEN)
    chi = float(np.sum((own.T @ residual) ** 2)) / variance if variance > 0.0 else math.inf
    Ts = fit.record.Ts
    return Agreement((1.0 + gain[0], gain[1]), (Ts * dead_time[0], Ts * dead_time[1]), chi, own.shape[1])


def _basis(columns: Reals, unseen: float = 1e-9) -> Reals:
    lengths = np.linalg.norm(columns, axis=0)
    left, singular, _ = np.linalg.svd(columns[:, lengths > 0.0] / lengths[lengths > 0.0], full_matrices=False)
    return np.asarray(left[:, singular > unseen * singular[0]])
