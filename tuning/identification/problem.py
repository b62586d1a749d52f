"""Structures fitted to one record of any shape: separable least squares from several starts, BIC, covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

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

# rms of a residual, as a part of PV's span, of which it does not matter what it consists of
UNIMPORTANT = 1.5e-3
# a resolution coarser than this part of the span hides the response, not only the noise
COARSEST = 0.1
WHITE_ABOVE = 1e-3
# difference of BIC by which PV must be better explained with MV than without
VISIBLE = 10.0
# noise, as a part of the response's span, beyond which what is found may be a shape of the noise
NOISIEST = 0.5
STARTS = 3
MAX_STEPS = 60
RELATIVE_DECREASE = 1e-7
LONGEST_LAG = 30.0  # in records
SHORTEST_LAG = 0.1  # in samples
# of a wider search: periods that a record has at most, averages in it, and averages in a period at least
MAX_PERIODS = 50.0
MAX_AVERAGES = 1000
AVERAGES_PER_PERIOD = 80.0
MIN_AVERAGES_PER_PERIOD = 30.0
MIN_PERIOD = 8.0  # samples


@dataclass(frozen=True, slots=True, eq=False)
class ScaledRecord:
    """The record in the units that `tuning.identification.output_error.Signals` wants."""

    Ts: float
    u: Reals
    y: Reals
    input_range: float
    output_range: float
    period: float
    max_dead_time: float
    block: int


class IdentificationProblem:
    """The record in units of its own: time in samples, MV and PV in their largest change."""

    def __init__(self, record: RecordedTest) -> None:
        self.record = record
        change = record.u - record.u_before
        self.mv_unit = float(np.max(np.abs(change)))
        self.pv_unit = float(np.ptp(record.y))
        self.u = change / self.mv_unit
        self.y = (record.y - record.y[0]) / self.pv_unit
        self.samples = len(self.y)
        self.resolution = float(np.min(np.diff(np.unique(np.round(self.y, 9)))))
        # what rounding leaves is spread evenly over a step of the resolution
        self.rounding = min(self.resolution, COARSEST) / math.sqrt(12.0)
        # a quarter more than rounding leaves on average, for it is not quite random
        self.negligible_rms = max(UNIMPORTANT, 1.25 * self.rounding)
        # a response that begins later than this is not to be told from its beginning
        self.max_dead_time = max(1, int(0.7 * (self.samples - record.first_move)))
        self.full_fit = self.fit_around(0.1 * self.samples, 1)

    def fit_around(self, period: float, block: int | None = None) -> Fit[ScaledRecord]:
        """For a search around a time scale, in samples, on averages of so many samples; by default what it needs."""
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
        """The best of a few searches from the most promising starts; nothing or MOVING for a hypothesis."""
        moving = hypothesis == NOT_AT_REST_INITIALLY
        begun = starts(structure, self.u, self.y, self.max_dead_time, moving, STARTS)
        return self.refined(structure, hypothesis, begun)

    def refined(self, structure: Structure, hypothesis: DisturbanceHypothesis, begun: Sequence[Reals]) -> Fitted:
        """The best of the searches from these starts, on every sample."""
        low, high = self._bounds(structure, hypothesis)
        times = 1 + hypothesis.load_disturbances
        max_step = np.append(np.full(structure.lags, 1.5), np.full(times, max(5.0, 0.2 * self.max_dead_time)))
        step = np.append(np.full(structure.lags, 1e-5), np.full(times, 1e-4))

        def columns(thetas: Reals) -> Reals:
            return self.full_fit.regressors(structure, hypothesis, thetas)

        bounded = SearchBounds(low, high, max_step, step)
        found, rss = descend(columns, self.y, np.array(begun), bounded, MAX_STEPS, RELATIVE_DECREASE)
        return self.fitted(structure, hypothesis, found[np.argmin(rss)])

    def fitted(self, structure: Structure, hypothesis: DisturbanceHypothesis, theta: Reals) -> Fitted:
        """On every sample, with the BIC that all are compared by."""
        found = self.full_fit.fitted(structure, hypothesis, theta)
        return replace(found, bic=self._bic(found.linear.rss, count(found)))

    # what is left

    def residual_matters(self, fit: Fitted) -> bool:
        """Whether what is left must be noise."""
        return fit.rms > self.negligible_rms

    def explains(self, fit: Fitted, white_above: float = WHITE_ABOVE) -> bool:
        """Nothing of weight is left that is not noise."""
        return not self.residual_matters(fit) or self.whiteness(fit) >= white_above

    def whiteness(self, fit: Fitted) -> float:
        """p-value, see `tuning.identification.residuals`."""
        return whiteness(fit.linear.residual, len(fit.theta))

    def noise(self, fit: Fitted) -> float:
        """The residual's rms as a part of the span of PV's response to MV."""
        inputs = fit.structure.inputs
        return fit.rms / float(np.ptp(fit.columns[:, :inputs] @ fit.linear.coefficients[:inputs]))

    def bic_gain(self, fit: Fitted, over: Fitted) -> float:
        """Of BIC, where a residual that is not white counts as so many fewer samples."""
        samples = self.samples / (variance_inflation(fit.linear.residual) if self.residual_matters(fit) else 1.0)
        more = count(fit) - count(over)
        floor = self._floor()
        ratio = (over.linear.rss / self.samples + floor) / (fit.linear.rss / self.samples + floor)
        return samples * math.log(ratio) - more * math.log(max(samples, 2.0))

    def response_visible(self, fit: Fitted) -> bool:
        """PV is explained better with MV than without, more than by chance."""
        inputs = fit.structure.inputs
        rss = solve(fit.columns[:, inputs:], self.y).rss
        return self._bic(rss, fit.parameters - inputs - len(fit.theta)) >= fit.bic + VISIBLE

    def require_visible_response(self, fit: Fitted) -> None:
        """Refused unless PV answers MV: more than by chance, and above the noise."""
        if not self.response_visible(fit):
            noise = self.pv_unit * solve(fit.columns[:, fit.structure.inputs :], self.y).rss ** 0.5 / self.samples**0.5
            raise Refused(
                Reason.NO_RESPONSE,
                f"no response of PV to MV is visible: without MV the record is explained to within {noise:.3g} "
                f"PV units, with it to within {self.pv_unit * fit.rms:.3g}; move MV further (it moved by "
                f"{self.mv_unit:.3g}) or record for longer",
            )
        if self.noise(fit) > NOISIEST:
            raise Refused(
                Reason.NOISE_TOO_HIGH,
                f"the noise of PV, {self.pv_unit * fit.rms:.3g} PV units, is {100.0 * self.noise(fit):.0f} % of its "
                f"response to MV; at most {100.0 * NOISIEST:.0f} % is accepted: move MV further (it moved by "
                f"{self.mv_unit:.3g})",
            )

    # what it means

    def model(self, fit: Fitted) -> Model:
        """In s and the units of the record."""
        return self._model(fit.structure, fit.theta, fit.linear.coefficients[: fit.structure.inputs])

    def parameters(self, fit: Fitted) -> tuple[dict[str, float], Reals]:
        """Of the model by name, in their units, and their covariance, in the same order; see `parameters_of`."""
        structure, searched = fit.structure, fit.structure.searched
        at = np.concatenate((fit.theta[:searched], fit.linear.coefficients[: structure.inputs]))
        values = parameters_of(self.model(fit))

        def moved(at: Reals) -> Reals:
            return np.array(list(parameters_of(self._model(structure, at[:searched], at[searched:])).values()))

        # a dead time is not less than 0, but it has a slope there
        at[structure.lags] = max(at[structure.lags], 2.0 * LOG_STEP)
        slopes = slopes_of(moved, at, searched)
        kept = np.concatenate((np.arange(searched), len(fit.theta) + np.arange(structure.inputs)))
        return values, slopes @ self.covariance(fit)[np.ix_(kept, kept)] @ slopes.T

    def load_disturbances(self, fit: Fitted) -> list[tuple[Reals, Reals]]:
        """Of each step of the load: (when PV answers, when it enters at MV's side, size), errors of the same.

        Times in s since the first sample, size in MV units.
        """
        structure, lags = fit.structure, fit.structure.lags
        first = len(fit.theta)
        found = []
        for i in range(fit.hypothesis.load_disturbances):
            of_load = first + structure.inputs + 1 + fit.hypothesis.drift + i * structure.order

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
        """Of theta and the linear coefficients, in this order, linearised; the residual's colour is allowed for."""
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
    """The model's parameters by name, without a lag that it does not have.

    Of a transfer function the coefficients as num[0], den[0] and so on, highest power first, and dead_time_s; not what
    is 0 or 1 in any case.
    """
    if isinstance(model, TransferFunction):
        num = {f"num[{i}]": value for i, value in enumerate(model.num)}
        den = {f"den[{i}]": value for i, value in enumerate(model.den) if i < len(np.trim_zeros(model.den, "b")) - 1}
        return num | den | {"dead_time_s": model.L}
    values = {field.name: float(getattr(model, field.name)) for field in fields(model)}
    return {name: value for name, value in values.items() if not (name == "T" and value == 0.0)}
