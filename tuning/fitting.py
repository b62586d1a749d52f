"""One structure fitted to one record: separable least squares from several starts, its BIC, its standard errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from tuning.models import Reals
from tuning.reasons import Reason, Refused
from tuning.recorded import Recorded
from tuning.residual import colour, whiteness
from tuning.starts import starts
from tuning.structures import Plant, Structure
from tuning.varpro import Linear, covariance, jacobian, search, solve

FLOOR = 2e-4
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
LONGEST_LAG = 30.0  # in records
SHORTEST_LAG = 0.1  # in samples


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """theta: as the structure has it.  columns: its regressors there.  linear: their coefficients and the residual.

    All in the units of a Problem. parameters: how many were fitted.  unimportant: rms that needs no explanation.
    """

    structure: Structure
    load_from: int | None
    theta: Reals
    columns: Reals
    linear: Linear
    bic: float
    parameters: int
    unimportant: float

    @property
    def rms(self) -> float:
        """Of the residual, in spans of PV."""
        return math.sqrt(self.linear.rss / len(self.linear.residual))

    @property
    def noise(self) -> float:
        """The residual's rms as a part of the span of PV's response to MV."""
        inputs = self.structure.inputs
        return self.rms / float(np.ptp(self.columns[:, :inputs] @ self.linear.coefficients[:inputs]))

    @property
    def explains(self) -> bool:
        """Nothing of weight is left that is not noise."""
        return self.rms <= self.unimportant or self.whiteness >= WHITE_ABOVE

    @property
    def whiteness(self) -> float:
        """p-value, see `tuning.residual`."""
        return whiteness(self.linear.residual, self.structure.searched)


class Problem:
    """The record in units of its own: time in samples, MV and PV in their largest change."""

    def __init__(self, record: Recorded) -> None:
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
        # a response that begins later than this is not to be told from its beginning
        self.most_dead_time = max(1, int(0.7 * (self.samples - record.first_move)))

    def fit(self, structure: Structure, load_from: int | None) -> Fit:
        """The best of a few searches from the most promising starts."""
        low, high = self._bounds(structure)
        reach = np.append(np.full(structure.lags, 1.5), max(5.0, 0.2 * self.most_dead_time))
        step = np.append(np.full(structure.lags, 1e-5), 1e-4)

        def residual(theta: Reals) -> Reals:
            return solve(structure.regressors(theta, self.u, load_from), self.y).residual

        tries = starts(structure, self.u, self.y, self.most_dead_time, load_from is not None, STARTS)
        theta = min((search(residual, start, low, high, reach, step) for start in tries), key=lambda found: found[1])[0]
        columns = structure.regressors(theta, self.u, load_from)
        linear = solve(columns, self.y)
        parameters = structure.searched + columns.shape[1]
        bic = self._bic(linear.rss, parameters)
        # a quarter more than rounding leaves on average, for it is not quite random
        unimportant = max(UNIMPORTANT, 1.25 * self.rounding)
        return Fit(structure, load_from, theta, columns, linear, bic, parameters, unimportant)

    def require_visible(self, fit: Fit) -> None:
        """Refused unless PV answers MV: more than by chance, and above the noise."""
        inputs = fit.structure.inputs
        without = solve(fit.columns[:, inputs:], self.y)
        parameters = fit.parameters - inputs - fit.structure.searched
        if self._bic(without.rss, parameters) < fit.bic + VISIBLE:
            noise = self.pv_unit * math.sqrt(without.rss / self.samples)
            raise Refused(
                Reason.NO_RESPONSE,
                f"no response of PV to MV is visible: without MV the record is explained to within {noise:.3g} "
                f"PV units, with it to within {self.pv_unit * fit.rms:.3g}; move MV further (it moved by "
                f"{self.mv_unit:.3g}) or record for longer",
            )
        if fit.noise > NOISIEST:
            raise Refused(
                Reason.NOISE_TOO_HIGH,
                f"the noise of PV, {self.pv_unit * fit.rms:.3g} PV units, is {100.0 * fit.noise:.0f} % of its response "
                f"to MV; at most {100.0 * NOISIEST:.0f} % is accepted: move MV further (it moved by "
                f"{self.mv_unit:.3g})",
            )

    def covariance(self, fit: Fit) -> Reals:
        """Of theta and the linear coefficients, in this order, linearised; the residual's colour is allowed for."""
        structure, theta, c = fit.structure, fit.theta, fit.linear.coefficients
        low, high = self._bounds(structure)
        # half a sample for the dead time: a response has a corner there, not a derivative
        step = np.append(np.full(structure.lags, 1e-5), 0.5)
        slopes = []
        for i in range(len(theta)):
            below, above = theta.copy(), theta.copy()
            below[i], above[i] = max(theta[i] - step[i], low[i]), min(theta[i] + step[i], high[i])
            outputs = (structure.regressors(at, self.u, fit.load_from) @ c for at in (above, below))
            slopes.append((next(outputs) - next(outputs)) / (above[i] - below[i]))
        variance = fit.linear.rss / max(self.samples - fit.parameters, 1) * colour(fit.linear.residual)
        return covariance(np.column_stack((*slopes, fit.columns)), variance)

    def errors(self, fit: Fit) -> dict[str, float]:
        """Standard errors of the model's parameters by name, in their units."""
        at = np.append(fit.theta, fit.linear.coefficients[0])
        model = parameters_of(self.model(fit))

        def parameters(at: Reals) -> Reals:
            moved = parameters_of(self._plant(fit.structure, at[:-1], float(at[-1])))
            return np.array([moved[name] for name in model])

        step = 1e-6 * np.append(np.ones(len(fit.theta)), abs(at[-1]))
        slopes = jacobian(parameters, at, parameters(at), np.full(len(at), np.inf), step)
        spread = np.diag(slopes @ self.covariance(fit)[: len(at), : len(at)] @ slopes.T)
        return {name: math.sqrt(max(float(value), 0.0)) for name, value in zip(model, spread, strict=True)}

    def model(self, fit: Fit) -> Plant:
        """In s and the units of the record; without the zeros, if the structure has any."""
        return self._plant(fit.structure, fit.theta, float(fit.linear.coefficients[0]))

    def _plant(self, structure: Structure, theta: Reals, b0: float) -> Plant:
        return structure.plant(theta, b0 * self.pv_unit / self.mv_unit, self.record.Ts)

    def _bounds(self, structure: Structure) -> tuple[Reals, Reals]:
        slow, fast = math.log(1.0 / (LONGEST_LAG * self.samples)), math.log(1.0 / SHORTEST_LAG)
        low, high = np.full(structure.lags, slow), np.full(structure.lags, fast)
        if structure.lags == 2:
            # the product of two rates; a natural period under six samples is an alias
            low[1], high[1] = 2.0 * slow, 0.0
        return np.append(low, 0.0), np.append(high, float(self.most_dead_time))

    def _bic(self, rss: float, parameters: int) -> float:
        floor = FLOOR**2 + self.rounding**2
        return self.samples * math.log(rss / self.samples + floor) + parameters * math.log(self.samples)


def parameters_of(model: Plant) -> dict[str, float]:
    """The model's parameters by name, without a lag that it does not have."""
    values = {field.name: float(getattr(model, field.name)) for field in fields(model)}
    return {name: value for name, value in values.items() if not (name == "T" and value == 0.0)}
