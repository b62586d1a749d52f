"""What a fast experiment hands on: record, model with its errors, the step under the new gains, the proposal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopwright.tuning.analysis.comparison import (
    Comparison,
    Predicted,
    RobustnessBounds,
    compare,
    loop_performance,
    predicted,
    weighted_IAE,
)
from loopwright.tuning.analysis.margins import Ultimate, margins, ultimate_point
from loopwright.tuning.experiments.primitives import Facts
from loopwright.tuning.experiments.step_test import StepResult
from loopwright.tuning.fast.design import DesignSpec, OptimalGains
from loopwright.tuning.fast.evaluation import Evaluation
from loopwright.tuning.fast.record import ExperimentRecord
from loopwright.tuning.fast.uncertainty import fit_covariance
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.identification.sensitivity import slopes_of
from loopwright.tuning.models import Model, Reals, TransferFunction
from loopwright.tuning.reasons import Ended, Reason, Refused

CRITERION = "half of the set-point's and half of the load's IAE, each over the least under the bounds asked for"


@dataclass(frozen=True, slots=True)
class LoadDisturbance:
    """A step of the load that the record shows. t_s: since the relay's start.  size: MV units at the plant's input."""

    t_s: float
    size: float


@dataclass(frozen=True, slots=True)
class RelayFigures:
    """The relay's record. period_s: as it swung.  span: of PV.  noise: of PV at rest, standard deviation.

    amplitude: of the relay's higher side, MV units.  samples: from the first at rest to the last.
    """

    switches: int
    period_s: float
    span: float
    noise: float
    amplitude: float
    samples: int


@dataclass(frozen=True, slots=True)
class IdentifiedModel:
    """num, den (highest power of s first, den begins with 1) and the dead time, each with its standard error."""

    structure: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    dead_time_s: float
    num_errors: tuple[float, ...] | None = None
    den_errors: tuple[float, ...] | None = None
    dead_time_error_s: float | None = None


@dataclass(frozen=True, slots=True)
class EvaluationSummary:
    """What one evaluation of the record came to.

    num, den (highest power first), L_s: the plant.  cause: why it is not enough, None if it is.  uncertainty,
    ambiguity: of Ms.  residual: in noises at rest.
    """

    structure: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    L_s: float
    gains: Gains
    Ms: float
    uncertainty: float
    ambiguity: float
    residual: float
    loads: tuple[LoadDisturbance, ...]
    drift: bool
    switches: int
    period_s: float
    reason: Reason | None
    detail: str


@dataclass(frozen=True, slots=True)
class VerifiedStep:
    """The set-point step under the gains of the first design, as measured; it begins while PV still swings.

    tested: those gains.  Ms: theirs on the model of the whole record.  fit_pct: how much of the step that model
    explains, NRMSE.  rms: what it leaves, PV units.
    """

    tested: Gains
    Ms: float
    step: float
    duration_s: float
    fit_pct: float
    rms: float


@dataclass(frozen=True, slots=True)
class FastProposal:
    """What the operator decides on. Gains in ISA form, MV per PV unit and seconds.

    comparison: old and new gains on the model, half a sample later for the sampling. Where it shows no gain the present
    gains are kept, unless a proposal was asked for all the same: then there is nothing to decide on, and nothing was
    verified.  predicted, predicted_before: some figures of it by themselves, predicted_before None where the old gains
    would not be stable.  found: None without a record.  verified: of a step after the relay; verification: of one from
    rest.
    """

    method: str
    chosen: Mapping[str, float]
    model: IdentifiedModel
    old_gains: Gains
    gains: Gains
    predicted: Predicted
    predicted_before: Predicted | None
    comparison: Comparison
    ultimate: Ultimate | None
    found: EvaluationSummary | None
    verified: VerifiedStep | None
    verification: StepResult | None
    notes: tuple[str, ...]


def evaluation_summary(evaluation: Evaluation) -> EvaluationSummary:
    fit, best = evaluation.fit, evaluation.chosen.best
    record, structure, theta, c = fit.record, best.structure, best.theta, best.linear.coefficients
    order, count = structure.order, best.hypothesis.load_disturbances
    first = len(c) - order * count
    loads = tuple(
        LoadDisturbance(
            (float(theta[structure.searched + i] - theta[structure.lags]) - record.listened) * record.Ts,
            float(c[first + i * order] / c[0]) * record.input_range,
        )
        for i in range(count)
    )
    return EvaluationSummary(
        structure=structure.name,
        num=evaluation.model.num,
        den=evaluation.model.den,
        L_s=evaluation.model.L,
        gains=evaluation.best.gains,
        Ms=evaluation.Ms,
        uncertainty=evaluation.uncertainty,
        ambiguity=evaluation.ambiguity,
        residual=evaluation.residual,
        loads=loads,
        drift=best.hypothesis.drift,
        switches=len(record.switches),
        period_s=record.period * record.Ts,
        reason=evaluation.reason,
        detail=evaluation.detail,
    )


def identified_model(fit: Fit[ExperimentRecord], found: Fitted) -> IdentifiedModel:
    """With the standard errors that the parameters' covariance gives the coefficients (delta method)."""
    structure = found.structure
    searched, inputs = structure.searched, structure.inputs
    at = np.concatenate((found.theta[:searched], found.linear.coefficients[:inputs]))
    model = fit.transfer(structure, at[:searched], at[searched:])
    width = len(model.num)

    def coefficients(at: Reals) -> Reals:
        moved = fit.transfer(structure, at[:searched], at[searched:])
        # a coefficient that happens to vanish is not left out
        return np.concatenate((np.zeros(width - len(moved.num)), moved.num[-width:], moved.den))

    slopes = slopes_of(coefficients, at, searched)
    whole = fit_covariance(fit, found)
    kept = np.concatenate((np.arange(searched), len(found.theta) + np.arange(inputs)))
    covariance = whole[np.ix_(kept, kept)]
    errors = np.sqrt(np.maximum(np.einsum("ci,ij,cj->c", slopes, covariance, slopes), 0.0))
    return IdentifiedModel(
        structure=structure.name,
        num=model.num,
        den=model.den,
        dead_time_s=model.L,
        num_errors=tuple(map(float, errors[:width])),
        den_errors=tuple(map(float, errors[width:])),
        dead_time_error_s=float(np.sqrt(max(covariance[structure.lags, structure.lags], 0.0))) * fit.record.Ts,
    )


