"""The result of a retune, stored with the job, shown by the API and printed by `loopwright rehearse --json`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, computed_field

from loopwright.service.jsonable import JsonObject
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction, time_constants
from loopwright.tuning.reduction.process_parameters import parameters

DESIGNED = ("fast", "setpoint")
"""The methods that fit a model to one record and design the gains on it."""
FIVE_STAGE = "five-stage"
"""The name of the procedure of five stages, which requests without a method mean."""
TYPED_IN = "typed in"
TOLD_APART = 2.0
"""Standard errors by which a pole has to lie away from zero, lest the plant be called integrating."""
NEVER_SEEN = 1000.0
"""Lag of a plant in dead times and other lags, above which no test is long enough to see it."""
"""The structure, or the source of the gain, of a model that a person has typed in."""


class Figures(BaseModel):
    """Base class of the parts of a result, which are immutable."""

    model_config = ConfigDict(frozen=True)


class PlantSource(StrEnum):
    """The origin of the plant of a dry run, as the API shows it."""

    GIVEN = "given"
    LAST_MODEL = "last_model"
    GUESSED = "guessed"


class GainsSource(StrEnum):
    """The origin of the present gains of a dry run, as the API shows it."""

    CONTROLLER = "controller"
    LAST_JOB = "last_job"
    ASSUMED = "assumed"


class GainsView(Figures):
    """Gains in ISA (standard) form: u = Kp (b SP - PV + 1/Ti int(SP - PV) + Td d/dt(c SP - PV) / (1 + Tf s))."""

    form: str = Field(default="ISA", description="Form of the controller")
    Kp: float = Field(description="Proportional gain, MV percent per PV unit", examples=[0.75])
    Ti: float = Field(description="Integral time, s; 0 means none", examples=[19.17])
    Td: float = Field(description="Derivative time, s", examples=[0.0])
    Tf: float = Field(description="Derivative filter time, s", examples=[0.0])
    b: float = Field(description="Set-point weight of the proportional path", examples=[1.0])
    c: float = Field(description="Set-point weight of the derivative path", examples=[0.0])

    def gains(self) -> Gains:
        """The gains as an object of `tuning`."""
        return Gains(self.Kp, self.Ti, self.Td, self.Tf, self.b, self.c)

    @classmethod
    def of(cls, gains: Gains) -> GainsView:
        return cls(Kp=gains.Kp, Ti=gains.Ti, Td=gains.Td, Tf=gains.Tf, b=gains.b, c=gains.c)


class KnownMsView(Figures):
    """Ms of gains on a model, with what is known of it. Both are null where the loop is not stable on the model."""

    Ms: float | None = Field(description="Maximum sensitivity on the model", examples=[1.9])
    uncertainty: float | None = Field(
        description="How far Ms may be off: by two standard deviations of the model, or on another model that explains "
        "the record as well; from normal operation alone, where no step follows, by all that may be wrong together",
        examples=[0.03],
    )


class KnownGainsView(KnownMsView):
    """Gains with what is known of their Ms on the plant. Ms is null, too, where nothing is known of it."""

    gains: GainsView


class RangeView(Figures):
    """A range of a signal."""

    low: float
    high: float


class FindingSource(StrEnum):
    """Where a finding of a loop comes from."""

    OPERATION = "operation"
    JOB = "job"
    TRIAL = "trial"


class UltimateView(Figures):
    """The ultimate gain and period, measured or typed in."""

    Ku: float = Field(description="Ultimate gain, MV percent per PV unit")
    Pu_s: float = Field(description="Ultimate period, s")


class ModelView(Figures):
    """The model K exp(-L s)/(T s + 1), or with zeta K exp(-L s)/(T^2 s^2 + 2 zeta T s + 1)."""

    K: float = Field(description="Static gain, PV units per MV percent")
    T_s: float = Field(description="Time constant, s; of a second-order model 1/(natural frequency)")
    L_s: float = Field(description="Dead time, s")
    zeta: float | None = Field(default=None, description="Damping ratio of a second-order model")
    k_source: str | None = Field(default=None, description="Source of K: k5, ke, record (identified) or typed in")
    k5: float | None = Field(default=None, description="Static gain by formula (5)")
    ke: float | None = Field(default=None, description="Static gain as measured")
    fit_pct: float | None = Field(default=None, description="Fit of an identified model to the record, NRMSE, percent")

    @property
    def typed_in(self) -> bool:
        return self.k_source == TYPED_IN

    def process_model(self) -> FOPDT | SOPDT:
        """The model as an object of `tuning`."""
        if self.zeta is None:
            return FOPDT(self.K, self.T_s, self.L_s)
        return SOPDT(self.K, self.T_s, self.zeta, self.L_s)


class ParameterView(Figures):
    """A parameter of a process model, as controllers and their manuals have it."""

    name: str = Field(
        description="K: process gain; Kv: velocity gain of an integrating process; T, T1, T2: time constants; zeta: "
        "damping ratio; Tz: time constant of a zero; L: dead time",
        examples=["T1"],
    )
    value: float
    error: float | None = Field(description="Standard error; null: the model was typed in")
    unit: str = Field(description="PV/MV, PV/(MV s), s, or empty; PV in its unit, MV in percent", examples=["s"])


class TransferModelView(Figures):
    """The model num(s)/den(s) exp(-dead_time_s s) that method fast identifies. Coefficients are by falling powers of s;
    den begins with 1.

    Its coefficients are what the record determines; gain and time constants (`parameters`) follow from them, and have
    large errors where a short record of a slow plant hardly determines them. The gains do not depend on them.
    """

    structure: str = Field(description="Model structure that the record supports best, or typed in", examples=["sopdt"])
    num: list[float] = Field(description="Numerator, PV units per MV percent, times in s")
    den: list[float] = Field(description="Denominator, times in s")
    dead_time_s: float = Field(description="Dead time, s")
    num_errors: list[float] | None = Field(default=None, description="Standard errors of num; null: typed in")
    den_errors: list[float] | None = Field(default=None, description="Standard errors of den; null: typed in")
    dead_time_error_s: float | None = Field(
        default=None, description="Standard error of the dead time, s; null: typed in"
    )
    covariance: list[list[float]] | None = Field(
        default=None,
        description="Covariance of num, of den without its leading 1 and of the dead time, in this order; null: typed "
        "in",
    )

    @property
    def typed_in(self) -> bool:
        return self.structure == TYPED_IN

    @computed_field(  # type: ignore[prop-decorator]
        description="Whether the plant integrates as far as the record shows: the pole nearest to zero is there, or "
        "cannot be told from it, or its lag is a thousand times as long as all else"
    )
    @property
    def integrating(self) -> bool:
        last, error = self.den[-1], self.den_errors[-1] if self.den_errors else 0.0
        if len(self.den) < 2 or abs(last) <= TOLD_APART * error:
            return len(self.den) > 1
        *rest, slowest = sorted(map(float, time_constants(self.process_model())))
        return slowest > NEVER_SEEN * (self.dead_time_s + sum(rest)) > 0.0

    @computed_field(  # type: ignore[prop-decorator]
        description="The same model as gain, time constants and dead time, with K first and L last; of an integrating "
        "one with its velocity gain; empty: it has a pole on the right, or more than one zero"
    )
    @property
    def parameters(self) -> list[ParameterView]:
        return [
            ParameterView(name=each.name, value=each.value, error=each.error, unit=each.unit)
            for each in parameters(self.num, self.den, self.dead_time_s, self.integrating, self.covariance)
        ]

    @property
    def named(self) -> str:
        """The structure in words."""
        return f"integrating as far as the record shows ({self.structure})" if self.integrating else self.structure

    def process_model(self) -> TransferFunction:
        """The model as an object of `tuning`."""
        return TransferFunction(tuple(self.num), tuple(self.den), self.dead_time_s)


class LoadStepView(Figures):
    """A load disturbance during the test: a step that the fit estimates together with the model."""

    t_s: float = Field(description="Time since the start of the relay or of the pulses, s")
    size: float = Field(description="Size at the plant's input, MV percent")


class EvidenceView(Figures):
    """What the record of method fast shows about the model, and how certain the model is."""

    structure: str = Field(description="Model structure", examples=["sopdt"])
    Ms: float = Field(description="Ms of the designed gains, with half a sampling period of delay", examples=[1.6])
    uncertainty: float | None = Field(
        description="Increase of Ms when the model is two standard deviations off", examples=[0.02]
    )
    ambiguity: float = Field(
        description="Largest difference of Ms on a candidate model that explains the record as well", examples=[0.01]
    )
    residual: float | None = Field(description="Residual of the model as a ratio to the noise at rest", examples=[1.0])
    loads: list[LoadStepView] = Field(description="Load disturbances found in the record")
    drift: bool = Field(description="Whether the fit includes a steady drift of PV")
    switches: int = Field(description="Number of switches of the relay, or of turns of the set-point", examples=[4])
    period_s: float = Field(description="Period of PV under the relay or time scale of the pulses, s", examples=[12.5])
    reason: str | None = Field(
        description="Why the evidence is not enough for a proposal; reason code from the closed list"
    )
    detail: str = Field(description="The numbers behind the reason")
    longest_delay_seen_s: float | None = Field(
        default=None,
        description="How much later a second path of 30 % of MV's effect may act and still show in the record, s; "
        "null: not known",
        examples=[48.0],
    )


class VerificationView(Figures):
    """The set-point step of method fast with the gains of the first design. The step begins while PV still oscillates;
    the proposed gains are designed on its record too."""

    Kp: float = Field(description="Proportional gain as tested, MV percent per PV unit")
    Ti: float = Field(description="Integral time as tested, s")
    Td: float = Field(description="Derivative time as tested, s")
    b: float = Field(default=1.0, description="Set-point weight as tested")
    Ms: float = Field(description="Ms of the tested gains on the model of the whole record")
    step: float = Field(description="Size of the set-point step, PV units")
    duration_s: float
    fit_pct: float = Field(description="Fit of the model to the measured step, NRMSE, percent")
    rms: float = Field(description="RMS of the residual, PV units")

    @classmethod
    def of_stage(cls, result: JsonObject) -> VerificationView:
        """Makes the view from the JSON of a `VerifiedStep`, which is the result of the stage verify."""
        tested = result["tested"]
        assert isinstance(tested, dict)
        return cls.model_validate({**result, **tested})


class PredictedView(Figures):
    """Performance of gains on the model, computed and not measured."""

    Ms: float = Field(description="Maximum sensitivity")
    GM: float | None = Field(description="Gain margin, ratio; null: no crossing")
    PM_deg: float | None = Field(description="Phase margin, degrees; null: no crossing")
    overshoot_pct: float = Field(description="Overshoot of a set-point step, percent")
    settling_s: float | None = Field(
        description="Settling time into 5 %, s; null: PV does not settle within the computed response"
    )
    IAE_per_unit: float | None = Field(description="IAE of a unit set-point step, s; null: an offset remains")


class StepPerformanceView(Figures):
    """The response to a unit step of the set-point (PV units) or of the load at the plant's input (percent of MV)."""

    IAE: float | None = Field(
        description="Integral of |error|. Set-point: s. Load: PV units * s per percent. null: an offset remains"
    )
    peak: float = Field(description="Largest change of PV. Set-point: per PV unit. Load: PV units per percent")
    settling_s: float | None = Field(
        description="Settling time into 5 %, s; null: PV does not settle within the computed response"
    )
    TV: float = Field(description="Total variation of MV. Set-point: percent per PV unit. Load: 1 at least")
    mv_peak: float | None = Field(
        default=None,
        description="Largest change of MV. Set-point: percent per PV unit. null: not computed",
    )


