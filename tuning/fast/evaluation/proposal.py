"""The results of the fast procedure: figures of the relay, evaluation, model with errors, verified step, proposal."""

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
from loopwright.tuning.fast.design.design import MAX_OVERSHOOT, Aim, DesignSpec, OptimalGains
from loopwright.tuning.fast.design.uncertainty import fit_covariance
from loopwright.tuning.fast.evaluation.controller_effect import note_of
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.robustness import KnownMs, known_Ms
from loopwright.tuning.fast.record import Excitation, ExperimentRecord
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.output_error import Fit, Fitted
from loopwright.tuning.identification.sensitivity import slopes_of
from loopwright.tuning.models import Model, Reals, TransferFunction
from loopwright.tuning.reasons import Ended, Reason, Refused

_HALVES = "half of the set-point's and half of the load's IAE, each over the least under the bounds asked for"
CRITERION = {
    Aim.BALANCED: _HALVES,
    Aim.SETPOINT: _HALVES.replace("half", "nine tenths", 1).replace("half", "a tenth"),
    Aim.LOAD: "the load's IAE over the least under the bounds asked for",
    Aim.NO_OVERSHOOT: f"{_HALVES}, with an overshoot of at most {100.0 * MAX_OVERSHOOT:g} %",
}
"""J of each aim in words, as the comparison of old and new gains shows it."""

NEVER_TRIED = "These gains were never tested on this loop, which stayed in manual. Watch it as it goes to automatic."


@dataclass(frozen=True, slots=True)
class LoadDisturbance:
    """A step-shaped load disturbance that the record shows.

    t_s: the time of the step since the start of the relay or of the pulses, s.
    size: the size of the step at the plant's input, MV units.
    """

    t_s: float
    size: float


@dataclass(frozen=True, slots=True)
class RelayFigures:
    """The figures of a relay test.

    switches: the number of switches of the relay.
    period_s: the period of the oscillation, s.
    span: the range of PV (maximum less minimum) under the relay, PV units.
    noise: the standard deviation of PV at rest, PV units.
    amplitude: the amplitude of the relay's higher side, MV units.
    samples: the number of samples of the record, those at rest included.
    """

    switches: int
    period_s: float
    span: float
    noise: float
    amplitude: float
    samples: int


@dataclass(frozen=True, slots=True)
class PulseFigures:
    """The figures of the pulses of the set-point.

    turns: the number of turns of the set-point.
    size: the size of a pulse, PV units.
    period_s: the time scale of the record, s.
    output_range: the range of PV (maximum less minimum) during the pulses, PV units.
    noise: the standard deviation of PV at rest, PV units.
    samples: the number of samples of the record, those at rest included.
    """

    turns: int
    size: float
    period_s: float
    output_range: float
    noise: float
    samples: int


@dataclass(frozen=True, slots=True)
class IdentifiedModel:
    """A transfer function with the standard errors of its coefficients and of its dead time.

    structure: the name of the model structure.
    num, den: the coefficients, highest power of s first; den begins with 1; PV units per MV unit, times in s.
    dead_time_s: the dead time, s.
    num_errors, den_errors, dead_time_error_s: the standard errors, None for a model that was typed in.
    covariance: the covariance of num, of den without its leading 1 and of the dead time, in this order; None for a
    model that was typed in.
    """

    structure: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    dead_time_s: float
    num_errors: tuple[float, ...] | None = None
    den_errors: tuple[float, ...] | None = None
    dead_time_error_s: float | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True, slots=True)
