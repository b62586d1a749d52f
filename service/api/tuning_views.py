"""The views of methods and tunings; `loopwright methods` and `loopwright tune` print the same objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, Field

from loopwright.service.inputs.model_json import ModelForm, form_shown
from loopwright.service.inputs.validation import STRICT
from loopwright.service.planning.curves import LoopCurves
from loopwright.service.results import GainsView
from loopwright.tuning.reasons import Reason
from loopwright.tuning.rules.design import MIN_GM, MAX_Ms

ShownModel = Annotated[ModelForm, BeforeValidator(form_shown)]


class OptionView(BaseModel):
    """An option of a method."""

    kind: Literal["number", "whole", "flag", "choice"] = Field(examples=["number"])
    unit: str = Field(description="Unit of the value; empty: it has none", examples=["s"])
    default: float | str | bool | None = Field(
        description="Default value; null: the method chooses one from the model", examples=[None]
    )
    meaning: str = Field(examples=["time constant of the closed loop; none: the dead time"])
    choices: list[str | float] = Field(
        description="Permitted values of an option of kind choice", examples=[["pi", "pid"]]
    )
    minimum: float | None = Field(examples=[0.0])
    maximum: float | None = Field(examples=[None])


class MethodView(BaseModel):
    """A tuning method."""

    method: str = Field(description="Name of the method", examples=["simc"])
    title: str = Field(examples=["SIMC"])
    source: str = Field(examples=["S. Skogestad, J. Process Control 13, 2003"])
    for_what: str = Field(description="When to choose the method")
    needs: str = Field(description="Models that the method takes; others are reduced where a sound reduction exists")
    options: dict[str, OptionView]


class TuningRequest(BaseModel):
    """A process model, and the method that tunes it."""

    model_config = STRICT

    model: ModelForm = Field(
        description="Process model in one of five forms", examples=[{"K": 0.8, "T_s": 3.0, "L_s": 1.0}]
    )
    method: str = Field(default="all", description="A method of GET /methods, fast, or all", examples=["simc"])
    options: Mapping[str, object] = Field(
        default_factory=dict,
        description="Options of the method by name; with all, each option goes to the methods that have it",
        examples=[{"tau_c_s": 2.0}],
    )


class ParallelView(BaseModel):
    """The gains in parallel form, Kp + Ki/s + Kd s/(1 + Tf s)."""

    Kp: float = Field(description="Proportional gain, MV units per PV unit", examples=[1.5])
    Ki: float = Field(description="Integral gain, MV units per PV unit and s", examples=[0.5])
    Kd: float = Field(description="Derivative gain, MV units times s per PV unit", examples=[0.0])
    Tf: float = Field(description="Derivative filter time, s", examples=[0.0])


class MarginsView(BaseModel):
    """Stability margins of the loop on the model. A margin is null if the frequency response has no such crossing; all
    margins are null for an unstable loop."""

    stable: bool
    Ms: float | None = Field(description="Maximum sensitivity", examples=[1.59])
    Mt: float | None = Field(description="Maximum complementary sensitivity", examples=[1.0])
    GM: float | None = Field(description="Gain margin, ratio", examples=[3.1])
    PM_deg: float | None = Field(description="Phase margin, degrees", examples=[61.0])
    delay_margin_s: float | None = Field(
        description="Additional dead time at which the loop becomes unstable, s", examples=[2.1]
    )
    bandwidth_rad_s: float | None = Field(description="Bandwidth, rad/s", examples=[0.7])


class FiguresView(BaseModel):
    """Performance figures of the response to a unit step. A figure is null if the response does not settle or the
    figure does not exist."""

    overshoot_pct: float = Field(
        description="Overshoot, percent of the final change; 0 for a load disturbance", examples=[4.0]
    )
    rise_s: float | None = Field(description="Rise time from 10 to 90 %, s", examples=[3.2])
    settling_s: float | None = Field(description="Settling time into settling_band, s", examples=[8.4])
    settling_band: float = Field(
        description="2 % of the final change (load disturbance: of the peak), PV units", examples=[0.02]
    )
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
    """The tuning of the model by one method. An ideal derivative is filtered before the figures are computed."""

    method: str = Field(examples=["simc"])
    title: str = Field(examples=["SIMC"])
    outcome: Literal["tuned", "refused"]
    reason: Reason | None = Field(description="Why the method refused; reason code from the closed list")
    detail: str | None = Field(description="The numbers behind the reason")
    advice: str | None = Field(description="What to do about the refusal")
    gains: GainsView | None
    parallel: ParallelView | None
    design: dict[str, float] | None = Field(description="Design parameters in effect; the names carry the units")
    notes: list[str]
    margins: MarginsView | None
    setpoint: FiguresView | None = Field(
        description="Figures of a unit step of the set-point; null for an unstable loop"
    )
    load: FiguresView | None = Field(description="Figures of a unit step of the load; null for an unstable loop")


class RecommendedView(BaseModel):
    """The method to take first."""

    method: str = Field(examples=["simc"])
    reason: str = Field(description="Why it is recommended, with its figures")


class TuningsView(BaseModel):
    """A model and its tunings by the methods."""

    model: ShownModel = Field(description="The model as understood", examples=[{"K": 0.8, "T_s": 3.0, "L_s": 1.0}])
    methods: list[TunedView]
    recommended: RecommendedView | None = Field(
        description="The method of lowest IAE among those with Ms of at most 1.7; null: fewer than two methods gave "
        "gains, or none is as robust"
    )
    form: str = Field(description="The controller that the gains belong to")
    figures_are: str = Field(description="What margins and figures were computed with")
    units: dict[str, str]


class AlternativeView(TunedView):
    """The tuning by one method of the model that a job found."""

    retune: Mapping[str, object] | None = Field(
        description="Body for POST /loops/{tag}/retune that tests these gains on the loop without another "
        f"experiment; null: there are no gains, Ms is above {MAX_Ms:g} or GM below {MIN_GM:g}, or a rule has a model "
        "that is not of the form K, T_s, L_s",
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
        description="Increase of Ms when the model is two standard deviations off, only with `Ms`; null: no record"
    )
    ambiguity: float | None = Field(
        description="Largest difference of Ms on a candidate model that explains the record as well, only with `Ms`; "
        "null: no record"
    )
    curves: LoopCurves | None = Field(
        description="Steps and Nyquist curve of the gains on the model with half a sample of delay; null: there are no "
        "gains, or their loop is not stable"
    )


class AlternativesView(BaseModel):
    """Tunings of the model that a job found, by other methods or by fast for another Ms."""

    job: str = Field(examples=["4f0c2a9be113"])
    loop: str = Field(examples=["TIC-101"])
    model: ShownModel = Field(description="Model that the job found", examples=[{"K": 0.8, "T_s": 3.0, "L_s": 1.0}])
    methods: list[AlternativeView]
    form: str = Field(description="The controller that the gains belong to")
    figures_are: str = Field(description="What margins and figures were computed with")
    units: dict[str, str]
