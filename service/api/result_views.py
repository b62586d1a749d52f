"""The numbers of a result, as the API shows them."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from loopwright.service.planning.ground import GainsSource, PlantSource


class UltimateView(BaseModel):
    """The ultimate point as measured, or typed in."""

    Ku: float = Field(description="MV percent per PV unit")
    Pu_s: float = Field(description="s")


class ModelView(BaseModel):
    """K exp(-L s)/(T s + 1), or with zeta K exp(-L s)/(T^2 s^2 + 2 zeta T s + 1)."""

    K: float = Field(description="PV units per MV percent")
    T_s: float = Field(description="s; of second order 1/(natural frequency)")
    L_s: float = Field(description="Dead time, s")
    zeta: float | None = Field(default=None, description="Damping ratio of a model of second order")
    k_source: str | None = Field(default=None, description="k5, ke (the estimate), record (identified), typed in")
    k5: float | None = Field(default=None, description="Gain by formula (5)")
    ke: float | None = Field(default=None, description="Gain as measured")
    fit_pct: float | None = Field(default=None, description="Fit of an identified model to its record, NRMSE, percent")


class TransferModelView(BaseModel):
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


class LoadStepView(BaseModel):
    """A step of the load during the test, found in the record and allowed for."""

    t_s: float = Field(description="Since the relay's start, s")
    size: float = Field(description="At the plant's input, MV percent")


class EvidenceView(BaseModel):
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


class VerificationView(BaseModel):
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


class PredictedView(BaseModel):
    """Gains on the model: computed, not measured."""

    Ms: float
    GM: float | None = Field(description="Ratio; null: no crossing")
    PM_deg: float | None = Field(description="Degrees; null: no crossing")
    overshoot_pct: float
    settling_s: float | None = Field(description="Into 5 %, s; null: not within the response looked at")
    IAE_per_unit: float | None = Field(description="Of a unit step, s; null: an offset stays")


class StepWorthView(BaseModel):
    """The answer to a unit step of the set-point (PV units), or of the load at the plant's input (percent of MV)."""

    IAE: float | None = Field(
        description="Integral of |error|. Set-point: s. Load: PV units * s per percent. null: an offset stays"
    )
    peak: float = Field(description="Largest change of PV. Set-point: per PV unit. Load: PV units per percent")
    settling_s: float | None = Field(description="Into 5 %, s; null: not within the response looked at")
    TV: float = Field(description="Total variation of MV, the effort. Set-point: percent per PV unit. Load: 1 at least")


class WorthView(BaseModel):
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


class ComparisonView(BaseModel):
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


class RehearsedOnView(BaseModel):
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


class StepView(BaseModel):
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


def model_view(stored: dict[str, Any] | None) -> ModelView | TransferModelView | None:
    """Of either procedure."""
    found: ModelView | TransferModelView | None = known(
        TransferModelView if stored and "num" in stored else ModelView, stored
    )
    return found


def verification_view(stored: dict[str, Any] | None) -> VerificationView | None:
    found: VerificationView | None = known(VerificationView, stored and stored | stored["tested"])
    return found


def rehearsed_on_view(stored: dict[str, Any] | None) -> RehearsedOnView | None:
    if not stored:
        return None
    urls = {name: f"/jobs/{stored[name]}" for name in ("plant_job", "gains_job") if stored[name] is not None}
    return RehearsedOnView.model_validate(stored | urls)


def known(kind: type[BaseModel], stored: dict[str, Any] | None) -> Any:
    """The view of a stored result, None when there is none."""
    return kind.model_validate(stored) if stored else None