class EvaluationSummary:
    """The figures of one evaluation of a record.

    structure: the name of the model structure.
    num, den, L_s: the process model; coefficients with the highest power of s first, dead time in s.
    gains: the gains designed on that model.
    Ms: the maximum sensitivity of these gains on the model, the delay of the sampling included.
    uncertainty: how much larger Ms may be with the model two standard deviations off.
    ambiguity: the largest difference of Ms on another model that explains the record as well.
    residual: the rms of the residual divided by the standard deviation of the noise at rest.
    loads: the load disturbances that the record shows.
    drift: True if PV drifted at a steady rate, which the fit allows for.
    switches, period_s: the number of switches of the relay, or of turns of the set-point, and the time scale of the
    record, s.
    reason: the reason why the result is not good enough for a proposal, None if it is.
    detail: the sentence with the numbers behind that reason.
    longest_delay_seen_s: how much later a second path of 30 % of MV's effect may act and still show in the record, s.
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
    longest_delay_seen_s: float


@dataclass(frozen=True, slots=True)
class VerifiedStep:
    """The set-point step under the gains of the first design, as measured. It begins while PV still oscillates.

    tested: the gains of the first design.
    Ms: the maximum sensitivity of the tested gains on the model of the whole record.
    step: the set-point step, PV units.
    duration_s: the time since the step, s.
    fit_pct: the NRMSE fit of that model to the step, percent.
    rms: the rms of the residual of the step, PV units.
    """

    tested: Gains
    Ms: float
    step: float
    duration_s: float
    fit_pct: float
    rms: float


@dataclass(frozen=True, slots=True)
class FastProposal:
    """The proposal that the operator decides on. Gains are in ISA form, MV units per PV unit and s.

    method: the name of the procedure.
    chosen: the design parameters in effect.
    model: the process model that the gains were designed on.
    previous_gains, gains: the present gains and the gains proposed.
    predicted: the main figures of the new gains on the model.
    predicted_previous: the same figures of the previous gains, None where the previous gains are not stable on the
    model.
    comparison: old and new gains on the model, with half a sample of delay added for the sampling. Where the comparison
    shows no gain, the present gains are kept, nothing is verified and there is nothing to decide on, unless a proposal
    was asked for all the same.
    ultimate: the ultimate point of the model, None where the model has none.
    found: the evaluation of the record, None without a record.
    known_previous: Ms of the previous gains with its uncertainty, None without a record.
    verified: the set-point step that followed the relay, None without one.
    verification: the set-point step from rest, None without one.
    notes: what the operator should know, one sentence each.
    model_from: where the model comes from, in words.
    """

    method: str
    chosen: Mapping[str, float]
    model: IdentifiedModel
    previous_gains: Gains
    gains: Gains
    predicted: Predicted
    predicted_previous: Predicted | None
    comparison: Comparison
    ultimate: Ultimate | None
    found: EvaluationSummary | None
    known_previous: KnownMs | None
    verified: VerifiedStep | None
    verification: StepResult | None
    notes: tuple[str, ...]
    model_from: str


def evaluation_summary(evaluation: Evaluation) -> EvaluationSummary:
    """The figures of an evaluation as a job stores and shows them."""
    best, record = evaluation.chosen.best, evaluation.fit.record
    loads = tuple(
        LoadDisturbance((entered - record.begun) * record.Ts, size)
        for _, entered, size in load_disturbances(evaluation.fit, best)
    )
    return EvaluationSummary(
        structure=best.structure.name,
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
        switches=record.turns,
        period_s=record.period * record.Ts,
        reason=evaluation.reason,
        detail=evaluation.detail,
        longest_delay_seen_s=evaluation.longest_delay_seen(),
    )


def load_disturbances(fit: Fit[ExperimentRecord], found: Fitted) -> list[tuple[float, float, float]]:
    """Of each load disturbance: the sample at which PV began to answer it, the sample at which it entered at the
    plant's input, and its size there, MV units."""
    structure, theta, c = found.structure, found.theta, found.linear.coefficients
    first = fit.first_load(structure, found.hypothesis)
    sizes = c[first :: structure.order][: found.hypothesis.load_disturbances] / c[0] * fit.record.input_range
    seen = theta[structure.searched :]
    return [(float(at), float(at - theta[structure.lags]), float(size)) for at, size in zip(seen, sizes, strict=True)]


