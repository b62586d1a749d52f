"""A process model from a recorded test of any shape: open-loop steps, a relay, a set-point change in closed loop.

Output error: the whole record is simulated from MV with the exact zero-order hold and dead time and compared with PV,
so the noise should be PV's own and white. Each structure is fitted by separable least squares; the data choose
among them by the Bayesian information criterion (Schwarz, 1978),

    BIC = N*ln(RSS/N + (2e-4)^2) + k*ln(N)          RSS in units of the span of PV, squared; k parameters

whose floor keeps data without noise from asking for ever higher order. Where no structure explains the record from
rest, all are tried again on a plant that was not at rest (or under a load) when the record began.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from tuning.models import Integrating, Reals
from tuning.reasons import Reason, Refused
from tuning.recorded import Recorded, recorded
from tuning.starts import starts
from tuning.structures import FIRST, INTEGRATOR, LAGGED_INTEGRATOR, SECOND, SECOND_WITH_ZERO, Plant, Structure
from tuning.varpro import Linear, covariance, jacobian, search, solve

STRUCTURES = (INTEGRATOR, FIRST, LAGGED_INTEGRATOR, SECOND)
FLOOR = 2e-4
# rms of a residual, as a part of PV's span, of which it does not matter what it consists of
UNIMPORTANT = 1.5e-3
# differences of BIC: of a structure worth naming beside the best; by which PV must be better explained with MV than
# without
RIVAL = 4.0
VISIBLE = 10.0
# a start not at rest must leave less than this of the residual's rms: it can hide a little of a wrong structure
DISTURBED = 0.8
WHITE_ABOVE = 1e-3
POORLY_KNOWN = 0.25
LONGEST_LAG = 30.0  # in records
SHORTEST_LAG = 0.1  # in samples


@dataclass(frozen=True, slots=True)
class Candidate:
    """One structure as fitted.  parameters: how many were.  rms: of the residual, PV units.  at_rest: at the start."""

    structure: str
    bic: float
    parameters: int
    rms: float
    at_rest: bool


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The model that the record supports best, and how far to trust it.

    fit_pct: 100*(1 - |y - fitted|/|y - mean y|) (NRMSE fit).  r2_pct: 100*(1 - the square of that ratio).
    noise_std: of what the model leaves unexplained, PV units.  standard_errors: of the model's parameters by their
    names, in their units.  whiteness: Ljung-Box p-value of the residual, below 0.001 not white noise.  explained: the
    residual is white, or too small to matter (0.15 % of PV's span).  fitted: PV as modelled, PV units, shape (N,).
    candidates: all structures tried, best first.  notes: what the user should know, one sentence each.
    """

    model: Plant
    fit_pct: float
    r2_pct: float
    noise_std: float
    standard_errors: dict[str, float]
    whiteness: float
    explained: bool
    fitted: Reals
    candidates: tuple[Candidate, ...]
    notes: tuple[str, ...]


def identify(t: ArrayLike, u: ArrayLike, y: ArrayLike, u_before: float | None = None) -> Identified:
    """FOPDT, SOPDT (real or complex poles) or integrating model from a record.

    t: s, evenly spaced.  u: MV that holds from its sample to the next.  y: PV at the sample.  u_before: the MV that
    held before the record, by default u[0]; give it when the record begins with the move.
    Raises Refused(BAD_INPUT) for a record that cannot be used and Refused(NO_RESPONSE) where PV does not answer MV
    visibly. The plant must be stable or integrate once.
    """
    record = recorded(t, u, y, u_before)
    problem = _Problem(record)
    fits = [problem.fit(structure, None) for structure in STRUCTURES]
    best = min(fits, key=_bic)
    if not best.explains:
        # a plant with a zero is only looked for as the reason why no model fits
        other = problem.fit(SECOND_WITH_ZERO, None)
        fits.append(other)
        if not other.explains:
            moving = [problem.fit(structure, 0) for structure in STRUCTURES]
            fits += moving
            of_moving = min(moving, key=_bic)
            if of_moving.bic < best.bic and of_moving.rms < DISTURBED * best.rms:
                best = of_moving
    problem.require_visible(best)
    return _result(problem, best, sorted(fits, key=_bic))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    structure: Structure
    load_from: int | None
    theta: Reals
    columns: Reals
    linear: Linear
    bic: float
    parameters: int

    @property
    def rms(self) -> float:
        """Of the residual, in spans of PV."""
        return math.sqrt(self.linear.rss / len(self.linear.residual))

    @property
    def explains(self) -> bool:
        return self.rms <= UNIMPORTANT or _whiteness(self.linear.residual, self.structure.searched) >= WHITE_ABOVE


