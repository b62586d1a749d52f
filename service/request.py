"""What may be asked of a retune, and how it combines with the loop's configuration."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from loopwright.service.config import LoopConfig
from loopwright.service.plausible import (
    Finite,
    Gain,
    Implausible,
    NotNegative,
    Positive,
    Size,
    Time,
    check_damping,
    check_dead_time,
    check_model,
    check_option,
    check_step,
)
from loopwright.tuning.fast.procedure import FAST
from loopwright.tuning.five_stage.procedure import PROCEDURE, rule_of
from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction
from loopwright.tuning.reasons import Refused
from loopwright.tuning.rules.registry import METHODS

Percent = Annotated[float, Field(gt=0, lt=74, allow_inf_nan=False)]
MIN_AMPLITUDE_PCT = 1e-3
"""Of the relay: less is not to be told from nothing by a REAL32 of some ten percent."""


class BadLimits(ValueError):
    """The limits asked for contradict each other or the loop's configuration."""


class ProcessModel(BaseModel):
    """K exp(-L s) / (T s + 1), or with zeta K exp(-L s) / (T^2 s^2 + 2 zeta T s + 1)."""

    model_config = ConfigDict(extra="forbid")

    K: Finite = Field(description="Static gain, PV units per MV unit (percent)", examples=[0.8])
    T_s: Time = Field(description="Time constant, s; of second order 1/(natural frequency)", examples=[3.0])
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
        if self.zeta is not None:
            check_damping(self.zeta)
        plant = self.plant()
        check_model(plant.num, plant.den, plant.L)
        return self


class _Coefficients(BaseModel):
    model_config = ConfigDict(extra="forbid")

    num: list[Finite] = Field(min_length=1, max_length=12, description="Numerator", examples=[[3.0, 2.0]])
    den: list[Finite] = Field(min_length=1, max_length=12, description="Denominator", examples=[[3.0, 4.0, 1.0]])
    dead_time_s: NotNegative = Field(default=0.0, description="Dead time, s", examples=[1.0])

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        check_model(self.num, self.den, self.dead_time_s)
        return self


class TransferModel(_Coefficients):
    """num(s)/den(s) exp(-dead_time_s s), coefficients by falling powers of s, PV units over MV percent."""

    def plant(self) -> TransferFunction:
        return TransferFunction(tuple(self.num), tuple(self.den), self.dead_time_s)

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        self.plant()
        return self


class PlantModel(_Coefficients):
    """A transfer function for a dry run, coefficients by falling powers of s, deviation variables."""

    noise_std: Size = Field(default=0.0, description="Standard deviation of the PV noise, PV units", examples=[0.0])
    seed: int = Field(default=1, ge=0, le=2**53, description="Seed of the noise", examples=[1])
    sample_time_s: Time | None = Field(default=None, description="Sampling period, s", examples=[0.1])


class Bounds(BaseModel):
    """What the test may do; at most what loops.yaml permits."""

    sp_deviation: Positive | None = Field(
        default=None, description="Permitted set-point step, PV units; at most the loop's own", examples=[2.0]
    )
    mv_low: Finite | None = Field(default=None, description="Lowest MV during the test, percent", examples=[20.0])
    mv_high: Finite | None = Field(default=None, description="Highest MV during the test, percent", examples=[80.0])
    pv_low: Finite | None = Field(default=None, description="Abort below this PV, PV units", examples=[40.0])
    pv_high: Finite | None = Field(default=None, description="Abort above this PV, PV units", examples=[60.0])
    max_time_s: Time | None = Field(
        default=None,
        description="Budget of plant time, s; by default 100 times the loop's T95 for fast, 500 times for five-stage",
        examples=[3600.0],
    )


class FastWishes(BaseModel):
    """Options of method fast."""

    ms: Annotated[float, Field(ge=1.2, le=2.0, allow_inf_nan=False)] = Field(
        default=1.6, description="fast: largest peak of the sensitivity: 1.2 robust .. 1.6 .. 2.0 fast", examples=[1.4]
    )
    derivative: bool = Field(default=False, description="fast: a PID, where a derivative pays")
    amplitude_pct: Positive | None = Field(
        default=None,
        description="fast: MV under the relay goes so far up, and half as far down, percent; by default half of what "
        "the limits of MV allow, adapted after the first wave",
        examples=[10.0],
    )
    careful: bool = Field(default=False, description="fast: at least six switches of the relay, not four")


