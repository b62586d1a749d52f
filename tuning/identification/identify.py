"""A process model from a recorded test of any shape: open-loop steps, a relay, a set-point change in closed loop.

Output error: the whole record is simulated from MV with the exact zero-order hold and dead time and compared with PV,
so the noise should be PV's own and white. Each structure is fitted by separable least squares; the data choose
among them by the Bayesian information criterion (Schwarz, 1978),

    BIC = N*ln(RSS/N + floor^2) + k*ln(N)           RSS in units of the span of PV, squared; k parameters

whose floor (2e-4, and what rounding PV to its resolution does) keeps data without noise from asking for ever higher
order. Lags and a dead time come first. What they leave unexplained is taken, one after another, for a plant with a
zero, a feed-through or a third lag; for one that was not at rest when the record began; and for steps of the load at
times to be found, or a drift. Each must clearly earn what it takes (15 of BIC), and a residual that is not white counts
as fewer samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN, by_bic
from loopwright.tuning.identification.feedback_test import follows_from_pv
from loopwright.tuning.identification.output_error import NOT_AT_REST_INITIALLY, UNDISTURBED, Fitted, count
from loopwright.tuning.identification.problem import WHITE_ABOVE, IdentificationProblem
from loopwright.tuning.identification.record import recorded_test
from loopwright.tuning.identification.structure_search import StructureSearch, confounded
from loopwright.tuning.identification.structures import FIRST, INTEGRATOR, LAGGED_INTEGRATOR, SECOND
from loopwright.tuning.models import Integrating, Model, Reals, TransferFunction

STRUCTURES = (INTEGRATOR, FIRST, LAGGED_INTEGRATOR, SECOND)
# difference of BIC of a structure worth naming beside the best
RIVAL = 4.0
# and where many structures and stories have been tried
RIVAL_OF_MANY = 10.0
# a start not at rest must leave less than this of the residual's rms: it can hide a little of a wrong structure
DISTURBED = 0.8
# p-value of the residual of lags above which nothing more is looked for
SURELY_WHITE = 0.01
POORLY_KNOWN = 0.25
# of a coefficient of the numerator, against one that would matter
NEXT_TO_NOTHING = 0.02
# a load that PV answers within so many samples of the first is a start not at rest
AT_THE_START = 2.0
FEEDBACK = (
    "MV follows from PV alone, as under a controller whose set-point rests: the model may be the controller turned "
    "around. Step the set-point, or move MV by hand."
)
COARSE = 0.02
# noise, as a part of the response's span, beyond which the errors are not small enough to be linear
NOISY = 0.2


@dataclass(frozen=True, slots=True)
class Candidate:
    """One structure as fitted.  parameters: how many were.  rms: of the residual, PV units.  at_rest: at the start.

    loads, drift: what beside MV is said to have moved PV.  chosen: it is the model; that need not be the one of the
    lowest BIC, which may not have earned its parameters.
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
class Load:
    """A step of the load that the record shows.

    seen_s: when PV began to answer it.  t_s: a dead time earlier, when it entered if it did so at the plant's input.
    Both in the time of the record.  size: MV units at the plant's input that move PV as far.  The others: standard
    errors.
    """

    t_s: float
    seen_s: float
    size: float
    t_error_s: float
    seen_error_s: float
    size_error: float


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """The model that the record supports best, and how far to trust it.

    model: FOPDT, SOPDT or Integrating, else a transfer function whose den ends in 1 (of an integrating plant in 1, 0).
    fit_pct: 100*(1 - |y - fitted|/|y - mean y|) (NRMSE fit).  r2_pct: 100*(1 - the square of that ratio).
    noise_std: of what the model leaves unexplained, PV units.  parameters: of the model by name (K, T, zeta, L; or
    num[0], den[0], dead_time_s), in their units.  standard_errors: theirs, by the same names.  covariance: theirs, in
    the same order, shape (parameters, parameters).  loads, drift: what moved PV beside MV.
    whiteness: Ljung-Box p-value of the residual, below 0.001 not white noise.  explained: the
    residual is white, or too small to matter (0.15 % of PV's span, or what rounding PV to its resolution leaves).
    fitted: PV as modelled, PV units, shape (N,).  candidates: all structures tried, the lowest BIC first.
    notes: what the user should know, one sentence each.
    """

    model: Model
    fit_pct: float
    r2_pct: float
    noise_std: float
    parameters: dict[str, float]
    standard_errors: dict[str, float]
    covariance: Reals
    loads: tuple[Load, ...]
    drift: bool
    whiteness: float
    explained: bool
    fitted: Reals
    candidates: tuple[Candidate, ...]
    notes: tuple[str, ...]


