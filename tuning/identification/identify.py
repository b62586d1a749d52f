"""A process model is identified from a recorded test: open-loop steps, a relay, a set-point change in closed loop.

The method is output error: the whole record is simulated from MV with the exact zero-order hold and dead time and
compared with PV, so the noise should be added to PV and white. Each structure is fitted by separable least squares. The
Bayesian information criterion (Schwarz, 1978) chooses among the structures,

    BIC = N*ln(RSS/N + floor^2) + k*ln(N)           RSS in units of the range of PV, squared; k parameters

The floor (2e-4 and the rounding error of PV) prevents overfitting noise-free data. Structures of lags and a dead time
are tried first. If they do not explain the record, the following are tried in this order: a plant with a zero, a
feed-through or a third lag; a plant that was not at rest when the record began; load disturbances at free times, or a
drift. Each of these must lower BIC by at least 15, and a residual that is not white counts as fewer samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from loopwright.tuning.analysis.notebook import as_html
from loopwright.tuning.analysis.pv_faults import pv_faults, without_wrong_samples
from loopwright.tuning.analysis.sticking import find_sticking
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN, by_bic
from loopwright.tuning.identification.feedback_test import follows_from_pv
from loopwright.tuning.identification.output_error import NOT_AT_REST_INITIALLY, UNDISTURBED, Fitted, count
from loopwright.tuning.identification.problem import WHITE_ABOVE, IdentificationProblem
from loopwright.tuning.identification.record import recorded_test
from loopwright.tuning.identification.structure_search import StructureSearch, confounded
from loopwright.tuning.identification.structures import FIRST, INTEGRATOR, LAGGED_INTEGRATOR, SECOND
from loopwright.tuning.models import Integrating, Model, Reals, TransferFunction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STRUCTURES = (INTEGRATOR, FIRST, LAGGED_INTEGRATOR, SECOND)
RIVAL_BIC = 4.0
"""Difference of BIC within which another structure is named beside the best."""
RIVAL_BIC_OF_MANY = 10.0
"""The same difference where many structures and disturbance hypotheses have been tried."""
MAX_RMS_RATIO_NOT_AT_REST = 0.8
"""Largest ratio of the residual's rms with and without a start not at rest for which such a start is accepted: the free
initial state can hide a little of a wrong structure."""
SURELY_WHITE = 0.01
"""p-value of the residual of a model of lags above which no further structure is tried."""
POORLY_KNOWN = 0.25
"""Standard error, as a fraction of the parameter, above which the parameter is called poorly known."""
NEGLIGIBLE_COEFFICIENT = 0.02
"""Standard error of a numerator coefficient, relative to a coefficient that would matter, below which the coefficient
is known well enough."""
AT_THE_START = 2.0
"""Time in samples: a load disturbance that PV answers within this time of the first sample is a start not at rest."""
FEEDBACK = (
    "MV follows from PV alone, as under a controller whose set-point rests: the model may be the controller turned "
    "around. Step the set-point, or move MV by hand."
)
COARSE_RESOLUTION = 0.02
"""Resolution of PV, as a fraction of its range, above which a note warns of a coarse record."""
NOISY = 0.2
"""Noise, as a fraction of the range of PV's response to MV, above which linearised standard errors are too small."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One candidate model: a structure fitted under a disturbance hypothesis.

    structure: the name of the structure.
    bic: its BIC; the lowest is the best.
    parameters: the number of fitted parameters.
    rms: the rms of the residual, PV units.
    at_rest: True if the plant is taken to be at rest at the start of the record.
    chosen: True for the model that is the answer. It need not have the lowest BIC, as a more complex candidate must be
    better by MIN_BIC_GAIN.
    loads: the number of load disturbances of the hypothesis.
    drift: True if the hypothesis has a drift of PV.
    """

    structure: str
    bic: float
    parameters: int
    rms: float
    at_rest: bool
    chosen: bool
    loads: int = 0
    drift: bool = False


@dataclass(frozen=True, slots=True)
class IdentifiedLoadDisturbance:
    """A step-shaped load disturbance that the record shows, with standard errors.

    t_s: the time at which it entered, if at the plant's input, in the time of the record, s: a dead time before seen_s.
    seen_s: the time at which PV began to answer it, in the time of the record, s.
    size: the step at the plant's input that moves PV as far, MV units.
    t_error_s, seen_error_s, size_error: the standard errors of these.
    """

    t_s: float
    seen_s: float
    size: float
    t_error_s: float
    seen_error_s: float
    size_error: float


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The model that the record supports best, and the figures that say how far to trust it.

    model: FOPDT, SOPDT or Integrating, else a transfer function whose den ends in 1 (for an integrating plant in 1, 0).
    fit_pct: the NRMSE fit, 100*(1 - |y - fitted|/|y - mean y|).
    r2_pct: 100*(1 - the square of that ratio).
    noise_std: the standard deviation of the residual, PV units.
    parameters: the parameters of the model by name (K, T, zeta, L; or num[0], den[0], dead_time_s), in their units.
    standard_errors: the standard errors of the parameters by the same names.
    covariance: the covariance of the parameters in the same order, shape (parameters, parameters).
    loads: the load disturbances that the record shows.
    drift: True if PV drifted at a steady rate, which the fit allows for. The drift of an integrating plant is a load
    disturbance at its input; a note says so instead.
    whiteness: the Ljung-Box p-value of the residual; below 0.001 the residual is not white noise.
    explained: True if the residual is white or negligible (0.15 % of the range of PV, or the rounding error of PV).
    t, u, y: the record: times, s, MV, MV units, and PV, PV units, all of shape (N,).
    fitted: PV as modelled, PV units, shape (N,).
    candidates: all candidate models, the lowest BIC first.
    notes: what the user should know, one sentence each.
    """

    model: Model
    fit_pct: float
    r2_pct: float
    noise_std: float
    parameters: dict[str, float]
    standard_errors: dict[str, float]
    covariance: Reals
    loads: tuple[IdentifiedLoadDisturbance, ...]
    drift: bool
    whiteness: float
    explained: bool
    t: Reals
    u: Reals
    y: Reals
    fitted: Reals
    candidates: tuple[Candidate, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        known = ", ".join(f"{n} {v:.4g} ± {self.standard_errors[n]:.2g}" for n, v in self.parameters.items())
        return f"{known}; fit {self.fit_pct:.1f} %"

    def plot(self) -> Figure:
        """The picture of PV as recorded and as modelled, of the residual and of MV; needs matplotlib."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 5.5), layout="constrained")
        pv, rest, mv = figure.subplots(3, 1, sharex=True, height_ratios=(3, 1, 1.3))
        pv.plot(self.t, self.y, ".", color="0.5", markersize=3, label="PV recorded")
        pv.plot(self.t, self.fitted, label="model")
        pv.legend()
        rest.plot(self.t, self.y - self.fitted, ".", color="0.5", markersize=3)
        mv.step(self.t, self.u, where="post")
        for axes, name in ((pv, "PV"), (rest, "residual"), (mv, "MV")):
            axes.set_ylabel(name)
        mv.set_xlabel("time, s")
        figure.suptitle(str(self))
        return figure

    def _repr_html_(self) -> str:
        """What a notebook shows: the parameters with their standard errors, the notes, and the picture."""
        rows = [(name, f"{value:.4g}", f"{self.standard_errors[name]:.2g}") for name, value in self.parameters.items()]
        explained = "The model explains the record." if self.explained else "The model does not explain the record."
        title = f"Fit {self.fit_pct:.2f} %"
        return as_html(title, [("", "value", "standard error"), *rows], (explained, *self.notes), self.plot)


def identify(
    t: ArrayLike, u: ArrayLike, y: ArrayLike, u_before: float | None = None, lags_only: bool = False
) -> Identified:
    """Identifies the model of a record: at most two lags where they explain it, else more; see the head of this file.

    t: the times of the samples, s, evenly spaced.
    u: MV, held from its sample to the next, MV units. (A log that shows the previous MV with each sample makes the dead
    time one sample too short.)
    y: PV at the sample, PV units.
    u_before: MV before the record, by default u[0]; it is needed when the record begins with the move of MV.
    lags_only: the answer is FOPDT, SOPDT or Integrating in any case; a structure that explains the record better is
    only named in the notes.
    Raises Refused: BAD_INPUT for a record that cannot be used, NO_RESPONSE where PV does not visibly answer MV,
    NOISE_TOO_HIGH where the noise is more than half of the answer. The plant must be stable or integrate once.
    """
    record = recorded_test(t, u, y, u_before)
    wrong = pv_faults(record.y).of_wrong_samples
    record = replace(record, y=without_wrong_samples(record.y))
    problem = IdentificationProblem(record)
    best, tried = _chosen(problem, lags_only)
    problem.require_visible_response(best)
    # only the best fit of each structure and disturbance hypothesis becomes a candidate
    ranked = {(fit.structure, fit.hypothesis): fit for fit in sorted([*tried, best], key=by_bic, reverse=True)}
    ranked[best.structure, best.hypothesis] = best
    found = _result(problem, best, sorted(ranked.values(), key=by_bic), float(np.asarray(t, dtype=float)[0]))
    if wrong is not None:
        found = replace(found, notes=(f"{wrong}: they were left out.", *found.notes))
    if not lags_only and follows_from_pv(record.u, record.y):
        found = replace(found, explained=False, notes=(FEEDBACK, *found.notes))
    if not found.explained and (sticking := find_sticking(record.Ts, record.u, record.y)) is not None:
        found = replace(found, notes=(f"As if it had been in automatic, {sticking.in_words}.", *found.notes))
    return found


def _chosen(problem: IdentificationProblem, lags_only: bool) -> tuple[Fitted, list[Fitted]]:
    """The fit that is the answer, and all fits that were tried."""
    tried = [problem.fit(structure, UNDISTURBED) for structure in STRUCTURES]
    lags = best = min(tried, key=by_bic)
    if problem.explains(best, WHITE_ABOVE if lags_only else SURELY_WHITE):
        return best, tried
    search = StructureSearch(problem, list(tried))
    undisturbed = [each for each in search.undisturbed() if not each.structure.lags_only]
    tried += undisturbed
    richer = min((lags, *undisturbed), key=by_bic)
    if not (problem.explains(best) or problem.explains(richer)):
        not_at_rest = [problem.fit(structure, NOT_AT_REST_INITIALLY) for structure in STRUCTURES]
        tried += not_at_rest
        best_not_at_rest = min(not_at_rest, key=by_bic)
        if (
            best_not_at_rest.bic < min(best.bic, richer.bic)
            and best_not_at_rest.rms < MAX_RMS_RATIO_NOT_AT_REST * best.rms
        ):
            best = best_not_at_rest
    if lags_only:
        return best, tried
    if best is lags and richer is not lags and problem.bic_gain(richer, best) > MIN_BIC_GAIN:
        best = richer
    # where a structure with more than lags explains the record, only lags with one load disturbance can be simpler
    explained = best is richer and problem.explains(best, SURELY_WHITE)
    for disturbed in search.disturbed(lags_and_one_load=explained) if problem.residual_matters(best) else ():
        tried += disturbed
        likeliest = min((best, *disturbed), key=by_bic)
        # a candidate with fewer parameters than the best needs only a lower BIC, if lags alone are not enough
        needed = 0.0 if best is not lags and count(likeliest) <= count(best) else MIN_BIC_GAIN
        if likeliest is not best and problem.bic_gain(likeliest, best) > needed:
            best = likeliest
    if best is not lags and not best.hypothesis.not_at_rest_initially:
        best = _polished(problem, best, tried)
    return best, tried


def _polished(problem: IdentificationProblem, fit: Fitted, tried: list[Fitted]) -> Fitted:
    """The fit refined on every sample, which replaces it in `tried`.

    The fit stays as it is where the refined one is no better or confounds the plant with a load disturbance.
    """
    further = problem.refined(fit.structure, fit.hypothesis, [fit.theta])
    if further.bic >= fit.bic or confounded(problem, further):
        return fit
    tried[tried.index(fit)] = further
    return further


def _result(problem: IdentificationProblem, best: Fitted, ranked: Sequence[Fitted], t0: float) -> Identified:
    record, unit = problem.record, problem.pv_unit
    parameters, covariance = problem.parameters(best)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    residual = unit * best.linear.residual
    ratio = float(np.linalg.norm(residual) / np.linalg.norm(record.y - record.y.mean()))
    of_loads = [each for each in problem.load_disturbances(best) if not _at_the_start(problem, each[0])]
    # a steady load at the input of an integrating plant makes PV drift
    under_load = best.hypothesis.drift and best.structure.integrating
    found = Identified(
        model=problem.model(best),
        fit_pct=100.0 * (1.0 - ratio),
        r2_pct=100.0 * (1.0 - ratio**2),
        noise_std=math.sqrt(float(residual @ residual) / max(problem.samples - best.parameters, 1)),
        parameters=parameters,
        standard_errors=dict(zip(parameters, map(float, errors), strict=True)),
        covariance=covariance,
        loads=tuple(
            IdentifiedLoadDisturbance(
                t0 + float(at[1]), t0 + float(at[0]), float(at[2]), float(off[1]), float(off[0]), float(off[2])
            )
            for at, off in of_loads
        ),
        drift=best.hypothesis.drift and not under_load,
        whiteness=problem.whiteness(best),
        explained=problem.explains(best),
        t=np.asarray(t0 + record.Ts * np.arange(len(record.y)), dtype=np.float64),
        u=record.u,
        y=record.y,
        fitted=record.y - residual,
        candidates=tuple(
            Candidate(
                fit.structure.name, fit.bic, fit.parameters, unit * fit.rms, not fit.hypothesis.not_at_rest_initially,
                fit is best, fit.hypothesis.load_disturbances, fit.hypothesis.drift,
            )
            for fit in ranked
        ),
        notes=(),
    )  # fmt: skip
    initially = best.hypothesis.not_at_rest_initially or under_load
    at_rest = not initially and len(of_loads) == best.hypothesis.load_disturbances
    return replace(found, notes=tuple(_notes(problem, best, ranked, found, at_rest)))


def _at_the_start(problem: IdentificationProblem, load: Reals) -> bool:
    """Whether a load disturbance is really a plant that was not at rest when the record began."""
    return bool(load[0] <= AT_THE_START * problem.record.Ts)


def _notes(
    problem: IdentificationProblem, best: Fitted, ranked: Sequence[Fitted], found: Identified, at_rest: bool
) -> list[str]:
    notes = []
    if not at_rest:
        notes.append("The plant was not at rest, or under a load, at the start of the record; this was allowed for.")
    notes += _disturbance_notes(problem, found)
    if problem.resolution > COARSE_RESOLUTION:
        coarse = 100.0 * problem.resolution
        notes.append(f"PV is recorded in steps of {coarse:.2g} % of its range, which limits the result.")
    if not found.explained:
        renewal = pv_faults(problem.record.y).of_renewal(problem.record.Ts)
        notes.append(
            f"{renewal}: the sensor, not the plant."
            if renewal is not None
            else f"The residual is not white noise ({100.0 * best.rms:.2g} % of PV's range): the plant has another "
            "structure, or something else moved PV."
        )
    top = ranked[0]
    if not top.structure.lags_only and top.bic < best.bic - RIVAL_BIC:
        notes.append(
            f"A {_in_words(problem, top)} explains the record better: the model is an approximation."
            if best.structure.lags_only
            else f"A {_in_words(problem, top)} has a lower BIC, though not by the {MIN_BIC_GAIN:g} that are asked for."
        )
    near = best.bic + (
        RIVAL_BIC
        if best.structure.lags_only and best.hypothesis in (UNDISTURBED, NOT_AT_REST_INITIALLY)
        else RIVAL_BIC_OF_MANY
    )
    rivals = {
        _named(fit) for fit in ranked if fit.bic < near and (fit.structure.lags_only or near > best.bic + RIVAL_BIC)
    }
    rivals.discard(_named(best))
    if rivals:
        notes.append(f"The record supports nearly as well: {', '.join(sorted(rivals))}.")
    noise = problem.noise(best)
    if noise > NOISY:
        notes.append(f"The noise is {100.0 * noise:.2g} % of PV's response to MV: the errors given may be too small.")
    poor = _poorly_known(problem, found)
    if poor:
        shown = [f"{name} ({found.parameters[name]:.3g} +- {found.standard_errors[name]:.2g})" for name in poor]
        notes.append(f"Poorly known, with standard errors: {', '.join(shown)}.")
    if "K" in poor and "T" in poor and not isinstance(found.model, Integrating):
        notes.append("The record is too short for so slow a plant: K/T is known, not K and T by themselves.")
    return notes


def _poorly_known(problem: IdentificationProblem, found: Identified) -> list[str]:
    """The names of the parameters that the record determines poorly."""
    poor = []
    for name, value in found.parameters.items():
        error = found.standard_errors[name]
        # a dead time within half a sample of zero is known well enough
        enough = 0.5 * problem.record.Ts if name in ("L", "dead_time_s") else 0.0
        if isinstance(found.model, TransferFunction) and name.startswith("num"):
            # and so is a zero that is certainly far away
            model = found.model
            power = len(model.num) - 1 - int(name[4:-1])
            enough = NEGLIGIBLE_COEFFICIENT * abs(model.num[-1]) * abs(model.den[0]) ** (power / (len(model.den) - 1))
        if error > POORLY_KNOWN * abs(value) and error > enough:
            poor.append(name)
    return poor


def _named(fit: Fitted) -> str:
    """The structure with its disturbance hypothesis, in words."""
    loads = fit.hypothesis.load_disturbances
    disturbed = ("", " with a load disturbance", " with two load disturbances")[loads]
    return fit.structure.name + (" and a drift" if fit.hypothesis.drift else disturbed)


def _in_words(problem: IdentificationProblem, fit: Fitted) -> str:
    """A structure with more than lags, in words."""
    model = problem.model(fit)
    order = "second" if fit.structure.order == 2 else "third" if fit.structure.order == 3 else "first"
    parts = []
    if fit.structure.zeros:
        parts.append("an inverse response" if np.any(np.roots(model.num).real > 0.0) else "a zero")
    if fit.structure.feed_through:
        parts.append("feed-through")
    return f"{order}-order model" + (f" with {' and '.join(parts)}" if parts else "")


def _disturbance_notes(problem: IdentificationProblem, found: Identified) -> list[str]:
    """The notes on the disturbances found, and on when they may really be something else."""
    notes = []
    for load in found.loads:
        notes.append(
            f"A load disturbance of {load.size:+.3g} MV units at the plant's input (standard error "
            f"{load.size_error:.2g}) was found at {load.t_s:.4g} s, which PV answers from {load.seen_s:.4g} s on, and "
            "allowed for."
        )
        if load.size_error > POORLY_KNOWN * abs(load.size):
            notes.append("The size of this load disturbance is poorly known.")
        if abs(load.size) > problem.mv_unit:
            notes.append(
                f"Such a load disturbance is larger than what MV moved by ({problem.mv_unit:.3g}): a change of the "
                "plant would look the same."
            )
    if len(found.loads) > 1:
        notes.append("A plant that is not linear, or a faulty valve, could look like several load disturbances.")
    if found.drift:
        notes.append("PV drifted at a steady rate; this was allowed for.")
    return notes
