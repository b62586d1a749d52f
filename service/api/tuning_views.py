"""What the API shows of methods and tunings; the same objects as `loopwright methods` and `loopwright tune`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from loopwright.service.inputs.model_json import ModelForm, form_shown
from loopwright.service.results import GainsView
from loopwright.tuning.reasons import Reason
from loopwright.tuning.rules.design import MIN_GM, MAX_Ms

ShownModel = Annotated[ModelForm, BeforeValidator(form_shown)]


class OptionView(BaseModel):
    """An option of a method."""

    kind: Literal["number", "whole", "flag", "choice"] = Field(examples=["number"])
    unit: str = Field(description="Empty for none", examples=["s"])
    default: float | str | bool | None = Field(description="null: the method decides from the model", examples=[None])
    meaning: str = Field(examples=["time constant of the closed loop; none: the dead time"])
    choices: list[str | float] = Field(description="The only values, for kind choice", examples=[["pi", "pid"]])
    minimum: float | None = Field(examples=[0.0])
    maximum: float | None = Field(examples=[None])


class MethodView(BaseModel):
    """A tuning method."""

    method: str = Field(description="Its name", examples=["simc"])
    title: str = Field(examples=["SIMC"])
    source: str = Field(examples=["S. Skogestad, J. Process Control 13, 2003"])
    for_what: str = Field(description="When to choose it")
    needs: str = Field(description="The models it takes; richer ones are reduced where a sound reduction exists")
    options: dict[str, OptionView]


class TuningRequest(BaseModel):
    """A model, and what to tune it by."""

    model_config = ConfigDict(extra="forbid")

    model: ModelForm = Field(
        description="The model, in one of five forms", examples=[{"K": 0.8, "T_s": 3.0, "L_s": 1.0}]
    )
    method: str = Field(default="all", description="One of GET /methods, or all", examples=["simc"])
    options: dict[str, Any] = Field(
        default_factory=dict,
        description="By name; with all, each goes to the methods that have it",
        examples=[{"tau_c_s": 2.0}],
    )


class ParallelView(BaseModel):
    """The same controller as Kp + Ki/s + Kd s/(1 + Tf s)."""

    Kp: float = Field(description="MV units per PV unit", examples=[1.5])
    Ki: float = Field(description="MV units per PV unit and s", examples=[0.5])
    Kd: float = Field(description="MV units times s per PV unit", examples=[0.0])
    Tf: float = Field(description="s", examples=[0.0])


class MarginsView(BaseModel):
    """Of the loop on the model; null where there is no such crossing, all for an unstable loop."""

    stable: bool
    Ms: float | None = Field(description="Maximum sensitivity", examples=[1.59])
    Mt: float | None = Field(description="Maximum complementary sensitivity", examples=[1.0])
    GM: float | None = Field(description="Gain margin, ratio", examples=[3.1])
    PM_deg: float | None = Field(description="Phase margin, degrees", examples=[61.0])
    delay_margin_s: float | None = Field(description="Dead time that the loop bears in addition, s", examples=[2.1])
    bandwidth_rad_s: float | None = Field(description="rad/s", examples=[0.7])


class FiguresView(BaseModel):
    """Of the answer to a unit step; null where it does not settle or there is no such figure."""

    overshoot_pct: float = Field(description="Of the final change; 0 for a load", examples=[4.0])
    rise_s: float | None = Field(description="10 to 90 %, s", examples=[3.2])
    settling_s: float | None = Field(description="Into settling_band for good, s", examples=[8.4])
    settling_band: float = Field(description="2 % of the final change (load: of the peak), PV units", examples=[0.02])
    peak: float = Field(description="Largest change of PV, PV units", examples=[1.04])
    IAE: float = Field(description="Integral of |e|, PV units s", examples=[2.2])
    ISE: float = Field(description="Integral of e^2, PV units^2 s", examples=[1.7])
    ITAE: float = Field(description="Integral of t|e|, PV units s^2", examples=[2.9])
    ITSE: float = Field(description="Integral of t e^2, PV units^2 s^2", examples=[1.3])
    MIE: float = Field(description="Mean of |e| until settled, PV units", examples=[0.26])
    MIC: float | None = Field(description="Mean of |change of MV| until settled, MV units", examples=[1.2])
    effort: float | None = Field(description="Integral of (MV - its final value)^2, MV units^2 s", examples=[0.5])
    TV: float | None = Field(description="Total variation of MV, MV units", examples=[2.1])
    peak_u: float | None = Field(description="Largest change of MV, MV units", examples=[1.9])


class TunedView(BaseModel):
    """What one method says of the model. The figures are of just these gains, an ideal derivative filtered first."""

    method: str = Field(examples=["simc"])
    title: str = Field(examples=["SIMC"])
    outcome: Literal["tuned", "refused"]
    reason: Reason | None = Field(description="Why it refused, from the closed list")
    detail: str | None = Field(description="The reason's numbers")
    advice: str | None = Field(description="What to do about it")
    gains: GainsView | None
    parallel: ParallelView | None
    chosen: dict[str, float] | None = Field(description="Design parameters in effect, by name with unit")
    notes: list[str]
    margins: MarginsView | None
    setpoint: FiguresView | None = Field(description="Unit step of the set-point; null for an unstable loop")
    load: FiguresView | None = Field(description="Unit step at the plant's input; null for an unstable loop")


class TuningsView(BaseModel):
    """A model and what the methods say of it."""

    model: ShownModel = Field(description="The model as understood", examples=[{"K": 0.8, "T_s": 3.0, "L_s": 1.0}])
    methods: list[TunedView]
    form: str = Field(description="The controller that the gains belong to")
    figures_are: str = Field(description="What margins and figures were computed with")
    units: dict[str, str]


class AlternativeView(TunedView):
    retune: dict[str, Any] | None = Field(
        description="Body for POST /loops/{tag}/retune, which tries these gains on the loop without another "
        f"experiment; null without gains, where Ms is above {MAX_Ms:g} or GM below {MIN_GM:g}, and for a rule on a "
        "model that is not K, T_s, L_s",
        examples=[
            {
                "start": "optimise",
                "method": "simc",
                "model": {"K": 0.8, "T_s": 3.0, "L_s": 1.0},
                "propose_anyway": True,
            }
        ],
    )

    uncertainty: float | None = Field(
        description="With `ms`: so much larger Ms would be with the model two standard deviations off; null: no record"
    )
    ambiguity: float | None = Field(
        description="With `ms`: largest difference of Ms on a rival model of the same record; null: no record"
    )


class AlternativesView(BaseModel):
    """What the methods, or fast for another Ms, say of the model that a job found."""

    job: str = Field(examples=["4f0c2a9be113"])
    loop: str = Field(examples=["TIC-101"])
    model: ShownModel = Field(description="The job's model", examples=[{"K": 0.8, "T_s": 3.0, "L_s": 1.0}])
    methods: list[AlternativeView]
    form: str = Field(description="The controller that the gains belong to")
    figures_are: str = Field(description="What margins and figures were computed with")
    units: dict[str, str]