def identify(
    t: ArrayLike, u: ArrayLike, y: ArrayLike, u_before: float | None = None, lags_only: bool = False
) -> Identified:
    """The model from a record: two lags at most where they explain it, else more; see the head of this file.

    t: s, evenly spaced.  u: MV that holds from its sample to the next.  y: PV at the sample.  u_before: the MV that
    held before the record, by default u[0]; give it when the record begins with the move. (A log that shows with each
    sample the MV before it gives a dead time that is one sample too short.)
    lags_only: FOPDT, SOPDT or Integrating in any case; what explains the record better is only named.
    Raises Refused(BAD_INPUT) for a record that cannot be used, Refused(NO_RESPONSE) where PV does not answer MV
    visibly and Refused(NOISE_TOO_HIGH) where the noise is more than half of the answer. The plant
    must be stable or integrate once.
    """
    record = recorded_test(t, u, y, u_before)
    problem = IdentificationProblem(record)
    best, tried = _chosen(problem, lags_only)
    problem.require_visible_response(best)
    # of each structure and story the best alone
    ranked = {(fit.structure, fit.hypothesis): fit for fit in sorted([*tried, best], key=by_bic, reverse=True)}
    ranked[best.structure, best.hypothesis] = best
    found = _result(problem, best, sorted(ranked.values(), key=by_bic), float(np.asarray(t, dtype=float)[0]))
    if not lags_only and follows_from_pv(record.u, record.y):
        found = replace(found, explained=False, notes=(FEEDBACK, *found.notes))
    return found


def _chosen(problem: IdentificationProblem, lags_only: bool) -> tuple[Fitted, list[Fitted]]:
    """The fit to answer with, and all that were tried."""
    tried = [problem.fit(structure, UNDISTURBED) for structure in STRUCTURES]
    lags = best = min(tried, key=by_bic)
    if problem.explains(best, WHITE_ABOVE if lags_only else SURELY_WHITE):
        return best, tried
    search = StructureSearch(problem, list(tried))
    quiet = [each for each in search.quiet() if not each.structure.lags_only]
    tried += quiet
    richer = min((lags, *quiet), key=by_bic)
    if not (problem.explains(best) or problem.explains(richer)):
        moving = [problem.fit(structure, NOT_AT_REST_INITIALLY) for structure in STRUCTURES]
        tried += moving
        of_moving = min(moving, key=by_bic)
        if of_moving.bic < min(best.bic, richer.bic) and of_moving.rms < DISTURBED * best.rms:
            best = of_moving
    if lags_only:
        return best, tried
    if best is lags and richer is not lags and problem.bic_gain(richer, best) > MIN_BIC_GAIN:
        best = richer
    # where more than lags explain the record, only lags and one load can be simpler
    explained = best is richer and problem.explains(best, SURELY_WHITE)
    for told in search.told(simple=explained) if problem.residual_matters(best) else ():
        tried += told
        story = min((best, *told), key=by_bic)
        # one that is told of fewer parameters needs no more than to be likelier, if anything beside lags is needed
        earned = 0.0 if best is not lags and count(story) <= count(best) else MIN_BIC_GAIN
        if story is not best and problem.bic_gain(story, best) > earned:
            best = story
    if best is not lags and not best.hypothesis.not_at_rest_initially:
        best = _polished(problem, best, tried)
    return best, tried


def _polished(problem: IdentificationProblem, fit: Fitted, tried: list[Fitted]) -> Fitted:
    """Searched to the end on every sample, unless another story comes of it; takes its own place in `tried`."""
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
    found = Identified(
        model=problem.model(best),
        fit_pct=100.0 * (1.0 - ratio),
        r2_pct=100.0 * (1.0 - ratio**2),
        noise_std=math.sqrt(float(residual @ residual) / max(problem.samples - best.parameters, 1)),
        parameters=parameters,
        standard_errors=dict(zip(parameters, map(float, errors), strict=True)),
        covariance=covariance,
        loads=tuple(
            Load(t0 + float(at[1]), t0 + float(at[0]), float(at[2]), float(off[1]), float(off[0]), float(off[2]))
            for at, off in of_loads
        ),
        drift=best.hypothesis.drift,
        whiteness=problem.whiteness(best),
        explained=problem.explains(best),
        fitted=record.y - residual,
        candidates=tuple(
            Candidate(
                fit.structure.name, fit.bic, fit.parameters, unit * fit.rms, not fit.hypothesis.not_at_rest_initially, fit is best,
                fit.hypothesis.load_disturbances, fit.hypothesis.drift,
            )
            for fit in ranked
        ),
        notes=(),
    )  # fmt: skip
    at_rest = not best.hypothesis.not_at_rest_initially and len(of_loads) == best.hypothesis.load_disturbances
    return replace(found, notes=tuple(_notes(problem, best, ranked, found, at_rest)))