class _Problem:
    """The record in units of its own: time in samples, MV and PV in their largest change."""

    def __init__(self, record: Recorded) -> None:
        self.record = record
        change = record.u - record.u_before
        self.mv_unit = float(np.max(np.abs(change)))
        self.pv_unit = float(np.ptp(record.y))
        self.u = change / self.mv_unit
        self.y = (record.y - record.y[0]) / self.pv_unit
        self.samples = len(self.y)
        # a response that begins later than this is not to be told from its beginning
        self.most_dead_time = max(1, int(0.7 * (self.samples - record.first_move)))

    def fit(self, structure: Structure, load_from: int | None) -> _Fit:
        """The best of a few searches from the most promising starts."""
        low, high = self._bounds(structure)
        reach = np.append(np.full(structure.lags, 1.5), max(5.0, 0.2 * self.most_dead_time))
        step = np.append(np.full(structure.lags, 1e-5), 1e-4)

        def residual(theta: Reals) -> Reals:
            return solve(structure.regressors(theta, self.u, load_from), self.y).residual

        tries = starts(structure, self.u, self.y, self.most_dead_time, load_from is not None, keep=3)
        theta = min((search(residual, start, low, high, reach, step) for start in tries), key=lambda found: found[1])[0]
        columns = structure.regressors(theta, self.u, load_from)
        linear = solve(columns, self.y)
        # where a load enters is searched for too, unless it is the start
        parameters = structure.searched + columns.shape[1]
        return _Fit(structure, load_from, theta, columns, linear, self._bic(linear.rss, parameters), parameters)

    def require_visible(self, fit: _Fit) -> None:
        """Refused unless the record is much less well explained without its input."""
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

    def errors(self, fit: _Fit) -> dict[str, float]:
        """Standard errors of the model's parameters, the residual's colour allowed for."""
        structure, theta = fit.structure, fit.theta
        c = fit.linear.coefficients

        def output(at: Reals) -> Reals:
            return structure.regressors(at, self.u, fit.load_from) @ c

        # half a sample for the dead time: a response has a corner there, not a derivative
        low, high = self._bounds(structure)
        step = np.append(np.full(structure.lags, 1e-5), 0.5)
        below, above = np.maximum(theta - step, low), np.minimum(theta + step, high)
        slopes = []
        for i in range(len(theta)):
            a, b = theta.copy(), theta.copy()
            a[i], b[i] = below[i], above[i]
            slopes.append((output(b) - output(a)) / (b[i] - a[i]))
        variance = fit.linear.rss / max(self.samples - fit.parameters, 1) * _colour(fit.linear.residual)
        cov = covariance(np.column_stack((*slopes, fit.columns)), variance)
        kept = len(theta) + 1
        p = np.append(theta, c[0])

        def parameters(at: Reals) -> Reals:
            return _values(self.plant_of(structure, at[:-1], float(at[-1])))

        scale = np.append(np.full(len(theta), 1e-6), 1e-6 * max(abs(float(c[0])), 1e-300))
        turned = jacobian(parameters, p, parameters(p), np.full(kept, np.inf), scale)
        spread = np.sqrt(np.maximum(np.diag(turned @ cov[:kept, :kept] @ turned.T), 0.0))
        model = self.plant_of(structure, theta, float(c[0]))
        return {name: float(value) for name, value in zip(_names(model), spread, strict=True)}

    def plant_of(self, structure: Structure, theta: Reals, b0: float) -> Plant:
        return structure.plant(theta, b0 * self.pv_unit / self.mv_unit, self.record.Ts)

    def _bounds(self, structure: Structure) -> tuple[Reals, Reals]:
        slow, fast = math.log(1.0 / (LONGEST_LAG * self.samples)), math.log(1.0 / SHORTEST_LAG)
        low, high = np.full(structure.lags, slow), np.full(structure.lags, fast)
        if structure.lags == 2:
            # of the product of two rates
            low[1], high[1] = 2.0 * slow, 2.0 * fast
        return np.append(low, 0.0), np.append(high, float(self.most_dead_time))

    def _bic(self, rss: float, parameters: int) -> float:
        return self.samples * math.log(rss / self.samples + FLOOR**2) + parameters * math.log(self.samples)


