"""The gains of fast from robust to fast: what can be had for each Ms on a job's model. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from pydantic import AliasChoices, Field

from loopwright.service.jobs.alternatives import asked_spec, new_gains, previous_gains
from loopwright.service.jsonable import json_object
from loopwright.service.planning.curves import Horizons, LoopCurves, horizons, loop_curves
from loopwright.service.results import Figures, GainsView, PerformanceView
from loopwright.service.states.loop_state import loop_state
from loopwright.service.store.jobs import Job
from loopwright.tuning.analysis.comparison import beside, loop_performance
from loopwright.tuning.fast.design.design import Aim, DesignSpec, GainDesign
from loopwright.tuning.fast.design.requirements import required
from loopwright.tuning.fast.evaluation.evaluation import MAX_UNCERTAINTY, Evaluation
from loopwright.tuning.fast.evaluation.proposal import delayed
from loopwright.tuning.fast.evaluation.robustness import known_Ms
from loopwright.tuning.fast.known_plant.design_trial import designed_on
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import Model
from loopwright.tuning.reasons import ADVICE, Ended, Reason, Refused

GRID = tuple(round(1.2 + 0.05 * n, 2) for n in range(17))
"""The values of Ms, 1.2 (robust) to 2.0 (fast), for which gains are designed."""


class DesignPoint(Figures):
    """The gains for one Ms, or why there are none."""

    Ms_asked: float = Field(description="Upper bound of Ms for which the gains are designed", examples=[1.6])
    gains: GainsView | None = Field(description="The gains; null: there are none (`reason`)")
    uncertainty: float | None = Field(
        description="How far Ms of these gains may be off on the plant; null: not known, the job has no record",
        examples=[0.03],
    )
    performance: PerformanceView | None = Field(
        validation_alias=AliasChoices("performance", "worth"),  # jobs of 0.1.0's development are stored with the latter
        description="Performance of the gains on the model; null: there are no gains",
    )
    beside: str | None = Field(
        default=None, description="How the gains compare with those before the job, in a sentence; null: not known"
    )
    curves: LoopCurves | None = Field(
        default=None, description="Steps and Nyquist curve of the gains; null: there are no gains"
    )
    reason: Reason | None = Field(description="Why there are no gains; reason code from the closed list")
    detail: str | None = Field(description="The numbers behind the reason")
    advice: str | None = Field(description="What the operator should do about the reason")


class DesignCurve(Figures):
    """The gains that fast designs on one model for Ms from 1.2 (robust) to 2.0 (fast), with what each costs."""

    designed_on: str = Field(
        description="What the gains are designed on, in words", examples=["one fit to the job's record"]
    )
    derivative: bool = Field(description="Whether fast may design a PID, as the job asked")
    aim: Aim = Field(default=Aim.BALANCED, description="What the gains are the best for, as the job asked")
    mv_peak: float | None = Field(
        default=None, description="Largest change of MV after a set-point step, percent per PV unit, as the job asked; "
        "null: no bound. A settling time that the job asked for is no bound here: it is one way to choose an Ms",
    )  # fmt: skip
    noise_gain: float | None = Field(
        default=None, description="Largest noise gain, percent per PV unit, as the job asked; null: no bound"
    )
    setpoint_weight_max: float = Field(
        default=1.0, description="Largest set-point weight b, as the job asked or loops.yaml permitted", examples=[1.0]
    )
    num: list[float] = Field(description="Numerator of the model, highest power of s first, PV units per MV percent")
    den: list[float] = Field(description="Denominator of the model, highest power of s first")
    dead_time_s: float = Field(description="Dead time of the model, s")
    sampling_delay_s: float = Field(
        description="Delay of the sampling, which the figures have beside the dead time, s", examples=[0.05]
    )
    previous: PerformanceView | None = Field(description="Performance of the gains before the job; null: not known")
    new: PerformanceView | None = Field(description="Performance of the gains of the job; null: it has none")
    previous_curves: LoopCurves | None = Field(
        default=None, description="Steps and Nyquist curve of the gains before; null: not known, or not stable"
    )
    new_curves: LoopCurves | None = Field(
        default=None, description="Steps and Nyquist curve of the gains of the job; null: it has none"
    )
    new_beside: str | None = Field(
        default=None, description="How the gains of the job compare with those before, in a sentence; null: not known"
    )
    designs: list[DesignPoint] = Field(description="One entry for each Ms, in rising order")


@dataclass(frozen=True, slots=True)
class _Designing:
    """The design of gains on one model.

    model: with the delay of the sampling in its dead time.
    Ts: the sample time, s.
    before, ends: the performance of the gains before the job, and the lengths of the curves, once they are known.
    """

    model: Model
    Ts: float
    gains: Callable[[float], Gains]
    uncertainty: Callable[[Gains], float | None]
    largest: float
    previous: PerformanceView | None = None
    ends: Horizons = (1.0, 1.0)

    def point(self, Ms: float) -> DesignPoint:
        try:
            gains = self.gains(Ms)
            unsure = self.uncertainty(gains)
            if unsure is not None and unsure > self.largest:
                raise Refused(Reason.UNCERTAIN, f"Ms of these gains is known to +-{unsure:.2g} only")
        except Ended as refusal:
            return _refused(Ms, refusal)
        performance = self.performance(gains)
        return DesignPoint(
            Ms_asked=Ms, gains=GainsView.of(gains), uncertainty=unsure, performance=performance,
            beside=self.beside(performance), curves=self.curves(gains), reason=None, detail=None, advice=None,
        )  # fmt: skip

    def performance(self, gains: Gains) -> PerformanceView:
        found = json_object(loop_performance(self.model, gains, self.Ts))
        return PerformanceView.model_validate(found)

    def beside(self, after: PerformanceView | None) -> str | None:
        return None if self.previous is None or after is None or not after.stable else beside(self.previous, after)

    def curves(self, gains: Gains | None) -> LoopCurves | None:
        return None if gains is None else loop_curves(self.model, gains, self.ends, self.Ts)


def design_curve(row: Job, model: Model, evaluation: Evaluation | None) -> DesignCurve:
    """Returns the gains for each Ms of GRID.

    model: the job's model.
    evaluation: that of the job's record, whose model is then taken: one fit for all gains; None without a record.
    """
    spec = asked_spec(row, DesignSpec().Ms)
    if evaluation is not None:
        designing = _on_record(evaluation, spec)
        model, delay_s, words = evaluation.model, evaluation.design_delay, "one fit to the job's record"
    else:
        Ts = loop_state(row.found).sample_time_s if row.found else 0.0
        designing = _on_model(model, Ts, spec)
        delay_s, words = 0.5 * Ts, "the job's model"
    old, new = previous_gains(row), new_gains(row)
    before, after = (None if each is None else designing.performance(each) for each in (old, new))
    ends = horizons(designing.model, (new, old), designing.Ts)
    designing = replace(designing, previous=before, ends=ends)
    if evaluation is not None and evaluation.reason is not None:
        refusal = Refused(evaluation.reason, evaluation.detail)
        points = [_refused(Ms, refusal) for Ms in GRID]
    else:
        points = [designing.point(Ms) for Ms in GRID]
    return DesignCurve(
        designed_on=words,
        derivative=spec.derivative,
        aim=spec.aim,
        mv_peak=spec.mv_peak,
        noise_gain=spec.noise_gain,
        setpoint_weight_max=spec.weights[1],
        num=list(model.num),
        den=list(model.den),
        dead_time_s=model.L,
        sampling_delay_s=delay_s,
        previous=before,
        new=after,
        previous_curves=designing.curves(old),
        new_curves=designing.curves(new),
        new_beside=designing.beside(after),
        designs=points,
    )


def _on_record(evaluation: Evaluation, spec: DesignSpec) -> _Designing:
    record = evaluation.fit.record
    model = replace(evaluation.model, L=evaluation.model.L + evaluation.design_delay)

    def gains(Ms: float) -> Gains:
        return required(GainDesign(model, replace(spec, Ms=Ms), record.period * record.Ts)).gains

    def uncertainty(of: Gains) -> float | None:
        return known_Ms(evaluation, of).uncertainty

    return _Designing(model, record.Ts, gains, uncertainty, MAX_UNCERTAINTY[record.excitation])


def _on_model(model: Model, Ts: float, spec: DesignSpec) -> _Designing:
    def gains(Ms: float) -> Gains:
        return designed_on(model, replace(spec, Ms=Ms), Ts).gains

    return _Designing(delayed(model, 0.5 * Ts), Ts, gains, lambda _: None, 0.0)


def _refused(Ms: float, refusal: Ended) -> DesignPoint:
    return DesignPoint(
        Ms_asked=Ms, gains=None, uncertainty=None, performance=None,
        reason=refusal.reason, detail=refusal.detail, advice=ADVICE[refusal.reason],
    )  # fmt: skip