class PerformanceView(Figures):
    """Performance of gains on the identified model, computed, not measured. Figures are null for an unstable loop."""

    stable: bool
    Ms: float | None = Field(description="Maximum sensitivity")
    Mt: float | None = Field(description="Maximum complementary sensitivity")
    GM: float | None = Field(description="Gain margin, ratio; null: no crossing")
    PM_deg: float | None = Field(description="Phase margin, degrees; null: no crossing")
    delay_margin_s: float | None = Field(
        default=None,
        description="Further dead time at which the loop becomes unstable, s; null: there is none",
    )
    noise_gain: float | None = Field(description="Immediate change of MV for a jump of PV, percent per PV unit")
    overshoot_pct: float | None = Field(description="Overshoot of a set-point step, percent")
    setpoint: StepPerformanceView | None = Field(description="Response to a unit step of the set-point")
    load: StepPerformanceView | None = Field(description="Response to a unit step of the load")


class ComparisonView(Figures):
    """The present and the new gains on the identified model, and whether the new gains meet the request better."""

    previous: PerformanceView = Field(description="Performance of the present gains")
    new: PerformanceView = Field(description="Performance of the new gains")
    Ms_asked: float = Field(description="Requested upper bound of Ms", examples=[1.6])
    settling_s_asked: float | None = Field(
        default=None,
        description="Longest settling time asked for, after a set-point step into 5 %, s; null: none was. What the "
        "gains reach is in `previous` and `new`, setpoint.settling_s",
        examples=[300.0],
    )
    mv_peak_asked: float | None = Field(
        default=None,
        description="Largest change of MV asked for, after a set-point step, percent per PV unit; null: none was. What "
        "the gains reach is setpoint.mv_peak",
    )
    noise_gain_asked: float | None = Field(
        default=None, description="Largest noise gain asked for, percent per PV unit; null: none was"
    )
    criterion: str = Field(description="The criterion J that the method minimises", examples=["criterion (7)"])
    J_previous: float | None = Field(
        description="J of the present gains; null: the loop is not stable, or an offset remains"
    )
    J_new: float | None = Field(description="J of the new gains; null: an offset remains")
    gain: bool = Field(
        description="True when the new gains meet a robustness bound that the present gains violate, or when J falls "
        "by more than 5 %. If false, nothing is proposed unless propose_anyway is set"
    )
    verdict: str = Field(description="The comparison in a sentence")


