"""The result of a retune: stored with its job, shown by the API, and printed by `loopwright rehearse --json`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from loopwright.service.jsonable import JsonObject
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction

TYPED_IN = "typed in"
"""The structure, or the source of the gain, of a model that a person has given."""


class Figures(BaseModel):
    """A part of a result. Nothing changes it once it is made."""

    model_config = ConfigDict(frozen=True)


class PlantSource(StrEnum):
    """The value is what the API shows."""

    GIVEN = "given"
    LAST_MODEL = "last_model"
    GUESSED = "guessed"


class GainsSource(StrEnum):
    """The value is what the API shows."""

    CONTROLLER = "controller"
    LAST_JOB = "last_job"
    ASSUMED = "assumed"


class GainsView(Figures):
    """ISA (standard) form: u = Kp (b SP - PV + 1/Ti int(SP - PV) + Td d/dt(c SP - PV) / (1 + Tf s))."""

    form: str = Field(default="ISA", description="Form of the controller")
    Kp: float = Field(description="Proportional gain, MV percent per PV unit", examples=[0.75])
    Ti: float = Field(description="Integral time, s; 0 means none", examples=[19.17])
    Td: float = Field(description="Derivative time, s", examples=[0.0])
    Tf: float = Field(description="Derivative filter time, s", examples=[0.0])
    b: float = Field(description="Set-point weight of the proportional path", examples=[1.0])
    c: float = Field(description="Set-point weight of the derivative path", examples=[0.0])

    def gains(self) -> Gains:
        """The same gains as those of the library."""
        return Gains(self.Kp, self.Ti, self.Td, self.Tf, self.b, self.c)

    @classmethod
    def of(cls, gains: Gains) -> GainsView:
        return cls(Kp=gains.Kp, Ti=gains.Ti, Td=gains.Td, Tf=gains.Tf, b=gains.b, c=gains.c)


class UltimateView(Figures):
    """The ultimate point as measured, or typed in."""

    Ku: float = Field(description="MV percent per PV unit")
    Pu_s: float = Field(description="s")


class ModelView(Figures):
    """K exp(-L s)/(T s + 1), or with zeta K exp(-L s)/(T^2 s^2 + 2 zeta T s + 1)."""

    K: float = Field(description="PV units per MV percent")
    T_s: float = Field(description="s; of second order 1/(natural frequency)")
    L_s: float = Field(description="Dead time, s")
    zeta: float | None = Field(default=None, description="Damping ratio of a model of second order")
    k_source: str | None = Field(default=None, description="k5, ke (the estimate), record (identified), typed in")
    k5: float | None = Field(default=None, description="Gain by formula (5)")
    ke: float | None = Field(default=None, description="Gain as measured")
    fit_pct: float | None = Field(default=None, description="Fit of an identified model to its record, NRMSE, percent")

    @property
    def typed_in(self) -> bool:
        return self.k_source == TYPED_IN

    def process_model(self) -> FOPDT | SOPDT:
        """The same model as a process model of the library."""
        if self.zeta is None:
            return FOPDT(self.K, self.T_s, self.L_s)
        return SOPDT(self.K, self.T_s, self.zeta, self.L_s)


class TransferModelView(Figures):
    """num(s)/den(s) exp(-dead_time_s s), highest power of s first, as method fast finds it; den begins with 1.

    Static gain and time constants are not given: a short record of a slow plant hardly shows them, and the gains do
    not depend on them.
    """

    structure: str = Field(description="The structure that the record supports best; or typed in", examples=["sopdt"])
    num: list[float] = Field(description="PV units per MV percent, times in s")
    den: list[float]
    dead_time_s: float = Field(description="Dead time, s")
    num_errors: list[float] | None = Field(default=None, description="Standard errors; null: typed in")
    den_errors: list[float] | None = Field(default=None, description="Standard errors; null: typed in")
    dead_time_error_s: float | None = Field(default=None, description="Standard error, s; null: typed in")

    @property
    def typed_in(self) -> bool:
        return self.structure == TYPED_IN

    def process_model(self) -> TransferFunction:
        """The same model as a process model of the library."""
        return TransferFunction(tuple(self.num), tuple(self.den), self.dead_time_s)


class LoadStepView(Figures):
    """A step of the load during the test, found in the record and allowed for."""

    t_s: float = Field(description="Since the relay's start, s")
    size: float = Field(description="At the plant's input, MV percent")


class EvidenceView(Figures):
    """What the record of method fast says, and how sure it is."""

    structure: str = Field(description="Of the model", examples=["sopdt"])
    Ms: float = Field(description="Of the gains designed, half a sample's delay included", examples=[1.6])
    uncertainty: float | None = Field(
        description="So much larger Ms would be with the model two standard deviations off", examples=[0.02]
    )
    ambiguity: float = Field(
        description="Largest difference of Ms on a rival model that explains the record as well", examples=[0.01]
    )
    residual: float | None = Field(description="What the model leaves, in noises at rest", examples=[1.0])
    loads: list[LoadStepView]
    drift: bool = Field(description="PV drifted at a steady rate, which was allowed for")
    switches: int = Field(description="Of the relay", examples=[4])
    period_s: float = Field(description="Of PV under the relay, s", examples=[12.5])
    reason: str | None = Field(description="Why that is not enough for a proposal, from the closed list")
    detail: str = Field(description="The numbers behind that reason")


class VerificationView(Figures):
    """The set-point step of method fast under the gains of the first design. It begins while PV still swings; the gains
    proposed are designed on this record too."""

    Kp: float = Field(description="As tested, MV percent per PV unit")
    Ti: float = Field(description="As tested, s")
    Td: float = Field(description="As tested, s")
    Ms: float = Field(description="Of the tested gains on the model of the whole record")
    step: float = Field(description="PV units")
    duration_s: float
    fit_pct: float = Field(description="How much of the measured step the model explains, NRMSE, percent")
    rms: float = Field(description="What it leaves, PV units")

    @classmethod
    def of_stage(cls, result: JsonObject) -> VerificationView:
        """Makes the view from the JSON of a `VerifiedStep`, which is the result of the stage verify."""
        tested = result["tested"]
        assert isinstance(tested, dict)
        return cls.model_validate({**result, **tested})


class PredictedView(Figures):
    """Gains on the model: computed, not measured."""

    Ms: float
    GM: float | None = Field(description="Ratio; null: no crossing")
    PM_deg: float | None = Field(description="Degrees; null: no crossing")
    overshoot_pct: float
    settling_s: float | None = Field(description="Into 5 %, s; null: not within the response looked at")
    IAE_per_unit: float | None = Field(description="Of a unit step, s; null: an offset stays")


class StepWorthView(Figures):
    """The answer to a unit step of the set-point (PV units), or of the load at the plant's input (percent of MV)."""

    IAE: float | None = Field(
        description="Integral of |error|. Set-point: s. Load: PV units * s per percent. null: an offset stays"
    )
    peak: float = Field(description="Largest change of PV. Set-point: per PV unit. Load: PV units per percent")
    settling_s: float | None = Field(description="Into 5 %, s; null: not within the response looked at")
    TV: float = Field(description="Total variation of MV, the effort. Set-point: percent per PV unit. Load: 1 at least")


