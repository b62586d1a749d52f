"""The fits of model structures to one record of any shape: separable least squares from several starts, with BIC,
tests of the residual, and the covariance of the parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np

from loopwright.tuning.identification.initial_guesses import starts
from loopwright.tuning.identification.output_error import (
    FLOOR,
    LOG_STEP,
    NOT_AT_REST_INITIALLY,
    DisturbanceHypothesis,
    Fit,
    Fitted,
    count,
)
from loopwright.tuning.identification.record import RecordedTest
from loopwright.tuning.identification.residuals import variance_inflation, whiteness
from loopwright.tuning.identification.sensitivity import sensitivities, slopes_of
from loopwright.tuning.identification.structures import Plant, Structure
from loopwright.tuning.identification.variable_projection import SearchBounds, covariance, descend, solve
from loopwright.tuning.models import Model, Reals, TransferFunction
from loopwright.tuning.reasons import Reason, Refused

NEGLIGIBLE_RMS = 1.5e-3
"""rms of a residual, as a fraction of the range of PV, below which its whiteness does not matter."""
MAX_RESOLUTION = 0.1
"""Resolution of PV, as a fraction of its range, above which it hides the response and not only the noise."""
WHITE_ABOVE = 1e-3
"""p-value above which a residual counts as white."""
MIN_BIC_GAIN_OF_MV = 10.0
"""Smallest decrease of BIC by which PV must be better explained with MV than without MV."""
MAX_NOISE = 0.5
"""Noise, as a fraction of the range of PV's response to MV, above which the noise itself may determine the model."""
STARTS = 3
MAX_STEPS = 60
RELATIVE_DECREASE = 1e-7
LONGEST_LAG = 30.0  # in records
SHORTEST_LAG = 0.1  # in samples
# limits of a search around a time scale: the periods in a record, the averages in it, and the averages in a period
MAX_PERIODS = 50.0
MAX_AVERAGES = 1000
AVERAGES_PER_PERIOD = 80.0
MIN_AVERAGES_PER_PERIOD = 30.0
MIN_PERIOD = 8.0  # samples


@dataclass(frozen=True, slots=True, eq=False)
class ScaledRecord:
    """A record with the scales that `tuning.identification.output_error.RecordToFit` asks for."""

    Ts: float
    u: Reals
    y: Reals
    input_range: float
    output_range: float
    period: float
    max_dead_time: float
    block: int

    @property
    def pieces(self) -> tuple[int, ...]:
        """The record is one piece."""
        return (len(self.y),)

    @property
    def u_earlier(self) -> tuple[Reals, ...]:
        """MV was 0 before the record."""
        return ()