class RehearsedOnView(Figures):
    """The plant and the present gains of a dry run."""

    plant_source: PlantSource = Field(
        description="Origin of the plant. given: plant or model of the request; last_model: model of the latest job of "
        "the loop that found one; guessed: from T95 and the limits"
    )
    plant_job: str | None = Field(description="URL of the job that found the model", examples=["/jobs/4f0c2a9be113"])
    plant_job_ended_at: str | None = Field(description="End of that job, UTC, ISO 8601, wall time")
    num: list[float] = Field(description="Numerator of the plant, highest power of s first, PV units per MV percent")
    den: list[float] = Field(description="Denominator of the plant, highest power of s first")
    dead_time_s: float = Field(description="Dead time of the plant, s")
    gains_source: GainsSource = Field(
        description="Origin of gains, sampling period, limits and action. controller: read from the controller; "
        "last_job: from the latest job of the loop; assumed: neither was available"
    )
    gains_job: str | None = Field(description="URL of the job that recorded the gains", examples=["/jobs/4f0c2a9be113"])
    plant_text: str = Field(description="The plant in words")
    gains_text: str = Field(description="The gains in words, and why the controller did not answer if it did not")


class StepView(Figures):
    """A set-point step measured on the loop."""

    step: float = Field(description="Size of the step, PV units")
    overshoot_pct: float
    IAE: float = Field(description="Integral of |error|, PV units * s")
    settling_s: float = Field(description="Settling time into 5 %, s")
    static_gain: float | None = Field(description="Static gain, PV units per MV percent; null: not known")
    mv_span: float = Field(description="Range of MV during the step, percent")
    mv_at_limit_s: float = Field(default=0.0, description="Time that MV was at a limit of its permitted range, s")
    settled: bool = Field(description="Whether PV settled")
    duration_s: float