class WorthView(Figures):
    """What gains are worth on the model found: computed, not measured. All figures are null for an unstable loop."""

    stable: bool
    Ms: float | None
    Mt: float | None = Field(description="Largest peak of the closed loop")
    GM: float | None = Field(description="Ratio; null: no crossing")
    PM_deg: float | None = Field(description="Degrees; null: no crossing")
    noise_gain: float | None = Field(description="MV's answer to a jump of PV, percent per PV unit")
    overshoot_pct: float | None = Field(description="Of a step of the set-point, percent")
    setpoint: StepWorthView | None
    load: StepWorthView | None


class ComparisonView(Figures):
    """The present and the new gains on the model found, and whether what was asked for gets better."""

    before: WorthView = Field(description="The present gains")
    after: WorthView = Field(description="The new gains")
    Ms_asked: float = Field(description="Ms was to be at most this", examples=[1.6])
    criterion: str = Field(description="J: what the method makes as small as it can", examples=["criterion (7)"])
    J_before: float | None = Field(description="null: the loop is not stable, or an offset stays")
    J_after: float | None = Field(description="null: an offset stays")
    gain: bool = Field(
        description="What was asked for gets better by more than 5 %: a bound of robustness that the present gains "
        "pass is kept again, or J falls. Without a gain nothing is proposed unless propose_anyway is asked for"
    )
    verdict: str = Field(description="The same in a sentence")


