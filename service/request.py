"""What may be asked of a retune, and how it combines with the loop's configuration."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from service.config import LoopConfig
from tuning.five_stage import PROCEDURE, rule_of
from tuning.methods import METHODS
from tuning.models import FOPDT, SOPDT
from tuning.reasons import Refused

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Percent = Annotated[float, Field(gt=0, lt=74, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class BadLimits(ValueError):
    """The limits asked for contradict each other or the loop's configuration."""


class ProcessModel(BaseModel):
    """K exp(-L s) / (T s + 1), or with zeta K exp(-L s) / (T^2 s^2 + 2 zeta T s + 1)."""

    model_config = ConfigDict(extra="forbid")

    K: Finite = Field(description="Static gain, PV units per MV unit (percent)", examples=[0.8])
    T_s: Positive = Field(description="Time constant, s; of second order 1/(natural frequency)", examples=[3.0])
    L_s: NotNegative = Field(description="Dead time, s", examples=[1.0])
    zeta: Positive | None = Field(default=None, description="Damping ratio; leave out for first order", examples=[1.2])

    def plant(self) -> FOPDT | SOPDT:
        if self.zeta is None:
            return FOPDT(self.K, self.T_s, self.L_s)
        return SOPDT(self.K, self.T_s, self.zeta, self.L_s)

    @model_validator(mode="after")
    def _gain(self) -> Self:
        if self.K == 0:
            raise ValueError("K must not be 0")
        return self


class PlantModel(BaseModel):
    """A transfer function for a dry run, coefficients by falling powers of s, deviation variables."""

    model_config = ConfigDict(extra="forbid")

    num: list[Finite] = Field(min_length=1, description="Numerator", examples=[[3.0, 2.0]])
    den: list[Finite] = Field(min_length=1, description="Denominator", examples=[[3.0, 4.0, 1.0]])
    dead_time_s: NotNegative = Field(default=0.0, description="Dead time, s", examples=[1.0])
    noise_std: NotNegative = Field(
        default=0.0, description="Standard deviation of the PV noise, PV units", examples=[0.0]
    )
    seed: int = Field(default=1, description="Seed of the noise", examples=[1])
    sample_time_s: Positive | None = Field(default=None, description="Sampling period, s", examples=[0.1])