class FiveStageWishes(BaseModel):
    """Options of the five-stage experiment, which the rules of GET /methods share."""

    method_options: dict[str, bool | float | str] = Field(
        default_factory=dict,
        description="Options of a method of GET /methods, by name",
        examples=[{"lambda_s": 12.0}],
    )
    model_from: Literal["overshoot", "record"] | None = Field(
        default=None,
        description="Model for the method: the estimate from the overshoot, or one identified from the set-point step; "
        "by default the first for five-stage, the second for the rules if it explains the step",
    )
    Ku: Gain | None = Field(
        default=None, description="Ultimate gain, MV percent per PV unit, for start=zn_pi", examples=[2.05]
    )
    Pu_s: Time | None = Field(default=None, description="Ultimate period, s, for start=zn_pi", examples=[3.32])
    Kp: Gain | None = Field(
        default=None, description="ISA gain of the recorded PI step, MV percent per PV unit", examples=[0.9]
    )
    Ti_s: Time | None = Field(default=None, description="Integral time of the recorded PI step, s", examples=[2.8])
    overshoot_pct: Positive | None = Field(
        default=None, description="Overshoot of the recorded PI step, percent, for start=estimate", examples=[25.0]
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


STARTS = {"fast": ("relay", "design"), "five-stage": ("relay", "zn_pi", "estimate", "optimise")}


class RetuneRequest(FiveStageWishes, FastWishes, Bounds):
    """Options of a retune; what is left out comes from the loop's configuration."""

    model_config = ConfigDict(extra="forbid")

    method: str = Field(
        default=FAST,
        description="fast: one short relay record, fitted as a whole, the best gains for the Ms asked. five-stage: the "
        "procedure of the paper with its own optimisation. Any of GET /methods: the experiment of five-stage, gains by "
        "that rule",
        json_schema_extra={"enum": [FAST, PROCEDURE, *METHODS]},
    )
    start: Literal["relay", "zn_pi", "estimate", "optimise", "design"] = Field(
        default="relay",
        description="Stage to enter at; what earlier stages would have found is then typed in. fast: relay, design; "
        "five-stage and the rules: relay, zn_pi, estimate, optimise",
    )
    model: ProcessModel | TransferModel | None = Field(
        default=None,
        description="Model for start=design, or (K, T_s, L_s) for start=optimise; in a dry run without `plant` the "
        "plant itself",
    )
    baseline: bool | None = Field(
        default=None,
        description="Record the set-point step with the old gains: five-stage does by default; fast never does",
    )
    verify: bool = Field(default=True, description="Record the set-point step with the new gains")
    propose_anyway: bool = Field(
        default=False,
        description="Propose new gains also where nothing asked for gets better by more than 5 %; without it such a "
        "job ends as no_gain, the present gains are kept, and the new ones are not tried on the loop",
    )
    dry_run: bool = Field(
        default=False,
        description="Rehearse in memory; the loop is not touched. On the plant given, else on the last model found on "
        "the loop, else on a guess; the job says which",
    )
    plant: PlantModel | None = Field(default=None, description="Plant to rehearse on; only with dry_run")
    requested_by: str = Field(default="api", max_length=100, description="Who asks", examples=["night shift"])

    @property
    def fast(self) -> bool:
        return self.method == FAST

    def asked(self) -> dict[str, Any]:
        """As JSON, without the other procedure's options."""
        foreign = FiveStageWishes if self.fast else FastWishes
        return self.model_dump(mode="json", exclude_none=True, exclude=set(foreign.model_fields))

    @model_validator(mode="after")
    def _known_method(self) -> Self:
        if self.fast:
            return self
        if self.method != PROCEDURE and self.method not in METHODS:
            raise ValueError(f"method must be one of {FAST}, {PROCEDURE}, {', '.join(METHODS)}, not {self.method!r}")
        if self.model_from == "record" and self.start in ("estimate", "optimise"):
            raise ValueError(f"model_from=record needs the step of stage zn_pi; the start is {self.start}")
        try:
            method = METHODS[rule_of(self.method)]
            method.checked(self.method_options)
            for name, value in self.method_options.items():
                check_option(name, method.options[name].unit, value)
        except Refused as refused:
            raise ValueError(refused.detail) from refused
        return self

    @model_validator(mode="after")
    def _of_the_method(self) -> Self:
        """Options of one procedure say nothing to the other: better refused than ignored."""
        if self.fast:
            foreign = _given(self, FiveStageWishes) + ["baseline"] * bool(self.baseline)
            foreign += ["start"] * (self.start not in STARTS[FAST])
            if foreign:
                add = "" if "method" in self.model_fields_set else ', which is used unless a "method" is named'
                raise ValueError(
                    f"{', '.join(foreign)}: of the five-stage experiment, not of fast{add}; "
                    'add "method": "five-stage" (or a rule of GET /methods), or leave it out'
                )
            return self
        foreign = _given(self, FastWishes) + ["start"] * (self.start not in STARTS[PROCEDURE])
        if foreign:
            raise ValueError(f'{", ".join(foreign)}: of "method": "fast", not of {self.method}')
        if self.start == "optimise" and isinstance(self.model, TransferModel):
            raise ValueError(f"{self.method} takes a model of the form K, T_s, L_s, perhaps with zeta")
        return self

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed = {
            "relay": (),
            "zn_pi": ("Ku", "Pu_s"),
            "estimate": ("Kp", "Ti_s", "overshoot_pct"),
            "optimise": ("model",),
            "design": ("model",),
        }[self.start]
        missing = [name for name in needed if getattr(self, name) is None]
        if missing:
            raise ValueError(f"start={self.start} needs {', '.join(missing)}")
        low, high = self.overshoot_window_pct
        if not low < high:
            raise ValueError(f"overshoot_window_pct: {low:g} must be less than {high:g}")
        if self.plant is not None and not self.dry_run:
            raise ValueError("plant is for a dry run only")
        if self.fast and self.start == "relay" and self.model is not None and not self.dry_run:
            raise ValueError("model is for start=design, or for a dry run: the relay finds its own")
        return self


def _given(request: BaseModel, options: type[BaseModel]) -> list[str]:
    """Those of the options that are not left at their default."""
    fields = options.model_fields.items()
    return [name for name, field in fields if getattr(request, name) != field.get_default(call_default_factory=True)]


def within(loop: LoopConfig, request: RetuneRequest) -> LoopConfig:
    """The loop with the limits of this job: a request may narrow what the file permits, never widen it.

    Raises BadLimits.
    """
    narrowed, problems = narrow(loop, request)
    if problems:
        raise BadLimits("; ".join(problems))
    return narrowed


def narrow(loop: LoopConfig, request: RetuneRequest) -> tuple[LoopConfig, list[str]]:
    """The loop with the limits of this job, and what is wrong with those asked for; where that is something, the file's
    own stay."""
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
    mv, amplitude = limits["mv_limits"], request.amplitude_pct
    if amplitude is not None and 1.5 * amplitude > mv.high - mv.low and not problems:
        problems.append(
            f"a relay of amplitude_pct {amplitude:g} needs {1.5 * amplitude:g} % of MV between its limits, "
            f"there are {mv.high - mv.low:g} %"
        )
    if amplitude is not None and amplitude < MIN_AMPLITUDE_PCT:
        problems.append(f"a relay of amplitude_pct {amplitude:g} moves nothing; at least {MIN_AMPLITUDE_PCT:g} %")
    deviation = request.sp_deviation or loop.sp_deviation
    if deviation > loop.sp_deviation:
        problems.append(f"sp_deviation {deviation:g} is more than the configured {loop.sp_deviation:g} {loop.pv_unit}")
    if 2 * deviation > limits["pv_limits"].high - limits["pv_limits"].low and not problems:
        problems.append(f"sp_deviation {deviation:g} {loop.pv_unit} needs at least twice that between the PV limits")
    try:
        check_step(deviation, limits["pv_limits"].low, limits["pv_limits"].high)
        check_dead_time(_given_dead_time_s(request), loop.t95_s)  # here, where it costs no job and no process
    except Implausible as error:
        problems.append(str(error))
    if problems:
        return loop, problems
    return loop.model_copy(update={**limits, "sp_deviation": deviation}), []


def _given_dead_time_s(request: RetuneRequest) -> float:
    """Of the plant that a dry run is to be on; 0 where none is given."""
    if not request.dry_run:
        return 0.0
    if request.plant is not None:
        return request.plant.dead_time_s
    return request.model.plant().L if request.model is not None else 0.0