def identified_model(fit: Fit[ExperimentRecord], found: Fitted) -> IdentifiedModel:
    """The fitted model with the standard errors of its coefficients, from the covariance of the fitted parameters by
    the delta method."""
    structure = found.structure
    searched, inputs = structure.searched, structure.inputs
    at = np.concatenate((found.theta[:searched], found.linear.coefficients[:inputs]))
    model = fit.transfer(structure, at[:searched], at[searched:])
    width = len(model.num)

    def coefficients(at: Reals) -> Reals:
        moved = fit.transfer(structure, at[:searched], at[searched:])
        # a leading coefficient that happens to be zero keeps its place
        padded = np.zeros(width - len(moved.num))
        return np.concatenate((padded, moved.num[-width:], moved.den[1:], (moved.L,)))

    slopes = slopes_of(coefficients, at, searched)
    whole = fit_covariance(fit, found)
    kept = np.concatenate((np.arange(searched), len(found.theta) + np.arange(inputs)))
    slopes[-1] = np.where(np.arange(len(at)) == structure.lags, fit.record.Ts, 0.0)  # theta has it in samples
    covariance = slopes @ whole[np.ix_(kept, kept)] @ slopes.T
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return IdentifiedModel(
        structure=structure.name,
        num=model.num,
        den=model.den,
        dead_time_s=model.L,
        num_errors=tuple(map(float, errors[:width])),
        den_errors=(0.0, *map(float, errors[width:-1])),
        dead_time_error_s=float(errors[-1]),
        covariance=tuple(tuple(map(float, row)) for row in covariance),
    )


def verified_step(evaluation: Evaluation, tested: Gains, size: float, duration_s: float) -> VerifiedStep:
    """The figures of the set-point step of a record.

    tested: the gains under which the step was made.
    size: the set-point step under the tested gains, PV units.
    duration_s: the time since the step, s.
    """
    fit, residual = evaluation.fit, evaluation.chosen.best.linear.residual
    first = fit.rows[-1].start if fit.starts_are_free else fit.record.excited // fit.block
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
    """The comparison of the previous gains with the gains designed on the record. Raises Refused as `comparison_on`."""
    return comparison_on(delayed(evaluation.model, evaluation.design_delay), evaluation.best, facts, spec, anyway)


def comparison_on(sampled: Model, best: OptimalGains, facts: Facts, spec: DesignSpec, anyway: bool) -> Comparison:
    """The comparison of the previous gains with the optimal gains on a model.

    sampled: the model with the delay of the sampling.
    anyway: a proposal is wanted even without a gain, see `compare`.
    Raises Refused, NOT_ROBUST.
    """
    before, after = (
        loop_performance(sampled, gains, facts.sample_time_s) for gains in (facts.previous_gains, best.gains)
    )
    if not after.stable:
        raise Refused(Reason.NOT_ROBUST, "the gains designed are not stable on their own model")
    aim, minimum = spec.aim, best.minimum
    overshoot = None if aim.max_overshoot is None else 100.0 * aim.max_overshoot
    asked = RobustnessBounds(
        spec.Ms, Mt=spec.Mt, noise_gain=spec.noise_gain, overshoot_pct=overshoot, settling_s=spec.settling_s,
        mv_peak=spec.mv_peak,
    )  # fmt: skip
    if spec.settling_s is not None:
        criterion = f"Ms, the smallest that settles within {spec.settling_s:g} s after a set-point step"
        return compare(before, after, asked, criterion, (before.Ms, after.Ms), anyway)
    J = tuple(weighted_IAE(each, minimum.setpoint, minimum.load, aim.share) for each in (before, after))
    return compare(before, after, asked, CRITERION[aim], (J[0], J[1]), anyway, keep_setpoint=aim is not Aim.LOAD)