class RetuneRequest(BaseModel):
    """Options of a retune; what is left out comes from the loop's configuration."""

    model_config = ConfigDict(extra="forbid")

    method: str = Field(
        default=PROCEDURE,
        description="What gives the gains once the experiment has given the model: the five-stage procedure's own "
        "optimisation, or any of GET /methods",
        json_schema_extra={"enum": [PROCEDURE, *METHODS]},
    )
    method_options: dict[str, bool | float | str] = Field(
        default_factory=dict, description="Options of the method, by name", examples=[{"lambda_s": 12.0}]
    )
    model_from: Literal["overshoot", "record"] | None = Field(
        default=None,
        description="Model for the method: the estimate from the overshoot, or one identified from the set-point step; "
        "by default the first for five-stage, the second for the others if it explains the step",
    )
    dry_run: bool = Field(default=False, description="Rehearse in memory; the loop is not touched")
    sp_deviation: Positive | None = Field(
        default=None, description="Permitted set-point step, PV units; at most the loop's own", examples=[2.0]
    )
    mv_low: Finite | None = Field(default=None, description="Lowest MV during the test, percent", examples=[20.0])
    mv_high: Finite | None = Field(default=None, description="Highest MV during the test, percent", examples=[80.0])
    pv_low: Finite | None = Field(default=None, description="Abort below this PV, PV units", examples=[40.0])
    pv_high: Finite | None = Field(default=None, description="Abort above this PV, PV units", examples=[60.0])
    max_time_s: Positive | None = Field(
        default=None, description="Budget of plant time, s; by default 500 times the loop's T95", examples=[3600.0]
    )
    start: Literal["relay", "zn_pi", "estimate", "optimise"] = Field(
        default="relay", description="Stage to enter at; what earlier stages would have found is then typed in"
    )
    Ku: Positive | None = Field(
        default=None, description="Ultimate gain, MV percent per PV unit, for start=zn_pi", examples=[2.05]
    )
    Pu_s: Positive | None = Field(default=None, description="Ultimate period, s, for start=zn_pi", examples=[3.32])
    Kp: Positive | None = Field(
        default=None, description="ISA gain of the recorded PI step, MV percent per PV unit", examples=[0.9]
    )
    Ti_s: Positive | None = Field(default=None, description="Integral time of the recorded PI step, s", examples=[2.8])
    overshoot_pct: Positive | None = Field(
        default=None, description="Overshoot of the recorded PI step, percent, for start=estimate", examples=[25.0]
    )
    model: ProcessModel | None = Field(
        default=None, description="Model for start=optimise; in a dry run without `plant` the plant itself"
    )
    k_source: Literal["k5", "ke"] = Field(
        default="k5",
        description="Static gain of the model: from the overshoot formulas (k5) or from the experiment (ke)",
    )
    kp_step_factor: Annotated[float, Field(gt=1, le=2, allow_inf_nan=False)] | None = Field(
        default=None, description="Factor by which Kp grows between attempts, over 1", examples=[1.5]
    )
    overshoot_window_pct: tuple[Percent, Percent] = Field(
        default=(10.0, 50.0),
        description="Overshoot that the PI step must show, percent: low, high; 0 < low < high < 74",
        examples=[[8.0, 50.0]],
    )
    baseline: bool = Field(default=True, description="Record the set-point step with the old gains")
    verify: bool = Field(default=True, description="Record the set-point step with the new gains")
    plant: PlantModel | None = Field(default=None, description="Plant to rehearse on; only with dry_run")
    requested_by: str = Field(default="api", max_length=100, description="Who asks", examples=["night shift"])

    @model_validator(mode="after")
    def _known_method(self) -> Self:
        if self.method != PROCEDURE and self.method not in METHODS:
            raise ValueError(f"method must be one of {PROCEDURE}, {', '.join(METHODS)}, not {self.method!r}")
        if self.model_from == "record" and self.start in ("estimate", "optimise"):
            raise ValueError(f"model_from=record needs the step of stage zn_pi; the start is {self.start}")
        try:
            METHODS[rule_of(self.method)].checked(self.method_options)
        except Refused as refused:
            raise ValueError(refused.detail) from refused
        return self

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed = {
            "relay": (),
            "zn_pi": ("Ku", "Pu_s"),
            "estimate": ("Kp", "Ti_s", "overshoot_pct"),
            "optimise": ("model",),
        }[self.start]
        missing = [name for name in needed if getattr(self, name) is None]
        if missing:
            raise ValueError(f"start={self.start} needs {', '.join(missing)}")
        low, high = self.overshoot_window_pct
        if not low < high:
            raise ValueError(f"overshoot_window_pct: {low:g} must be less than {high:g}")
        if self.plant is not None and not self.dry_run:
            raise ValueError("plant is for a dry run only")
        return self


def within(loop: LoopConfig, request: RetuneRequest) -> LoopConfig:
    """The loop with the limits of this job: a request may narrow what the file permits, never widen it."""
    problems = []
    limits = {}
    for name, unit in (("mv", "%"), ("pv", loop.pv_unit)):
        allowed = getattr(loop, f"{name}_limits")
        low, high = getattr(request, f"{name}_low"), getattr(request, f"{name}_high")
        low, high = allowed.low if low is None else low, allowed.high if high is None else high
        if low < allowed.low or high > allowed.high:
            problems.append(
                f"{name} limits {low:g}..{high:g} {unit} are wider than {allowed.low:g}..{allowed.high:g} as configured"
            )
        if not low < high:
            problems.append(f"{name}_low {low:g} must be less than {name}_high {high:g} {unit}")
        limits[f"{name}_limits"] = allowed.model_copy(update={"low": low, "high": high})
    deviation = request.sp_deviation or loop.sp_deviation
    if deviation > loop.sp_deviation:
        problems.append(f"sp_deviation {deviation:g} is more than the configured {loop.sp_deviation:g} {loop.pv_unit}")
    if 2 * deviation > limits["pv_limits"].high - limits["pv_limits"].low and not problems:
        problems.append(f"sp_deviation {deviation:g} {loop.pv_unit} needs at least twice that between the PV limits")
    if problems:
        raise BadLimits("; ".join(problems))
    return loop.model_copy(update={**limits, "sp_deviation": deviation})