def _bic(fit: _Fit) -> float:
    return fit.bic


def _result(problem: _Problem, best: _Fit, ranked: Sequence[_Fit]) -> Identified:
    record, unit = problem.record, problem.pv_unit
    model = problem.plant_of(best.structure, best.theta, float(best.linear.coefficients[0]))
    errors = problem.errors(best)
    residual = unit * best.linear.residual
    ratio = float(np.linalg.norm(residual) / np.linalg.norm(record.y - record.y.mean()))
    whiteness = _whiteness(best.linear.residual, best.structure.searched)
    return Identified(
        model=model,
        fit_pct=100.0 * (1.0 - ratio),
        r2_pct=100.0 * (1.0 - ratio**2),
        noise_std=math.sqrt(float(residual @ residual) / max(problem.samples - best.parameters, 1)),
        standard_errors=errors,
        whiteness=whiteness,
        explained=best.explains,
        fitted=record.y - residual,
        candidates=tuple(
            Candidate(fit.structure.name, fit.bic, fit.parameters, unit * fit.rms, fit.load_from is None)
            for fit in ranked
        ),
        notes=tuple(_notes(problem, best, ranked, model, errors)),
    )


def _notes(problem: _Problem, best: _Fit, ranked: Sequence[_Fit], model: Plant, errors: dict[str, float]) -> list[str]:
    notes = []
    if best.load_from is not None:
        notes.append("The plant was not at rest, or under a load, at the start of the record; this was allowed for.")
    if not best.explains:
        notes.append(
            f"The residual is not white noise ({100.0 * best.rms:.2g} % of PV's span): the plant has another "
            "structure, or something else moved PV."
        )
    top = ranked[0]
    if top.structure.zeros and top.bic < best.bic - RIVAL:
        b1, b0 = top.linear.coefficients[1], top.linear.coefficients[0]
        kind = "an inverse response" if b0 * b1 < 0.0 else "a zero"
        notes.append(f"A second-order model with {kind} explains the record better: the model is an approximation.")
    rivals = {fit.structure.name for fit in ranked if fit.bic < best.bic + RIVAL and not fit.structure.zeros}
    rivals.discard(best.structure.name)
    if rivals:
        notes.append(f"The record supports nearly as well: {', '.join(sorted(rivals))}.")
    for (name, error), value in zip(errors.items(), _values(model), strict=True):
        if error > POORLY_KNOWN * abs(value) and not (name == "L" and error < 0.5 * problem.record.Ts):
            notes.append(f"{name} is poorly known: {value:.3g} with a standard error of {error:.2g}.")
    slowest = model.T * (max(1.0, 2.0 * model.zeta) if hasattr(model, "zeta") else 1.0)
    if not isinstance(model, Integrating) and slowest > problem.record.Ts * problem.samples:
        notes.append("The plant is slower than the record is long: only K/T is known, not K and T by themselves.")
    return notes


def _names(model: Plant) -> list[str]:
    return [field.name for field in fields(model) if not (field.name == "T" and model.T == 0.0)]


def _values(model: Plant) -> Reals:
    return np.array([getattr(model, name) for name in _names(model)])


def _whiteness(residual: Reals, searched: int) -> float:
    """p-value of the Ljung-Box test (1978) on the residual's autocorrelation."""
    n = len(residual)
    lags = max(searched + 3, min(20, n // 5))
    r = residual - residual.mean()
    power = float(r @ r)
    if power == 0.0:
        return 1.0
    correlations = np.array([float(r[k:] @ r[:-k]) for k in range(1, lags + 1)]) / power
    q = n * (n + 2.0) * float(np.sum(correlations**2 / (n - np.arange(1.0, lags + 1.0))))
    return float(chi2.sf(q, lags - searched))


def _colour(residual: Reals) -> float:
    """How many times more the residual's slow part weighs than that of white noise of its differences; at least 1."""
    fast = 0.5 * float(np.mean(np.diff(residual) ** 2))
    return max(1.0, float(np.mean(residual**2)) / fast) if fast > 0.0 else 1.0