class IdentificationProblem:
    """The identification problem of one record: its fits, their residuals and their meaning.

    The record is scaled: time is in samples, MV and PV are in units of their largest change.
    """

    def __init__(self, record: RecordedTest) -> None:
        self.record = record
        change = record.u - record.u_before
        self.mv_unit = float(np.max(np.abs(change)))
        self.pv_unit = float(np.ptp(record.y))
        self.u = change / self.mv_unit
        self.y = (record.y - record.y[0]) / self.pv_unit
        self.samples = len(self.y)
        self.resolution = float(np.min(np.diff(np.unique(np.round(self.y, 9)))))
        # the rounding error is uniform over a step of the resolution
        self.rounding = min(self.resolution, MAX_RESOLUTION) / math.sqrt(12.0)
        # a quarter more than the average rounding error, which is not quite random
        self.negligible_rms = max(NEGLIGIBLE_RMS, 1.25 * self.rounding)
        # a response that begins later than this shows too little of itself
        self.max_dead_time = max(1, int(0.7 * (self.samples - record.first_move)))
        self.full_fit = self.fit_around(0.1 * self.samples, 1)

    def fit_around(self, period: float, block: int | None = None) -> Fit[ScaledRecord]:
        """The fits for a search around a time scale.

        period: the time scale, in samples.
        block: the number of samples that are averaged into one; by default as many as the time scale permits.
        """
        period = min(max(period, self.samples / MAX_PERIODS, MIN_PERIOD), float(self.samples))
        wanted = max(period / AVERAGES_PER_PERIOD, self.samples / MAX_AVERAGES)
        block = block or max(1, int(min(wanted, period / MIN_AVERAGES_PER_PERIOD)))
        record = self.record
        signals = ScaledRecord(
            record.Ts, self.mv_unit * self.u, self.pv_unit * self.y, self.mv_unit, self.pv_unit,
            period, float(self.max_dead_time), block,
        )  # fmt: skip
        return Fit(signals)

    def fit(self, structure: Structure, hypothesis: DisturbanceHypothesis) -> Fitted:
        """The best of a few searches from the most promising starts.

        hypothesis: UNDISTURBED or NOT_AT_REST_INITIALLY.
        """
        not_at_rest = hypothesis == NOT_AT_REST_INITIALLY
        begun = starts(structure, self.u, self.y, self.max_dead_time, not_at_rest, STARTS)
        return self.refined(structure, hypothesis, begun)

    def refined(self, structure: Structure, hypothesis: DisturbanceHypothesis, begun: Sequence[Reals]) -> Fitted:
        """The best of the searches from these starts, on every sample."""
        low, high = self._bounds(structure, hypothesis)
        times = 1 + hypothesis.load_disturbances
        max_step = np.append(np.full(structure.lags, 1.5), np.full(times, max(5.0, 0.2 * self.max_dead_time)))
        step = np.append(np.full(structure.lags, 1e-5), np.full(times, 1e-4))

        regressors = partial(self.full_fit.regressors, structure, hypothesis)
        sums = partial(self.full_fit.sums, structure, hypothesis)
        bounded = SearchBounds(low, high, max_step, step)
        found, rss = descend(regressors, self.y, np.array(begun), bounded, MAX_STEPS, RELATIVE_DECREASE, sums)
        return self.fitted(structure, hypothesis, found[np.argmin(rss)])

    def fitted(self, structure: Structure, hypothesis: DisturbanceHypothesis, theta: Reals) -> Fitted:
        """The fit at this theta on every sample, with the BIC by which all candidates are compared."""
        found = self.full_fit.fitted(structure, hypothesis, theta)
        return replace(found, bic=self._bic(found.linear.rss, count(found)))

    # what is left

    def residual_matters(self, fit: Fitted) -> bool:
        """Whether the residual is large enough that its whiteness matters."""
        return fit.rms > self.negligible_rms

    def explains(self, fit: Fitted, white_above: float = WHITE_ABOVE) -> bool:
        """Whether the fit explains the record: its residual is negligible or white, with a p-value above the limit."""
        return not self.residual_matters(fit) or self.whiteness(fit) >= white_above

    def whiteness(self, fit: Fitted) -> float:
        """The p-value of the test of whiteness of the residual, see `tuning.identification.residuals`."""
        return whiteness(fit.linear.residual, len(fit.theta))

    def noise(self, fit: Fitted) -> float:
        """The rms of the residual as a fraction of the range of PV's response to MV."""
        inputs = fit.structure.inputs
        return fit.rms / float(np.ptp(fit.columns[:, :inputs] @ fit.linear.coefficients[:inputs]))

    def bic_gain(self, fit: Fitted, over: Fitted) -> float:
        """By how much BIC is lower for `fit` than for `over`. A residual that is not white counts as fewer samples, by
        its variance inflation."""
        samples = self.samples / (variance_inflation(fit.linear.residual) if self.residual_matters(fit) else 1.0)
        more = count(fit) - count(over)
        floor = self._floor()
        ratio = (over.linear.rss / self.samples + floor) / (fit.linear.rss / self.samples + floor)
        return samples * math.log(ratio) - more * math.log(max(samples, 2.0))

    def response_visible(self, fit: Fitted) -> bool:
        """Whether PV is explained better with MV than without MV, by more than chance."""
        inputs = fit.structure.inputs
        rss = solve(fit.columns[:, inputs:], self.y).rss
        return self._bic(rss, fit.parameters - inputs - len(fit.theta)) >= fit.bic + MIN_BIC_GAIN_OF_MV

    def require_visible_response(self, fit: Fitted) -> None:
        """Raises Refused, NO_RESPONSE or NOISE_TOO_HIGH, unless PV answers MV by more than chance and above the
        noise."""
        if not self.response_visible(fit):
            noise = self.pv_unit * solve(fit.columns[:, fit.structure.inputs :], self.y).rss ** 0.5 / self.samples**0.5
            raise Refused(
                Reason.NO_RESPONSE,
                f"no response of PV to MV is visible: without MV the record is explained to within {noise:.3g} "
                f"PV units, with it to within {self.pv_unit * fit.rms:.3g}; move MV further (it moved by "
                f"{self.mv_unit:.3g}) or record for longer",
            )
        if self.noise(fit) > MAX_NOISE:
            raise Refused(
                Reason.NOISE_TOO_HIGH,
                f"the noise of PV, {self.pv_unit * fit.rms:.3g} PV units, is {100.0 * self.noise(fit):.0f} % of its "
                f"response to MV; at most {100.0 * MAX_NOISE:.0f} % is accepted: move MV further (it moved by "
                f"{self.mv_unit:.3g})",
            )

    # what it means

    def model(self, fit: Fitted) -> Model:
        """The fitted model in s and the units of the record."""
        return self._model(fit.structure, fit.theta, fit.linear.coefficients[: fit.structure.inputs])

    def parameters(self, fit: Fitted) -> tuple[dict[str, float], Reals]:
        """The parameters of the model by name, in their units, and their covariance in the same order; see
        `parameters_of`."""
        structure, searched = fit.structure, fit.structure.searched
        at = np.concatenate((fit.theta[:searched], fit.linear.coefficients[: structure.inputs]))
        values = parameters_of(self.model(fit))

        def moved(at: Reals) -> Reals:
            return np.array(list(parameters_of(self._model(structure, at[:searched], at[searched:])).values()))

        # a dead time cannot be negative, but central differences need room below it
        at[structure.lags] = max(at[structure.lags], 2.0 * LOG_STEP)
        slopes = slopes_of(moved, at, searched)
        kept = np.concatenate((np.arange(searched), len(fit.theta) + np.arange(structure.inputs)))
        return values, slopes @ self.covariance(fit)[np.ix_(kept, kept)] @ slopes.T

    def load_disturbances(self, fit: Fitted) -> list[tuple[Reals, Reals]]:
        """For each load disturbance: (time at which PV answers, time at which it enters at the plant's input, size),
        and the standard errors of these.

        Times are in s since the first sample, the size is in MV units.
        """
        structure, lags = fit.structure, fit.structure.lags
        first = len(fit.theta)
        found = []
        for i in range(fit.hypothesis.load_disturbances):
            of_load = first + self.full_fit.first_load(structure, fit.hypothesis) + i * structure.order

            def values(at: Reals, i: int = i, of_load: int = of_load) -> Reals:
                seen = at[structure.searched + i]
                moved = replace(fit, theta=at[:first], linear=replace(fit.linear, coefficients=at[first:]))
                size = at[of_load] / structure.slowest(at[:first]) / self.full_fit.static_gain(moved)
                Ts = self.record.Ts
                return np.array([seen * Ts, (seen - at[lags]) * Ts, size * self.mv_unit])

            at = np.concatenate((fit.theta, fit.linear.coefficients))
            slopes = slopes_of(values, at, first)
            spread = np.diag(slopes @ self.covariance(fit) @ slopes.T)
            found.append((values(at), np.sqrt(np.maximum(spread, 0.0))))
        return found

    def covariance(self, fit: Fitted) -> Reals:
        """The linearised covariance of theta and of the linear coefficients, in this order.

        The variance of the residual is multiplied by its variance inflation, which allows for noise that is not white.
        """
        variance = fit.linear.rss / max(self.samples - fit.parameters, 1) * variance_inflation(fit.linear.residual)
        return covariance(sensitivities(self.full_fit, fit), variance)

    def _model(self, structure: Structure, theta: Reals, inputs: Reals) -> Model:
        if structure.lags_only:
            return self._plant(structure, theta, float(inputs[0]))
        plant = self.full_fit.transfer(structure, theta, inputs)
        unit = plant.den[structure.lags]
        return TransferFunction(tuple(b / unit for b in plant.num), tuple(a / unit for a in plant.den), plant.L)

    def _plant(self, structure: Structure, theta: Reals, b0: float) -> Plant:
        return structure.plant(theta, b0 * self.pv_unit / self.mv_unit, self.record.Ts)

    def _bounds(self, structure: Structure, hypothesis: DisturbanceHypothesis) -> tuple[Reals, Reals]:
        slow, fast = math.log(1.0 / (LONGEST_LAG * self.samples)), math.log(1.0 / SHORTEST_LAG)
        low, high = np.full(structure.lags, slow), np.full(structure.lags, fast)
        if structure.lags > 1:
            # the product of two rates; a natural period under six samples is an alias
            low[1], high[1] = 2.0 * slow, 0.0
        low, high = np.append(low, 0.0), np.append(high, float(self.max_dead_time))
        loads = hypothesis.load_disturbances
        return np.append(low, np.zeros(loads)), np.append(high, np.full(loads, self.samples - 2.0))

    def _floor(self) -> float:
        return FLOOR**2 + self.rounding**2

    def _bic(self, rss: float, parameters: int) -> float:
        return self.samples * math.log(rss / self.samples + self._floor()) + parameters * math.log(self.samples)


def parameters_of(model: Model) -> dict[str, float]:
    """The parameters of a model by name; a lag that the model does not have is left out.

    A transfer function has its coefficients as num[0], den[0] and so on, highest power first, and dead_time_s.
    Coefficients that are 0 or 1 by definition are left out.
    """
    if isinstance(model, TransferFunction):
        num = {f"num[{i}]": value for i, value in enumerate(model.num)}
        den = {f"den[{i}]": value for i, value in enumerate(model.den) if i < len(np.trim_zeros(model.den, "b")) - 1}
        return num | den | {"dead_time_s": model.L}
    values = {field.name: float(getattr(model, field.name)) for field in fields(model)}
    return {name: value for name, value in values.items() if not (name == "T" and value == 0.0)}
