"""What each excitation would tell of Ms, predicted with a model before the loop is moved.

The course of MV is simulated with the model. The covariance of the model's coefficients that white noise of PV would
leave, with a level and a drift of PV unknown, gives the standard deviation of Ms by the delta method. The information
is the reciprocal of the variance (R. A. Fisher, Phil. Trans. R. Soc. A 222, 1922); it is stated per ultimate period.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.fast.design.design import frequencies
from loopwright.tuning.fast.design.uncertainty import STANDARD_DEVIATIONS, peak
from loopwright.tuning.fast.evaluation.evaluation import MAX_UNCERTAINTY
from loopwright.tuning.fast.experiment import VERIFICATION_PERIODS
from loopwright.tuning.fast.forecast import Past, forecast, oscillation, pv_of
from loopwright.tuning.fast.pulses.levels import CAME_BACK, FOLLOWED_TO_ONE_SIDE, MIN_FOLLOWED
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model, Reals, TransferFunction, sign
from loopwright.tuning.reasons import Ended

SAMPLES_PER_PERIOD = 60
LOOKS = (2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
"""Lengths of a record for which the uncertainty is predicted, in ultimate periods: four switches of a relay take two;
pulses last for two, and until the next look agrees."""
RELATIVE_STEP = 1e-4
UNSEEN = 1e-9


@dataclass(frozen=True, slots=True)
class Moved:
    """How a loop may be moved.

    gains, new: the present gains, and those whose Ms is to be known.
    pulse, step: the size of a pulse, and of the step under the new gains, PV units.
    high, low: the amplitudes of the relay's sides, MV units.
    noise: the standard deviation of PV at each sample of the controller, PV units.
    sample_time_s: the sample time of the controller, s.
    one_sided: whether the pulses go to one side of rest only. sp_rate_max_per_s: the largest rate of the set-point.
    """

    gains: Gains
    new: Gains
    pulse: float
    step: float
    high: float
    low: float
    noise: float
    sample_time_s: float
    one_sided: bool = False
    sp_rate_max_per_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Expected:
    """What an excitation would tell.

    information_per_period: the information on Ms of the new gains per ultimate period.
    uncertainty: how far Ms may be off after it, two standard deviations.
    duration_s: the time until Ms is known well enough, or of the longest record, s; the step under the new gains that
    follows takes three ultimate periods more.
    """

    information_per_period: float
    uncertainty: float
    duration_s: float


def expected(model: Model, moved: Moved, excitation: Excitation) -> Expected | None:
    """What an excitation would tell by a model; None where the model has no ultimate point. `observe` stands for the
    step under the new gains alone.

    model: the process model, without the delay of the sampling.
    """
    try:
        period_s = ultimate_point(model)[1]
    except Ended:
        return None
    Ts = period_s / SAMPLES_PER_PERIOD
    # white noise: the mean of the controller's samples in one of these
    noise = moved.noise * math.sqrt(min(moved.sample_time_s / Ts, 1.0))
    if excitation is Excitation.OBSERVE:
        lengths: tuple[float, ...] = (VERIFICATION_PERIODS,)
    else:
        lengths = LOOKS if excitation is Excitation.RELAY else LOOKS[1:]
    u = _mv(model, moved, excitation, Ts, int(lengths[-1] * SAMPLES_PER_PERIOD))
    columns, slopes = _sensitivities(model, moved.new, u, Ts, 0.5 * moved.sample_time_s, period_s)
    found = Expected(0.0, math.inf, lengths[-1] * period_s)
    for length in lengths:
        deviation = noise * _deviation(columns[: int(length * SAMPLES_PER_PERIOD)], slopes)
        information = 1.0 / max(deviation, 1e-9) ** 2 / length
        found = Expected(information, STANDARD_DEVIATIONS * deviation, length * period_s)
        if found.uncertainty <= MAX_UNCERTAINTY[excitation]:
            break
    return found


def _mv(model: Model, moved: Moved, excitation: Excitation, Ts: float, samples: int) -> Reals:
    """MV under an excitation, as a deviation from rest."""
    if excitation is Excitation.RELAY:
        return oscillation(model, Ts, moved.high, moved.low, samples)
    sp_step = moved.sp_rate_max_per_s * Ts
    past = Past(Ts, np.zeros(3), np.zeros(3), np.zeros(3), -math.inf, math.inf, sign(model), moved.gains, sp_step)
    if excitation is Excitation.OBSERVE:
        return forecast(model, past, moved.new, np.array([moved.step]), samples).mv[:, 0]
    level, turns = 0.0, (moved.pulse, 0.0 if moved.one_sided else -moved.pulse, moved.pulse)
    for number, turned in enumerate(turns):
        before, level = level, turned
        course = forecast(model, past, moved.gains, np.array([level]), samples)
        pv, mv = course.pv[:, 0], course.mv[:, 0]
        followed = _followed(pv, past.pv[-1], level - before, moved.one_sided)
        until = int(np.argmax(followed)) + 1 if followed.any() and number < 2 else samples
        farthest = sp_step * np.arange(1, until + 1)
        past = replace(
            past,
            sp=np.append(past.sp, past.sp[-1] + np.clip(level - past.sp[-1], -farthest, farthest)),
            pv=np.append(past.pv, pv[:until]),
            mv=np.append(past.mv, mv[:until]),
        )
    return past.mv[3 : 3 + samples]


def _followed(pv: Reals, begun: float, move: float, one_sided: bool) -> NDArray[np.bool_]:
    """At which samples after a move of the set-point PV has followed far enough for the next one, see `pulse_test`."""
    if not one_sided:
        return np.asarray((pv - begun) * math.copysign(1.0, move) >= MIN_FOLLOWED * abs(move))
    if move > 0.0:
        return np.asarray(pv - begun >= FOLLOWED_TO_ONE_SIDE * move)
    farthest = np.maximum.accumulate(pv)
    return np.asarray(farthest - pv >= CAME_BACK * farthest)


def _sensitivities(
    model: Model, gains: Gains, u: Reals, Ts: float, delay: float, period_s: float
) -> tuple[Reals, Reals]:
    """The derivatives of PV by the model's coefficients and dead time, shape (N, parameters), and those of Ms."""
    num, den = np.array(model.num), np.array(model.den)
    at = np.concatenate((num, den[1:], [model.L]))
    size = np.append(np.abs(at[:-1]), 0.1 * period_s)
    w = frequencies(period_s)

    def of(parameters: Reals) -> TransferFunction:
        top, below = parameters[: len(num)], parameters[len(num) : -1]
        return TransferFunction(tuple(top), (float(den[0]), *below), max(float(parameters[-1]), 0.0))

    columns, slopes = [], []
    for i in np.flatnonzero(size):
        move = np.zeros(len(at))
        move[i] = RELATIVE_STEP * size[i]
        low = at - move if i < len(at) - 1 or at[-1] > move[-1] else at
        above, below = of(at + move), of(low)
        apart = 2.0 if low is not at else 1.0
        columns.append((pv_of(above, u, Ts) - pv_of(below, u, Ts)) / (apart * RELATIVE_STEP))
        slopes.append((peak(above, gains, w, delay) - peak(below, gains, w, delay)) / (apart * RELATIVE_STEP))
    return np.stack(columns, axis=1), np.array(slopes)


def _deviation(columns: Reals, slopes: Reals) -> float:
    """The standard deviation of Ms for noise of 1."""
    rows = len(columns)
    known = np.linalg.qr(np.column_stack((np.ones(rows), np.linspace(-1.0, 1.0, rows))))[0]
    left = columns - known @ (known.T @ columns)
    lengths = np.maximum(np.linalg.norm(left, axis=0), 1e-300)
    inverse = np.linalg.pinv(left / lengths, rcond=UNSEEN)
    return float(np.linalg.norm((slopes / lengths) @ inverse))