def verified_step(evaluation: Evaluation, tested: Gains, size: float, duration_s: float) -> VerifiedStep:
    """size: of the set-point step under the tested gains, PV units; duration_s: since it was made."""
    fit, residual = evaluation.fit, evaluation.chosen.best.linear.residual
    first = fit.record.relayed // fit.block
    rest, shown = residual[first:], fit.y[first:]
    spread = float(np.linalg.norm(shown - shown.mean()))
    return VerifiedStep(
        tested=tested,
        Ms=margins(delayed(evaluation.model, evaluation.design_delay), tested).Ms,
        step=size,
        duration_s=duration_s,
        fit_pct=100.0 * (1.0 - float(np.linalg.norm(rest)) / spread) if spread > 0.0 else 0.0,
        rms=float(np.sqrt(np.mean(rest**2))) * fit.record.output_range,
    )


def comparison_of(evaluation: Evaluation, facts: Facts, spec: DesignSpec, anyway: bool) -> Comparison:
    """Of the old gains and those designed on the record. Raises as `comparison_on`."""
    return comparison_on(delayed(evaluation.model, evaluation.design_delay), evaluation.best, facts, spec, anyway)


def comparison_on(sampled: Model, best: OptimalGains, facts: Facts, spec: DesignSpec, anyway: bool) -> Comparison:
    """sampled: the model with the delay of the sampling.  anyway: see `compared`. Raises Refused, NOT_ROBUST."""
    before, after = (loop_performance(sampled, gains, facts.sample_time_s) for gains in (facts.old_gains, best.gains))
    if not after.stable:
        raise Refused(Reason.NOT_ROBUST, "the gains designed are not stable on their own model")
    asked = RobustnessBounds(spec.Ms, Mt=spec.Mt, noise_gain=spec.noise_gain)
    J = tuple(weighted_IAE(each, best.minimum.setpoint, best.minimum.load) for each in (before, after))
    return compare(before, after, asked, CRITERION, (J[0], J[1]), anyway)


def proposed(
    facts: Facts,
    spec: DesignSpec,
    evaluation: Evaluation,
    comparison: Comparison,
    verified: VerifiedStep | None,
    relay_at_s: float,
) -> FastProposal:
    """relay_at_s: plant time at which the relay began."""
    found, gains = evaluation_summary(evaluation), evaluation.best.gains
    notes = [
        f"A step of the load of {load.size:+.3g} at the plant's input was found {load.t_s:.4g} s after the start of "
        f"the relay (at {relay_at_s + load.t_s:.4g} s), and allowed for."
        for load in found.loads
    ]
    input_range = evaluation.fit.record.input_range
    if any(abs(load.size) > input_range for load in found.loads):
        notes.append(
            f"Such a load is larger than what the relay moved MV by ({input_range:.3g}): a change of the plant would look so "
            "too. Look at the record before accepting."
        )
    if found.drift:
        notes.append("PV drifted at a steady rate during the test; this was allowed for.")
    return FastProposal(
        method="fast",
        chosen={"Ms": spec.Ms, **({"N": spec.N} if gains.Td else {})},
        model=identified_model(evaluation.fit, evaluation.chosen.best),
        old_gains=facts.old_gains,
        gains=gains,
        predicted=predicted(comparison.after),
        predicted_before=predicted(comparison.before) if comparison.before.stable else None,
        comparison=comparison,
        ultimate=ultimate(evaluation.model),
        found=found,
        verified=verified,
        verification=None,
        notes=tuple(notes),
    )


def delayed(model: Model, delay: float) -> TransferFunction:
    """As a sampled controller meets it."""
    return TransferFunction(model.num, model.den, model.L + delay)


def ultimate(model: Model) -> Ultimate | None:
    try:
        return Ultimate(*ultimate_point(model))
    except Ended:
        return None