class Finding(Figures):
    """What a test, or normal operation, has shown of a loop, as it is stored. Gains are those of that time."""

    source: FindingSource
    at: str = Field(description="UTC, ISO 8601, wall time")
    changes: int | None = Field(default=None, description="Number of set-point changes, of normal operation")
    last_change_s: float | None = Field(default=None, description="Time of the latest of them, seconds since 1970 UTC")
    sample_s: float = Field(default=0.0, description="Length of one sample that was looked at, s")
    job: str | None = Field(default=None, description="Id of the job; of a trial, the one that was accepted")
    method: str | None = Field(default=None, description="Its method")
    present: KnownGainsView = Field(description="The gains in effect, with Ms on the model")
    proposed: KnownGainsView | None = Field(default=None, description="The gains proposed, or found no better")
    Ms_asked: float | None = Field(default=None, description="Upper bound of Ms for which they were designed")
    model: TransferModelView
    sampling_delay_s: float = Field(description="Delay of the sampling that the loop has beside the model, s")
    pv_range: RangeView | None = Field(description="Range of PV for which the model was found")
    mv_range: RangeView | None = Field(description="Range of MV for which the model was found, percent")


class KnowledgeView(Figures):
    """What is known of a loop, from its tests and from normal operation: the best finding of the present plant."""

    text: str = Field(
        description="What is known, in words",
        examples=["Ms known to +-0.03 from 3 set-point changes of normal operation"],
    )
    gains: GainsView = Field(description="The gains that Ms is of: those in effect, as far as they are known")
    Ms: float | None = Field(description="Maximum sensitivity of these gains; null: not stable on the model")
    uncertainty: float | None = Field(
        description="How far Ms may be off; null: Ms is null, or these gains are neither those under which the model "
        "was found nor those that were proposed then",
        examples=[0.03],
    )
    source: FindingSource = Field(
        description="operation: set-point changes of normal operation; job: a test; trial: operation or a test, whose "
        "gains were then tested on the loop and accepted"
    )
    source_text: str = Field(description="The same in words", examples=["3 set-point changes of normal operation"])
    changes: int | None = Field(description="Number of set-point changes of normal operation; null: it was a test")
    job: str | None = Field(description="URL of the test or of the accepted trial", examples=["/jobs/4f0c2a9be113"])
    at: str = Field(description="UTC, ISO 8601, wall time", examples=["2026-01-31T12:00:00.000Z"])
    pv_range: RangeView | None = Field(description="Range of PV for which the model was found, PV units")
    mv_range: RangeView | None = Field(description="Range of MV for which the model was found, percent")
    model: TransferModelView
    proposed: KnownGainsView | None = Field(
        description="The gains that were proposed then, or found no better; null: none, or they are in effect"
    )
    Ms_asked: float | None = Field(description="Upper bound of Ms for which these were designed", examples=[1.6])
    consistent: int = Field(description="Number of further findings that agree", examples=[2])
    superseded: str | None = Field(
        description="Why the latest earlier finding that does not agree is of an older plant; null: there is none"
    )


