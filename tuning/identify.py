"""A process model from a recorded test of any shape: open-loop steps, a relay, a set-point change in closed loop.

Output error: the whole record is simulated from MV with the exact zero-order hold and dead time and compared with PV,
so the noise should be PV's own and white. Each structure is fitted by separable least squares; the data choose
among them by the Bayesian information criterion (Schwarz, 1978),

    BIC = N*ln(RSS/N + floor^2) + k*ln(N)           RSS in units of the span of PV, squared; k parameters

whose floor (2e-4, and what rounding PV to its resolution does) keeps data without noise from asking for ever higher
order. Where no structure explains the record from rest, all are tried again on a plant that was not at rest (or under
a load) when the record began.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike

from tuning.fitting import Fit, Problem, parameters_of
from tuning.models import Integrating, Reals
from tuning.recorded import recorded
from tuning.structures import FIRST, INTEGRATOR, LAGGED_INTEGRATOR, SECOND, SECOND_WITH_ZERO, Plant

STRUCTURES = (INTEGRATOR, FIRST, LAGGED_INTEGRATOR, SECOND)
# difference of BIC of a structure worth naming beside the best
RIVAL = 4.0
# a start not at rest must leave less than this of the residual's rms: it can hide a little of a wrong structure
DISTURBED = 0.8
POORLY_KNOWN = 0.25
COARSE = 0.02
# noise, as a part of the response's span, beyond which the errors are not small enough to be linear
NOISY = 0.2


@dataclass(frozen=True, slots=True)
class Candidate:
    """One structure as fitted.  parameters: how many were.  rms: of the residual, PV units.  at_rest: at the start.

    chosen: it is the model. That need not be the one of the lowest BIC, which may have a zero.
    """

    structure: str
    bic: float
    parameters: int
    rms: float
    at_rest: bool
    chosen: bool


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The model that the record supports best, and how far to trust it.

    fit_pct: 100*(1 - |y - fitted|/|y - mean y|) (NRMSE fit).  r2_pct: 100*(1 - the square of that ratio).
    noise_std: of what the model leaves unexplained, PV units.  standard_errors: of the model's parameters by their
    names, in their units.  whiteness: Ljung-Box p-value of the residual, below 0.001 not white noise.  explained: the
    residual is white, or too small to matter (0.15 % of PV's span, or what rounding PV to its resolution leaves).
    fitted: PV as modelled, PV units, shape (N,).  candidates: all structures tried, the lowest BIC first.
    notes: what the user should know, one sentence each.
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
    held before the record, by default u[0]; give it when the record begins with the move. (A log that shows with each
    sample the MV before it gives a dead time that is one sample too short.)
    Raises Refused(BAD_INPUT) for a record that cannot be used, Refused(NO_RESPONSE) where PV does not answer MV
    visibly and Refused(NOISE_TOO_HIGH) where the noise is more than half of the answer. The plant
    must be stable or integrate once.
    """
    record = recorded(t, u, y, u_before)
    problem = Problem(record)
    fits = [problem.fit(structure, None) for structure in STRUCTURES]
    best = min(fits, key=attrgetter("bic"))
    if not best.explains:
        # a plant with a zero is only looked for as the reason why no model fits
        other = problem.fit(SECOND_WITH_ZERO, None)
        fits.append(other)
        if not other.explains:
            moving = [problem.fit(structure, 0) for structure in STRUCTURES]
            fits += moving
            of_moving = min(moving, key=attrgetter("bic"))
            if of_moving.bic < min(best.bic, other.bic) and of_moving.rms < DISTURBED * best.rms:
                best = of_moving
    problem.require_visible(best)
    return _result(problem, best, sorted(fits, key=attrgetter("bic")))


def _result(problem: Problem, best: Fit, ranked: Sequence[Fit]) -> Identified:
    record, unit = problem.record, problem.pv_unit
    model = problem.model(best)
    errors = problem.errors(best)
    residual = unit * best.linear.residual
    ratio = float(np.linalg.norm(residual) / np.linalg.norm(record.y - record.y.mean()))
    return Identified(
        model=model,
        fit_pct=100.0 * (1.0 - ratio),
        r2_pct=100.0 * (1.0 - ratio**2),
        noise_std=math.sqrt(float(residual @ residual) / max(problem.samples - best.parameters, 1)),
        standard_errors=errors,
        whiteness=best.whiteness,
        explained=best.explains,
        fitted=record.y - residual,
        candidates=tuple(
            Candidate(fit.structure.name, fit.bic, fit.parameters, unit * fit.rms, fit.load_from is None, fit is best)
            for fit in ranked
        ),
        notes=tuple(_notes(problem, best, ranked, model, errors)),
    )


def _notes(problem: Problem, best: Fit, ranked: Sequence[Fit], model: Plant, errors: dict[str, float]) -> list[str]:
    notes = []
    if best.load_from is not None:
        notes.append("The plant was not at rest, or under a load, at the start of the record; this was allowed for.")
    if problem.resolution > COARSE:
        coarse = 100.0 * problem.resolution
        notes.append(f"PV is recorded in steps of {coarse:.2g} % of its span, which limits the result.")
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
    if best.noise > NOISY:
        part = 100.0 * best.noise
        notes.append(f"The noise is {part:.2g} % of PV's response to MV: the errors given may be too small.")
    poor = []
    for (name, error), value in zip(errors.items(), parameters_of(model).values(), strict=True):
        # a dead time within half a sample of zero is known well enough
        if error > POORLY_KNOWN * abs(value) and not (name == "L" and error < 0.5 * problem.record.Ts):
            poor.append(name)
            notes.append(f"{name} is poorly known: {value:.3g} with a standard error of {error:.2g}.")
    if "K" in poor and "T" in poor and not isinstance(model, Integrating):
        notes.append("The record is too short for so slow a plant: K/T is known, not K and T by themselves.")
    return notes