def chosen_for(spec: DesignSpec, best: OptimalGains) -> dict[str, float]:
    """The design parameters in effect: Ms, which a settling time lowers, N where there is a derivative, and what else
    was asked for."""
    return {"Ms": best.Ms, **({"N": spec.N} if best.gains.Td else {}), **spec.requirements}


def proposed(
    method: str,
    facts: Facts,
    spec: DesignSpec,
    evaluation: Evaluation,
    comparison: Comparison,
    verified: VerifiedStep | None,
    begun_at_s: float,
    known_from: str | None = None,
) -> FastProposal:
    """The proposal of the gains of an evaluation.

    method: the name of the procedure.
    begun_at_s: the plant time at which the relay, the pulses or (observe) the step under the new gains began, s.
    known_from: from what the plant was known before the test, in words.
    """
    found, gains = evaluation_summary(evaluation), evaluation.best.gains
    moved_by = evaluation.fit.record.excitation.in_words
    notes = [
        f"A load disturbance of {load.size:+.3g} at the plant's input was found {load.t_s:.4g} s after the start of "
        f"the {moved_by} (at {begun_at_s + load.t_s:.4g} s), and allowed for."
        for load in found.loads
        if not known_from or load.t_s >= 0.0
    ]
    if evaluation.fit.record.excitation is Excitation.MANUAL:
        notes.insert(0, NEVER_TRIED)
    input_range = evaluation.fit.record.input_range
    if any(abs(load.size) > input_range for load in found.loads):
        notes.append(
            f"Such a load disturbance is larger than what the {moved_by} moved MV by ({input_range:.3g}): a change of "
            "the plant would look the same. Look at the record before accepting."
        )
    if facts.one_sided and evaluation.fit.record.one_sided:
        moved = "PV" if evaluation.fit.record.excitation is Excitation.MANUAL else "The set-point"
        notes.append(
            f"{moved} was moved {facts.directions} only. A gain of the plant that differs above and below where "
            f"the test began cannot be seen in such a record: the gains hold for the side that was tested."
        )
    if (note := note_of(evaluation)) is not None:
        notes.append(note)
    if verified is not None and gains.b > max(1.0, verified.tested.b):
        notes.append(
            f"The step was made with a set-point weight b of {verified.tested.b:.3g}: b {gains.b:.3g} of these gains "
            "was not tried on this loop, and moves MV further at each set-point step."
        )
    if found.drift:
        notes.append("PV drifted at a steady rate during the test; this was allowed for.")
    return FastProposal(
        method=method,
        chosen=chosen_for(spec, evaluation.best),
        model=identified_model(evaluation.fit, evaluation.chosen.best),
        previous_gains=facts.previous_gains,
        gains=gains,
        predicted=predicted(comparison.new),
        predicted_previous=predicted(comparison.previous) if comparison.previous.stable else None,
        comparison=comparison,
        ultimate=ultimate(evaluation.model),
        found=found,
        known_previous=known_Ms(evaluation, facts.previous_gains),
        verified=verified,
        verification=None,
        notes=tuple(notes),
        model_from=_model_from(evaluation.fit.record, known_from),
    )


def _model_from(record: ExperimentRecord, known_from: str | None) -> str:
    """Where the model of a record comes from, in words."""
    if known_from is not None:
        return f"{known_from}{', and the step under the new gains' if record.steps else ''}"
    moved = {
        Excitation.RELAY: "a relay",
        Excitation.MANUAL: "pulses of the manual output",
    }.get(record.excitation, "pulses of the set-point")
    return f"{moved}{', and the set-point step under the new gains' if record.steps else ''}"


def delayed(model: Model, delay: float) -> TransferFunction:
    """The model with a longer dead time, as a sampled controller meets it. delay: the delay of the sampling, s."""
    return TransferFunction(model.num, model.den, model.L + delay)


def ultimate(model: Model) -> Ultimate | None:
    """The ultimate point of the model, None where the model has none."""
    try:
        return Ultimate(*ultimate_point(model))
    except Ended:
        return None