class _Result(Figures):
    """The fields of the results of both procedures. A field is null if the retune did not get that far."""

    method: str = Field(description="Method that computes the gains", examples=["fast"])
    design: dict[str, float] = Field(
        default_factory=dict, description="Design parameters of the method in effect; the names carry the units"
    )
    ultimate: UltimateView | None = Field(default=None, description="The ultimate point")
    previous_gains: GainsView | None = Field(default=None, description="The gains before the test")
    new_gains: GainsView | None = Field(default=None, description="The gains proposed or rehearsed, or found no better")
    comparison: ComparisonView | None = Field(
        default=None, description="Comparison of the present and the new gains on the model"
    )
    rehearsed_on: RehearsedOnView | None = Field(default=None, description="The plant and the gains of a dry run")
    predicted: PredictedView | None = Field(
        default=None, description="Predicted performance of the new gains on the model"
    )
    step_after: StepView | None = Field(
        default=None, description="Measured set-point step with the new gains, from rest"
    )
    notes: list[str] = Field(default_factory=list, description="Notes for the operator")


class FastResult(_Result):
    """The result of the methods fast and setpoint, which fit a model to one record and design the gains on it."""

    procedure: Literal["fast"] = "fast"
    model: TransferModelView | None = None
    predicted_previous: PredictedView | None = Field(
        default=None, description="Predicted performance of the previous gains; null: the loop is not stable with them"
    )
    model_from: str | None = Field(
        default=None,
        description="Where the model comes from, in words; null: there is none",
        examples=["3 set-point changes of normal operation, from which Ms is known to +-0.03, and the step under the "
                  "new gains"],
    )  # fmt: skip
    evidence: EvidenceView | None = Field(default=None, description="Evidence from the record")
    known_previous: KnownMsView | None = Field(
        default=None, description="Ms of the previous gains; null: there is no record"
    )
    verification: VerificationView | None = Field(default=None, description="Measured step that verifies the model")


class FiveStageResult(_Result):
    """The result of the procedure five-stage, in which the rules of `loopwright methods` are used too."""

    procedure: Literal["five-stage"] = "five-stage"
    model: ModelView | None = None
    step_before: StepView | None = Field(default=None, description="Measured set-point step with the previous gains")


Result = Annotated[FastResult | FiveStageResult, Field(discriminator="procedure")]
RESULT: TypeAdapter[FastResult | FiveStageResult] = TypeAdapter(Result)
"""Reads a result from JSON."""


def empty_result(method: str, rehearsed_on: RehearsedOnView | None = None) -> FastResult | FiveStageResult:
    """The result of a retune that found no gains."""
    kind = FastResult if method in DESIGNED else FiveStageResult
    return kind(method=method, rehearsed_on=rehearsed_on)