class RehearsedOnView(Figures):
    """What a dry run was done on."""

    plant_source: PlantSource = Field(
        description="given: plant or model of the request; last_model: found by the latest job of the loop that found "
        "one; guessed: from T95 and the limits"
    )
    plant_job: str | None = Field(description="URL of the job that found the model", examples=["/jobs/4f0c2a9be113"])
    plant_job_ended_at: str | None = Field(description="UTC, ISO 8601, wall time")
    num: list[float] = Field(description="Of the plant, highest power of s first, PV units per MV percent")
    den: list[float]
    dead_time_s: float
    gains_source: GainsSource = Field(
        description="Of gains, sample time, limits and action. controller: it answered; last_job: as the latest job "
        "had found them; assumed: neither"
    )
    gains_job: str | None = Field(description="URL of the job that had found them", examples=["/jobs/4f0c2a9be113"])
    plant_text: str = Field(description="The plant in words")
    gains_text: str = Field(description="The gains in words; why the controller did not answer, where it did not")


class StepView(Figures):
    """A set-point step measured on the loop."""

    step: float = Field(description="PV units")
    overshoot_pct: float
    IAE: float = Field(description="PV units * s")
    settling_s: float = Field(description="Into 5 %, s")
    static_gain: float | None = Field(description="PV units per MV percent; null: not known")
    mv_span: float = Field(description="Largest less smallest MV, percent")
    mv_at_limit_s: float = Field(default=0.0, description="How long MV was at the end of its permitted range, s")
    settled: bool
    duration_s: float


class _Result(Figures):
    """What the results of both procedures have. Everything is null that the retune did not come to."""

    method: str = Field(description="What gives the gains", examples=["fast"])
    chosen: dict[str, float] = Field(
        default_factory=dict, description="The method's design parameters in effect, by name with unit"
    )
    ultimate: UltimateView | None = None
    old_gains: GainsView | None = Field(default=None, description="The gains before the test")
    new_gains: GainsView | None = Field(default=None, description="Proposed, rehearsed, or not worth a proposal")
    comparison: ComparisonView | None = Field(
        default=None, description="Present and new gains side by side on the model, with the verdict"
    )
    rehearsed_on: RehearsedOnView | None = Field(default=None, description="Of a dry run: which plant and which gains")
    predicted: PredictedView | None = Field(default=None, description="The new gains on the model")
    after: StepView | None = Field(default=None, description="A set-point step with the new gains, measured from rest")
    notes: list[str] = Field(default_factory=list, description="What the operator should know")


class FastResult(_Result):
    """The result of the procedure fast."""

    procedure: Literal["fast"] = "fast"
    model: TransferModelView | None = None
    predicted_before: PredictedView | None = Field(
        default=None, description="The old gains on the same model; null: not stable there"
    )
    evidence: EvidenceView | None = Field(default=None, description="What the record says")
    verification: VerificationView | None = Field(default=None, description="The measured step that proves the model")


class FiveStageResult(_Result):
    """The result of the procedure five-stage, in which the rules of `loopwright methods` run too."""

    procedure: Literal["five-stage"] = "five-stage"
    model: ModelView | None = None
    before: StepView | None = Field(default=None, description="A set-point step with the old gains, measured")


Result = Annotated[FastResult | FiveStageResult, Field(discriminator="procedure")]
RESULT: TypeAdapter[FastResult | FiveStageResult] = TypeAdapter(Result)
"""Reads a result from JSON."""


def empty_result(method: str, rehearsed_on: RehearsedOnView | None = None) -> FastResult | FiveStageResult:
    """The result of a retune that came to no gains."""
    kind = FastResult if method == "fast" else FiveStageResult
    return kind(method=method, rehearsed_on=rehearsed_on)