def _at_the_start(problem: IdentificationProblem, load: Reals) -> bool:
    """What is told as a load is a plant that was not at rest, or under a load, when the record began."""
    return bool(load[0] <= AT_THE_START * problem.record.Ts)


def _notes(
    problem: IdentificationProblem, best: Fitted, ranked: Sequence[Fitted], found: Identified, at_rest: bool
) -> list[str]:
    notes = []
    if not at_rest:
        notes.append("The plant was not at rest, or under a load, at the start of the record; this was allowed for.")
    notes += _disturbance_notes(problem, found)
    if problem.resolution > COARSE:
        coarse = 100.0 * problem.resolution
        notes.append(f"PV is recorded in steps of {coarse:.2g} % of its span, which limits the result.")
    if not found.explained:
        notes.append(
            f"The residual is not white noise ({100.0 * best.rms:.2g} % of PV's span): the plant has another "
            "structure, or something else moved PV."
        )
    top = ranked[0]
    if not top.structure.lags_only and top.bic < best.bic - RIVAL:
        notes.append(
            f"A {_words(problem, top)} explains the record better: the model is an approximation."
            if best.structure.lags_only
            else f"A {_words(problem, top)} has a lower BIC, though not by what it would have to earn."
        )
    near = best.bic + (
        RIVAL if best.structure.lags_only and best.hypothesis in (UNDISTURBED, NOT_AT_REST_INITIALLY) else RIVAL_OF_MANY
    )
    rivals = {_named(fit) for fit in ranked if fit.bic < near and (fit.structure.lags_only or near > best.bic + RIVAL)}
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
    """Names of parameters."""
    poor = []
    for name, value in found.parameters.items():
        error = found.standard_errors[name]
        # a dead time within half a sample of zero is known well enough
        enough = 0.5 * problem.record.Ts if name in ("L", "dead_time_s") else 0.0
        if isinstance(found.model, TransferFunction) and name.startswith("num"):
            # and so is a zero that is certainly far away
            model = found.model
            power = len(model.num) - 1 - int(name[4:-1])
            enough = NEXT_TO_NOTHING * abs(model.num[-1]) * abs(model.den[0]) ** (power / (len(model.den) - 1))
        if error > POORLY_KNOWN * abs(value) and error > enough:
            poor.append(name)
    return poor


def _named(fit: Fitted) -> str:
    """The structure with its story."""
    loads = fit.hypothesis.load_disturbances
    story = ("", " with a step of the load", " with two steps of the load")[loads]
    return fit.structure.name + (" and a drift" if fit.hypothesis.drift else story)


def _words(problem: IdentificationProblem, fit: Fitted) -> str:
    """Of a structure that is more than lags."""
    model = problem.model(fit)
    order = "second" if fit.structure.order == 2 else "third" if fit.structure.order == 3 else "first"
    parts = []
    if fit.structure.zeros:
        parts.append("an inverse response" if np.any(np.roots(model.num).real > 0.0) else "a zero")
    if fit.structure.feed_through:
        parts.append("a part that passes at once")
    return f"{order}-order model" + (f" with {' and '.join(parts)}" if parts else "")


def _disturbance_notes(problem: IdentificationProblem, found: Identified) -> list[str]:
    """What moved PV beside MV, and when not to believe it."""
    notes = []
    for load in found.loads:
        notes.append(
            f"A step of the load of {load.size:+.3g} MV units at the plant's input (standard error "
            f"{load.size_error:.2g}) was found at {load.t_s:.4g} s, which PV answers from {load.seen_s:.4g} s on, and "
            "allowed for."
        )
        if load.size_error > POORLY_KNOWN * abs(load.size):
            notes.append("The size of this load is poorly known.")
        if abs(load.size) > problem.mv_unit:
            notes.append(
                f"Such a load is larger than what MV moved by ({problem.mv_unit:.3g}): a change of the plant would "
                "look so too."
            )
    if len(found.loads) > 1:
        notes.append("A plant that is not linear, or a faulty valve, could be told as several loads.")
    if found.drift:
        notes.append("PV drifted at a steady rate; this was allowed for.")
    return notes
