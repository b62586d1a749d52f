"""The uncertainty of Ms that the uncertainty of the model causes: by the delta method, and among rival models."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from loopwright.tuning.fast.design.design import controller
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import LOG_STEP, DisturbanceHypothesis, Fit, Fitted
from loopwright.tuning.identification.sensitivity import sensitivities
from loopwright.tuning.models import Complexes, Reals, TransferFunction, sign

NEAR_THE_PEAK = 0.7
"""Smallest |S| at which a model error is counted: where the sensitivity S is smaller, an error does not raise Ms."""
STANDARD_DEVIATIONS = 2.0
LOG_RATE_KNOWN = 3.0
"""Standard deviation of the logarithm of a rate before the record is seen."""
UNSEEN = 1e-7
"""Singular value, of columns of unit length, below which the record does not show a direction of the parameters."""
MIN_DISTANCE = 0.05
"""Smallest distance of the loop from -1 that is used; closer than that, Ms is not bounded."""


def durbin_watson_ratio(residual: Reals) -> float:
    """2/d with the Durbin-Watson statistic d of the residual, at least 1: 1 for white noise, larger for slow noise.

    residual: shape (N,), with a mean of about zero. Source: J. Durbin, G. S. Watson, Biometrika 37, 1950, the statistic
    d, which is the sum of the squared differences of neighbours divided by the sum of squares.
    """
    fast = 0.5 * float(np.mean(np.diff(residual) ** 2))
    return max(1.0, float(np.mean(residual**2)) / fast) if fast > 0.0 else 1.0


def fit_covariance(fit: Fit[ExperimentRecord], found: Fitted) -> Reals:
    """The covariance of theta and of the linear coefficients, in this order, shape (parameters, parameters).

    The variance of the residual is multiplied by its Durbin-Watson ratio. Under pulses of the set-point, what a drift
    of PV and a start that was not at rest would explain tells nothing of the model.
    """
    variance = found.linear.rss / max(fit.samples - found.parameters, 1) * durbin_watson_ratio(found.linear.residual)
    if fit.record.excitation is Excitation.RELAY:
        return seen_covariance(sensitivities(fit, found), variance)
    columns = unknown_columns(fit, found)
    known = math.sqrt(variance) * _known_before(fit, found, columns.shape[1])
    return seen_covariance(np.vstack((columns, known)), variance)


def unknown_columns(fit: Fit[ExperimentRecord], found: Fitted) -> Reals:
    """The sensitivities of PV to everything that the fit does not know beforehand, shape (rows, parameters and more).

    A drift of PV and a start that was not at rest follow after theta and the linear coefficients. Several pieces have
    a level and a start of their own already, which stand for a drift.
    """
    if fit.starts_are_free:
        return sensitivities(fit, found)
    other = DisturbanceHypothesis(drift=True, not_at_rest_initially=True)
    everything = fit.regressors(found.structure, other, found.theta[None, : found.structure.searched]).dense()[0]
    first = fit.first_load(found.structure, found.hypothesis)  # the level of PV is among the columns already
    return np.column_stack((sensitivities(fit, found), everything[:, first:]))


def _known_before(fit: Fit[ExperimentRecord], found: Fitted, parameters: int) -> Reals:
    """What is known of theta without the record, as rows of sensitivities in standard deviations, shape (searched,
    parameters): a rate is known to a factor, a dead time to the longest one that is searched.

    A rate beyond the sampling and the dead time can replace each other without a trace in the record. Without these
    rows such a direction would be so long that its linear approximation has no meaning.
    """
    structure = found.structure
    size = np.append(np.full(structure.lags, LOG_RATE_KNOWN), fit.record.max_dead_time)
    return np.asarray(np.eye(structure.searched, parameters) / size[:, None])


def seen_covariance(columns: Reals, variance: float) -> Reals:
    """variance * (A'A)^-1 without the directions of the parameters that hardly move PV: they hardly move the loop.

    columns: the sensitivities A, shape (N, parameters).
    """
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    inverse = np.linalg.pinv(columns / lengths, rcond=UNSEEN)
    return np.asarray(variance * (inverse @ inverse.T) / np.outer(lengths, lengths))


def uncertainty_of_Ms(
    fit: Fit[ExperimentRecord], found: Fitted, gains: Gains, w: Reals, N: float, delay: float
) -> float:
    """Ms with the model two standard deviations off, less the nominal Ms, by the delta method.

    gains: the controller.
    w: the frequency grid, rad/s.
    N: the derivative filter is Td/N.
    delay: the delay of the sampling, s.
    """
    structure = found.structure
    distance, along = distance_from_instability(fit, found, gains, w, N, delay)
    inputs = structure.inputs
    whole = fit_covariance(fit, found)
    kept = np.concatenate((np.arange(structure.searched), len(found.theta) + np.arange(inputs)))
    sigma = np.sqrt(np.maximum(np.einsum("iw,ij,jw->w", along, whole[np.ix_(kept, kept)], along), 0.0))
    near = distance < 1.0 / NEAR_THE_PEAK
    worst = np.maximum(distance - STANDARD_DEVIATIONS * sigma, MIN_DISTANCE)[near]
    return float(1.0 / worst.min() - 1.0 / distance.min()) if near.any() else 0.0


def distance_from_instability(
    fit: Fit[ExperimentRecord], found: Fitted, gains: Gains, w: Reals, N: float, delay: float
) -> tuple[Reals, Reals]:
    """|1 + L| at the frequencies w, and its slopes by the parameters of the plant: shapes (w,) and (parameters, w).

    The parameters are theta without the times of loads, then the linear coefficients of MV. See `uncertainty_of_Ms`.
    """
    structure, theta, c = found.structure, found.theta, found.linear.coefficients
    inputs = structure.inputs
    at = np.concatenate((theta[: structure.searched], c[:inputs]))
    C = gains.Kp * controller(w, gains.Ti, gains.Td, N) * sign(fit.model(found))

    def loop(at: Reals) -> Complexes:
        model = fit.transfer(structure, at[: structure.searched], at[structure.searched :])
        return np.asarray(C * _delayed(model, w, delay))

    nominal = loop(at)
    slopes = []
    for i in range(len(at)):
        if i == structure.lags:
            slopes.append(-1j * w * fit.record.Ts * nominal)
            continue
        step = LOG_STEP * (abs(at[i]) + 1e-12 if i >= structure.searched else 1.0)
        move = np.zeros(len(at))
        move[i] = step
        # Weak directions of the covariance are long, so their contributions must cancel to many digits.
        slopes.append((loop(at + move) - loop(at - move)) / (2.0 * step))
    distance = np.abs(1.0 + nominal)
    along = np.real(np.array(slopes) * np.conj(1.0 + nominal) / distance)
    return distance, along


def difference_of_rivals(
    fit: Fit[ExperimentRecord], best: Fitted, rivals: Sequence[Fitted], gains: Gains, w: Reals, delay: float
) -> float:
    """The largest |Ms - nominal Ms| that the same controller has on a rival model; w in rad/s, delay in s."""
    nominal = peak(fit.model(best), gains, w, delay)
    return max((abs(peak(fit.model(rival), gains, w, delay) - nominal) for rival in rivals), default=0.0)


def peak(model: TransferFunction, gains: Gains, w: Reals, delay: float = 0.0) -> float:
    """Ms of the loop on the frequency grid w (rad/s), with a further delay (s)."""
    C = gains.Kp * controller(w, gains.Ti, gains.Td, filter_ratio(gains)) * sign(model)
    minimum = float(np.abs(1.0 + C * _delayed(model, w, delay)).min())
    return 1.0 / max(minimum, 1e-9) if math.isfinite(minimum) else math.inf


def filter_ratio(gains: Gains) -> float:
    """N of the derivative filter Td/N; it is without effect where there is no derivative."""
    return gains.Td / gains.Tf if gains.Tf > 0.0 else 10.0


def _delayed(model: TransferFunction, w: Reals, delay: float) -> Complexes:
    return np.asarray(model.frequency_response(w) * np.exp(-1j * w * delay))
