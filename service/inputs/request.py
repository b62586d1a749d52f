"""Requests for a retune, one class for each kind of method, and their limits within the loop's configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    Discriminator,
    Field,
    JsonValue,
    PrivateAttr,
    TypeAdapter,
    model_validator,
)

from loopwright.service.errors import RemoteSetpoint
from loopwright.service.inputs.config import DirectionName, ExcitationName, LoopConfig, PermittedTest
from loopwright.service.inputs.model_json import ModelForm, parse_model
from loopwright.service.inputs.plausible import (
    Finite,
    Gain,
    Implausible,
    NotNegative,
    Positive,
    SetpointWeight,
    Size,
    Time,
    check_dead_time,
    check_model,
    check_option,
    check_step,
)
from loopwright.service.inputs.validation import STRICT, Whole, branch, branch_of, did_you_mean
from loopwright.tuning.experiments.primitives import Directions
from loopwright.tuning.experiments.step_limits import not_kept
from loopwright.tuning.fast.design.design import MAX_WEIGHT, Aim, DesignSpec
from loopwright.tuning.fast.design.options import DesignOptions
from loopwright.tuning.fast.excitation_choice import chosen_stages
from loopwright.tuning.fast.known_plant.design_trial import trial_stages
from loopwright.tuning.fast.pulses.procedure import SETPOINT, setpoint_stages
from loopwright.tuning.fast.record import Excitation
from loopwright.tuning.fast.relay.procedure import FAST, SWITCHES, FastOptions
from loopwright.tuning.five_stage.procedure import PROCEDURE, Options, rule_of, stages_of
from loopwright.tuning.models import FOPDT, SOPDT, Model
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Refused
from loopwright.tuning.rules.registry import METHODS

if TYPE_CHECKING:
    RuleName = str
else:
    RuleName = Literal[tuple(METHODS)]

OBSERVE = "observe"
"""The method that starts no job, see `service.observing`."""
Percent = Annotated[float, Field(gt=0, lt=74, allow_inf_nan=False)]
MIN_AMPLITUDE_PCT = 1e-3
"""Minimum amplitude of the relay, percent. A REAL32 of some ten percent hardly resolves a smaller one."""


class BadLimits(ValueError):
    """The limits of a request contradict each other or the loop's configuration."""


class PlantModel(BaseModel):
    """A transfer function to rehearse on, in deviation variables. Coefficients are by falling powers of s. In place of
    num, den and dead_time_s, K, T and L and the other forms of a model are taken, too."""

    model_config = STRICT

    num: list[Finite] = Field(min_length=1, max_length=12, description="Numerator", examples=[[3.0, 2.0]])
    den: list[Finite] = Field(min_length=1, max_length=12, description="Denominator", examples=[[3.0, 4.0, 1.0]])
    dead_time_s: NotNegative = Field(default=0.0, description="Dead time, s", examples=[1.0])
    noise_std: Size = Field(default=0.0, description="Standard deviation of the PV noise, PV units", examples=[0.0])
    seed: Whole = Field(default=1, ge=0, le=2**53, description="Seed of the noise", examples=[1])
    sample_time_s: Time | None = Field(default=None, description="Sampling period, s", examples=[0.1])

    @model_validator(mode="before")
    @classmethod
    def _any_form(cls, data: object) -> object:
        """Takes a model in any form, such as K, T, L, in place of num, den and dead_time_s."""
        if isinstance(data, Mapping):
            beside = {name: value for name, value in data.items() if name in ("noise_std", "seed", "sample_time_s")}
            form: object = {name: value for name, value in data.items() if name not in beside}
            if data.keys() <= {"num", "den", "dead_time_s", *beside}:
                return data
        elif isinstance(data, str):
            form, beside = data, {}
        else:
            return data
        model = parse_model(form)
        return {"num": list(model.num), "den": list(model.den), "dead_time_s": model.L, **beside}

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        check_model(self.num, self.den, self.dead_time_s)
        return self


class Bounds(BaseModel):
    """Limits of the test, within those of loops.yaml."""

    sp_deviation: Positive | None = Field(
        default=None, description="Permitted set-point step, PV units; at most the loop's own", examples=[2.0]
    )
    mv_low: Finite | None = Field(default=None, description="Lowest MV during the test, percent", examples=[20.0])
    mv_high: Finite | None = Field(default=None, description="Highest MV during the test, percent", examples=[80.0])
    pv_low: Finite | None = Field(default=None, description="Abort below this PV, PV units", examples=[40.0])
    pv_high: Finite | None = Field(default=None, description="Abort above this PV, PV units", examples=[60.0])
    max_time_s: Time | None = Field(
        default=None,
        description="Budget of plant time, s; by default 100 times the loop's T95 for fast and setpoint, 500 times for "
        "five-stage",
        examples=[3600.0],
    )
    directions: DirectionName | None = Field(
        default=None,
        description="To which sides of its rest the set-point is moved, within those of loops.yaml; up and down leave "
        "the relay out",
        examples=["up"],
    )
    sp_rate_max_per_s: Positive | None = Field(
        default=None,
        description="Largest rate of the set-point, PV units per s of plant time; at most the loop's own",
        examples=[0.02],
    )


class _Retune(Bounds):
    """The options that every method has."""

    model_config = STRICT

    model: ModelForm | None = Field(
        default=None,
        description="Model for start=design, or first- or second-order model for start=optimise; in a dry run without "
        "`plant` it is the plant",
    )
    verify: bool = Field(default=True, description="Record a set-point step with the new gains")
    propose_anyway: bool = Field(
        default=False,
        description="Propose new gains even if they are not better than the present ones by more than 5 %; otherwise "
        "such a job ends as no_gain, and the new gains are not tested on the loop",
    )
    dry_run: bool = Field(
        default=False,
        description="Rehearse in memory without touching the loop, on the plant given, else on the last model found on "
        "the loop, else on a guess; the job shows which",
    )
    plant: PlantModel | None = Field(default=None, description="Plant to rehearse on, only with dry_run")
    by: str | None = Field(
        default=None,
        max_length=100,
        description="Name of the person who requests the retune. The default is the name of the key; a test of the "
        "loop needs it where no key names the caller",
        examples=["night shift"],
    )

    def asked(self) -> dict[str, JsonValue]:
        """The given options as a JSON object."""
        return self.model_dump(mode="json", exclude_none=True)

    # What the planning of a retune asks of each method.

    def stages(self, excitations: tuple[Excitation, ...]) -> tuple[str, ...]:
        """The stages that the retune may have, in their order. excitations: what may move the loop, see below."""
        raise NotImplementedError

    @property
    def chooses_excitation(self) -> bool:
        """Whether the loop may be moved in several ways."""
        return False

    @property
    def pulses_setpoint(self) -> bool:
        """Whether the set-point is moved by pulses, whatever else the loop permits."""
        return False

    @property
    def known_model(self) -> Model | None:
        """The model on which gains are designed without an experiment."""
        return None

    @property
    def fits_record(self) -> bool:
        """Whether a model is fitted to the whole record of an experiment."""
        return False

    @property
    def relay_amplitude_pct(self) -> float | None:
        """The step of MV up under the relay that was asked for, percent."""
        return None

    @property
    def adapts_relay(self) -> bool:
        """Whether the relay is as large as PV's answer to it permits."""
        return False

    @property
    def largest_weight(self) -> float | None:
        """The largest set-point weight that was asked for."""
        return None

    @property
    def design(self) -> DesignSpec | None:
        """What the gains are designed for; None where a rule gives them."""
        return None

    @property
    def entered_Pu_s(self) -> float | None:
        """The ultimate period that was entered, s."""
        return None

    @property
    def overshoot_asked_pct(self) -> tuple[float, float]:
        """The smallest and the largest overshoot of a set-point step that is looked for, percent."""
        return 0.0, 0.0

    @classmethod
    def _foreign(cls, data: Mapping[str, object]) -> list[str]:
        """The names in `data` that only another method knows."""
        return [name for name in cls._of_another() if name in data]

    @classmethod
    def _of_another(cls) -> list[str]:
        raise NotImplementedError

    @classmethod
    def _not_mine(cls, foreign: str, method: object) -> str:
        raise NotImplementedError

    @model_validator(mode="before")
    @classmethod
    def _own_options(cls, data: object) -> object:
        """Refuses an option of another method, which would otherwise be ignored."""
        if not isinstance(data, Mapping):
            return data
        foreign = cls._foreign(data)
        if foreign:
            given = "" if "method" in data else ', which is used unless a "method" is named'
            why = cls._not_mine(", ".join(foreign), f"{data.get('method', FAST)}{given}")
            raise ValueError(f"{why}; its options are {', '.join(cls.model_fields)}")
        unknown = [str(name) for name in data if name not in cls.model_fields]
        if unknown:
            known = list(cls.model_fields)
            why = f"{', '.join(unknown)}: no option of {data.get('method', FAST)}{did_you_mean(unknown[0], known)}"
            raise ValueError(f"{why}; its options are {', '.join(known)}")
        return data

    @model_validator(mode="after")
    def _rehearsed(self) -> Self:
        if self.plant is not None and not self.dry_run:
            raise ValueError("plant is for a dry run only")
        return self


class DesignRetune(_Retune):
    """The options of the methods that fit a model to one record and design the gains on it."""

    method: str
    Ms: Annotated[float, Field(ge=1.2, le=2.0, allow_inf_nan=False)] = Field(
        default=1.6,
        description="Maximum sensitivity for which the gains are designed: 1.2 (robust) to 2.0 (fast)",
        examples=[1.4],
    )
    derivative: bool = Field(default=False, description="Design a PID where a derivative improves the loop")
    aim: Aim = Field(
        default=Aim.BALANCED,
        strict=False,
        description="What the gains, with the set-point weight b, are the best for under the Ms asked for, by the "
        "integral of the error (IAE). balanced: set-point steps and load disturbances alike; setpoint: set-point steps "
        "nine times as much; load: load disturbances alone; no_overshoot: as balanced, and PV overshoots a set-point "
        "step by at most 1 % on the model",
        examples=["no_overshoot"],
    )
    settling_s: Time | None = Field(
        default=None,
        description="Longest time from a set-point step until PV stays within 5 % of it, on the model, s. The gains "
        "are those for the smallest Ms that permits it, at most `Ms`; where none does, the job ends as not_possible "
        "and says what would",
        examples=[300.0],
    )
    mv_peak: Gain | None = Field(
        default=None,
        description="Largest change of MV after a set-point step, percent per PV unit of the step, on the model. Where "
        "the loop needs more, the job ends as not_possible and says how much",
        examples=[4.0],
    )
    noise_gain: Gain | None = Field(
        default=None,
        description="Largest immediate change of MV for a jump of PV, percent per PV unit: the gain of the controller "
        "for noise",
        examples=[2.0],
    )
    setpoint_weight_max: SetpointWeight | None = Field(
        default=None,
        description="Largest set-point weight b of the gains, 0 to 2. The default is that of loops.yaml, which a "
        "request may only lower; where loops.yaml names none, 1, as most controllers take no more",
        examples=[1.5],
    )

    def _design(self) -> dict[str, Any]:
        """The options of the design, as `DesignOptions` has them."""
        return {
            "Ms": self.Ms, "derivative": self.derivative, "aim": self.aim, "settling_s": self.settling_s,
            "mv_peak": self.mv_peak, "noise_gain": self.noise_gain, "setpoint_weight_max": self.setpoint_weight_max,
            "verify": self.verify, "propose_anyway": self.propose_anyway,
        }  # fmt: skip

    @property
    def options(self) -> DesignOptions:
        raise NotImplementedError

    @property
    def largest_weight(self) -> float | None:
        return self.setpoint_weight_max

    @property
    def design(self) -> DesignSpec:
        return self.options.spec()

    @classmethod
    def _of_another(cls) -> list[str]:
        return [name for name in FiveStages.model_fields if name not in FastRetune.model_fields]

    @classmethod
    def _not_mine(cls, foreign: str, method: object) -> str:
        return (
            f"{foreign}: of the five-stage experiment, not of {method}; "
            'add "method": "five-stage" (or a rule of GET /methods), or leave it out'
        )


class FastRetune(DesignRetune):
    """A retune by method fast: a model is fitted to a short relay test, and the gains are designed for the given Ms."""

    method: Literal["fast"] = Field(default="fast", description="Method fast, the default")
    start: Literal["relay", "design"] = Field(
        default="relay", description="First stage: relay, or design with a given model and without a relay test"
    )
    baseline: bool | None = Field(
        default=None, description="Must be false or left out: fast records no set-point step with the previous gains"
    )
    amplitude_pct: Positive | None = Field(
        default=None,
        description="Step of MV up under the relay, percent; the step down is half as large. The default is half of "
        "what the MV limits permit, adapted after the first period",
        examples=[10.0],
    )
    excitations: Annotated[tuple[ExcitationName, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None,
        description="What moves the loop, among what loops.yaml permits (test: excitations); the default is all of "
        "that. observe: where normal operation has shown the plant well enough, only the new gains are tried; "
        "setpoint: pulses under the present gains, in automatic; relay: the controller's relay. Each follows only "
        "where those before it tell too little. manual: of a loop in manual, pulses of its manual output and nothing "
        "else; in automatic it is left out",
        examples=[["setpoint"], ["observe", "setpoint"]],
    )
    min_switches: Literal[4, 6, 8, 10] | None = Field(
        default=None,
        description="Smallest number of switches of the relay after which its record is evaluated. The default is 4, "
        "and 6 where no step verifies the gains",
        examples=[6],
    )

    _options: FastOptions = PrivateAttr()

    @property
    def options(self) -> FastOptions:
        return self._options

    def stages(self, excitations: tuple[Excitation, ...]) -> tuple[str, ...]:
        return chosen_stages(excitations, self.verify) if self.chooses_excitation else trial_stages(self.verify)

    @property
    def chooses_excitation(self) -> bool:
        return self.start == "relay"

    @property
    def known_model(self) -> Model | None:
        return self.model.plant() if self.start == "design" and self.model is not None else None

    @property
    def fits_record(self) -> bool:
        return self.chooses_excitation

    @property
    def relay_amplitude_pct(self) -> float | None:
        return self.amplitude_pct

    @property
    def adapts_relay(self) -> bool:
        return self.amplitude_pct is None

    @classmethod
    def _foreign(cls, data: Mapping[str, object]) -> list[str]:
        return [
            *super()._foreign(data),
            *["baseline"] * (data.get("baseline") is True),
            *["start"] * (data.get("start") in FIVE_STAGE_STARTS and data["start"] != "relay"),
        ]

    @model_validator(mode="after")
    def _understood(self) -> Self:
        if self.baseline:
            raise ValueError(self._not_mine("baseline", FAST))
        if self.start == "design" and self.model is None:
            raise ValueError("start=design needs model")
        if self.start == "relay" and self.model is not None and not self.dry_run:
            raise ValueError("model is for start=design, or for a dry run: the relay finds its own")
        try:
            self._options = FastOptions(
                amplitude=self.amplitude_pct, min_switches=self.min_switches or SWITCHES[0], **self._design()
            )
        except Refused as refused:
            raise ValueError(refused.detail) from refused
        return self


class SetpointRetune(DesignRetune):
    """A retune by method setpoint: as fast, but the record is made by pulses of the set-point under the present gains.
    The loop stays in automatic all the time."""

    method: Literal["setpoint"] = Field(description="Method setpoint")

    _options: DesignOptions = PrivateAttr()

    @property
    def options(self) -> DesignOptions:
        return self._options

    def stages(self, excitations: tuple[Excitation, ...]) -> tuple[str, ...]:
        return setpoint_stages(self.verify)

    @property
    def pulses_setpoint(self) -> bool:
        return True

    @property
    def fits_record(self) -> bool:
        return True

    @model_validator(mode="after")
    def _understood(self) -> Self:
        if self.model is not None and not self.dry_run:
            raise ValueError("model is for a dry run: the pulses find their own; fast takes one with start=design")
        try:
            self._options = DesignOptions(**self._design())
        except Refused as refused:
            raise ValueError(refused.detail) from refused
        return self


FIVE_STAGE_STARTS = ("relay", "zn_pi", "estimate", "optimise")


class FiveStages(_Retune):
    """The options of the five-stage experiment, with any rule."""

    method: str
    start: Literal["relay", "zn_pi", "estimate", "optimise"] = Field(
        default="relay",
        description="First stage. The results of earlier stages must be given: Ku and Pu_s for zn_pi; Kp, Ti_s and "
        "overshoot_pct for estimate; model for optimise",
    )
    baseline: bool | None = Field(
        default=None, description="Record a set-point step with the previous gains; the default is true"
    )
    method_options: dict[str, bool | float | str] = Field(
        default_factory=dict,
        description="Options of a method of GET /methods, by name",
        examples=[{"lambda_s": 12.0}],
    )
    model_from: Literal["overshoot", "record"] | None = Field(
        default=None,
        description="Model for the method: overshoot estimates it from the overshoot, record identifies it from the "
        "set-point step. The default is overshoot for five-stage, and record for a rule if its model fits the step",
    )
    Ku: Gain | None = Field(
        default=None, description="Ultimate gain, MV percent per PV unit, for start=zn_pi", examples=[2.05]
    )
    Pu_s: Time | None = Field(default=None, description="Ultimate period, s, for start=zn_pi", examples=[3.32])
    Kp: Gain | None = Field(
        default=None,
        description="Proportional gain of the recorded PI step, ISA form, MV percent per PV unit",
        examples=[0.9],
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
        default=None, description="Factor by which Kp grows between attempts, above 1", examples=[1.5]
    )
    overshoot_window_pct: tuple[Percent, Percent] = Field(
        default=(10.0, 50.0),
        strict=False,
        description="Permitted overshoot of the PI step, percent: low, high; 0 < low < high < 74",
        examples=[[8.0, 50.0]],
        json_schema_extra={"items": {"type": "number"}},  # for readers of OpenAPI that know no prefixItems
    )

    _options: Options = PrivateAttr()

    @property
    def options(self) -> Options:
        return self._options

    def stages(self, excitations: tuple[Excitation, ...]) -> tuple[str, ...]:
        return stages_of(self.start, self._options.baseline, self.verify)

    @property
    def entered_Pu_s(self) -> float | None:
        return self.Pu_s

    @property
    def overshoot_asked_pct(self) -> tuple[float, float]:
        return self.overshoot_window_pct

    @classmethod
    def _of_another(cls) -> list[str]:
        return [name for name in FastRetune.model_fields if name not in cls.model_fields]

    @classmethod
    def _foreign(cls, data: Mapping[str, object]) -> list[str]:
        return [*super()._foreign(data), *["start"] * (data.get("start") == "design")]

    @classmethod
    def _not_mine(cls, foreign: str, method: object) -> str:
        return f'{foreign}: of "method": "fast", not of {method}'

    @model_validator(mode="after")
    def _understood(self) -> Self:
        model = self.model.plant() if self.model is not None else None
        known = model if isinstance(model, FOPDT | SOPDT) else None
        if self.start == "optimise" and model is not None and known is None:
            raise ValueError(f"{self.method} takes a model of the form K, T_s, L_s, perhaps with zeta")
        try:
            self._options = Options(
                start=self.start,
                Ku=self.Ku,
                Pu_s=self.Pu_s,
                Kp=self.Kp,
                Ti_s=self.Ti_s,
                overshoot_pct=self.overshoot_pct,
                model=known,
                k_source=self.k_source,
                kp_step_factor=self.kp_step_factor,
                overshoot_window_pct=self.overshoot_window_pct,
                baseline=self.baseline is not False,
                verify=self.verify,
                method=self.method,
                method_options=self.method_options,
                model_from=self.model_from,
                propose_anyway=self.propose_anyway,
            )
        except Refused as refused:
            raise ValueError(refused.detail) from refused
        options = METHODS[rule_of(self.method)].options
        for name, value in self.method_options.items():
            check_option(name, options[name].unit, value)
        return self


class FiveStageRetune(FiveStages):
    """A retune by the five-stage procedure with its own optimisation."""

    method: Literal["five-stage"]


def _named(value: object) -> object:
    if value == OBSERVE:
        raise ValueError("observe starts no job: ask GET /loops/TAG/observation?Ms=1.6 (loopwright observe TAG)")
    if not isinstance(value, str) or value not in METHODS:
        raise ValueError(f"method must be one of {FAST}, {SETPOINT}, {PROCEDURE}, {', '.join(METHODS)}, not {value!r}")
    return value


class RuleRetune(FiveStages):
    """A retune by the five-stage experiment with the gains of a rule of GET /methods."""

    method: Annotated[RuleName, BeforeValidator(_named)] = Field(description="Rule that computes the gains")


def by_method(fast: type, setpoint: type, five_stage: type, rule: type) -> Discriminator:
    """The discriminator of a union by method. The branch of the rules refuses an unknown method."""
    kinds = {FAST: fast, SETPOINT: setpoint, PROCEDURE: five_stage}

    def kind(data: object) -> str:
        method = data.get("method", FAST) if isinstance(data, Mapping) else getattr(data, "method", FAST)
        return branch_of(kinds.get(method, rule) if isinstance(method, str) else rule)

    return Discriminator(kind)


AnyRetune = FastRetune | SetpointRetune | FiveStageRetune | RuleRetune
RetuneRequest = Annotated[
    Annotated[FastRetune, branch(FastRetune)]
    | Annotated[SetpointRetune, branch(SetpointRetune)]
    | Annotated[FiveStageRetune, branch(FiveStageRetune)]
    | Annotated[RuleRetune, branch(RuleRetune)],
    by_method(FastRetune, SetpointRetune, FiveStageRetune, RuleRetune),
]
"""The options of a retune. The loop's configuration gives the defaults of limits; the default method is fast."""
_ADAPTER: TypeAdapter[AnyRetune] = TypeAdapter(RetuneRequest)


def retune_request(**options: object) -> AnyRetune:
    """The request with these options, named as in its JSON object. Raises pydantic.ValidationError."""
    return _ADAPTER.validate_python(options)


def within(loop: LoopConfig, request: RetuneRequest) -> LoopConfig:
    """The loop with the limits of the request, which may narrow those of the file, not widen them. Raises BadLimits."""
    narrowed, problems = narrow(loop, request)
    if problems:
        raise BadLimits("; ".join(problems))
    return narrowed


def excitations(loop: LoopConfig, request: RetuneRequest, mode: Mode = Mode.AUTOMATIC) -> tuple[Excitation, ...]:
    """What may move the loop during a retune by fast, in the order in which it is tried; empty where there is no such
    choice. A loop in manual is moved by pulses of its manual output alone, where they are permitted. A set-point that
    another controller moves is left alone where the relay is permitted. A dry run has no history of operation:
    `observe` is left out where something else is permitted.

    loop: the loop with the limits of the request.
    mode: the mode of the loop.
    """
    if not request.chooses_excitation:
        return ()
    permitted = loop.test.excitations
    if "manual" in permitted and (mode is Mode.MANUAL or permitted == ("manual",)):
        return (Excitation.MANUAL,)
    remote = loop.setpoint_from == "remote" and "relay" in permitted and not request.dry_run
    if remote:
        return (Excitation.RELAY,)
    tried = (Excitation.OBSERVE, Excitation.SETPOINT, Excitation.RELAY)
    found = tuple(each for each in tried if each in permitted)
    return found[1:] if request.dry_run and len(found) > 1 and found[0] is Excitation.OBSERVE else found


def wrong_mode(loop: LoopConfig, request: RetuneRequest, mode: Mode) -> str | None:
    """Why the retune cannot be made in this mode, with what to do; None where it can.

    loop: the loop with the limits of the request.
    """
    needed = Mode.MANUAL if Excitation.MANUAL in excitations(loop, request, mode) else Mode.AUTOMATIC
    if mode is needed:
        return None
    text = f"the controller is in mode {mode.name.lower()}, not {needed.name.lower()}"
    if needed is Mode.MANUAL:
        return f"{text}, and excitations permit nothing but pulses of the manual output"
    if mode is not Mode.MANUAL:
        return text
    if request.chooses_excitation and isinstance(request, FastRetune):
        asked = "" if request.excitations is None else ", and name manual among the excitations asked for"
        return f"{text}; to tune it in manual, permit manual in loops.yaml (test: excitations){asked}"
    return (
        f"{text}; in manual a loop is tuned by method fast alone, where loops.yaml permits manual (test: excitations)"
    )


def check_setpoint_source(loop: LoopConfig, request: RetuneRequest, mode: Mode | None = None) -> None:
    """Raises RemoteSetpoint where the request would move a set-point that another controller moves.

    loop: the loop with the limits of the request.
    mode: the mode of the loop; None where it is not known yet: a loop that may be in manual is then left for later.
    """
    tried = excitations(loop, request, Mode.MANUAL if mode is None else mode)
    pulses = request.pulses_setpoint or (tried and not {Excitation.RELAY, Excitation.MANUAL} & {*tried})
    if loop.setpoint_from == "operator" or not pulses or request.dry_run:
        return
    tag, outer = loop.tag, loop.outer_loop or "another controller"
    raise RemoteSetpoint(
        f"the set-point of {tag} comes from {outer} (setpoint_from: remote in loops.yaml): put {tag} to local "
        f"set-point, and set setpoint_from: operator for as long; or put {outer} in manual and retune by fast, which "
        "steps the set-point only to verify"
    )


def narrow(loop: LoopConfig, request: RetuneRequest) -> tuple[LoopConfig, list[str]]:
    """The loop with the limits of the request, and the errors in those limits. With an error the loop is unchanged."""
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
    mv = limits["mv_limits"]
    amplitude = request.relay_amplitude_pct
    if amplitude is not None and 1.5 * amplitude > mv.high - mv.low and not problems:
        problems.append(
            f"a relay of amplitude_pct {amplitude:g} needs {1.5 * amplitude:g} % of MV between its limits, "
            f"which are {mv.high - mv.low:g} % apart"
        )
    if amplitude is not None and amplitude < MIN_AMPLITUDE_PCT:
        problems.append(f"a relay of amplitude_pct {amplitude:g} moves nothing; at least {MIN_AMPLITUDE_PCT:g} %")
    test, refused = _narrow_test(loop, request)
    problems += refused
    highest = loop.setpoint_weight_max
    try:
        highest = permitted_weight(loop, request.largest_weight)
    except BadLimits as error:
        problems.append(str(error))
    deviation = request.sp_deviation or loop.sp_deviation
    if deviation > loop.sp_deviation:
        problems.append(
            f"sp_deviation {deviation:g} is more than the configured {loop.sp_deviation:g} {loop.pv_unit}: a request "
            "may narrow what loops.yaml permits, not widen it"
        )
    if 2 * deviation > limits["pv_limits"].high - limits["pv_limits"].low and not problems:
        problems.append(f"sp_deviation {deviation:g} {loop.pv_unit} needs at least twice that between the PV limits")
    try:
        check_step(deviation, limits["pv_limits"].low, limits["pv_limits"].high)
        check_dead_time(_given_dead_time_s(request), loop.t95_s)  # checked before a job and a process are started
    except Implausible as error:
        problems.append(str(error))
    if problems:
        return loop, problems
    permitted = {"sp_deviation": deviation, "test": test, "setpoint_weight_max": highest}
    return loop.model_copy(update={**limits, **permitted}), []


def permitted_weight(loop: LoopConfig, asked: float | None) -> float | None:
    """The largest set-point weight of gains for this loop; None where neither file nor request names one.

    asked: that of a request.
    Raises BadLimits where the file permits less.
    """
    named = loop.setpoint_weight_max
    if asked is not None and named is not None and asked > named:
        raise BadLimits(
            f"setpoint_weight_max {asked:g} is more than the {named:g} of loops.yaml: ask for at most {named:g}, or "
            f"permit more in loops.yaml (up to {MAX_WEIGHT:g}) where the controller takes it"
        )
    return named if asked is None else asked


def _narrow_test(loop: LoopConfig, request: RetuneRequest) -> tuple[PermittedTest, list[str]]:
    """What the test may do by the request, and the errors in that."""
    test, problems = _narrow_moves(loop, request)
    if not isinstance(request, FastRetune) or request.start == "design":
        return test, problems + _not_kept(test, request)
    permitted = loop.test.excitations
    asked = permitted if request.excitations is None else request.excitations
    if test.directions != "both" and "relay" in permitted:  # left out where it is not asked for
        words = f"directions {test.directions}: a relay moves PV to both sides of its rest"
        if request.excitations is not None and "relay" in request.excitations:
            problems.append(f"{words}; ask for excitations without it, or leave directions out")
        elif permitted == ("relay",):
            problems.append(f"{words}, and loops.yaml permits no other excitation (test: excitations)")
        else:
            asked = tuple(each for each in asked if each != "relay")
    if problems:
        return loop.test, problems
    more = [each for each in asked if each not in permitted]
    if more:
        words = f"loops.yaml permits {', '.join(permitted)} (test: excitations)"
        return loop.test, [f"excitations: {', '.join(more)} is asked for, {words}"]
    of_relay = [name for name in ("amplitude_pct", "min_switches") if getattr(request, name)]
    if of_relay and "relay" not in asked:
        return loop.test, [f"{', '.join(of_relay)}: of a relay, which is not among the excitations {', '.join(asked)}"]
    if asked == ("observe",) and not request.verify:
        words = "gains from operation are proposed only after the step under them"
        return loop.test, [f"verify: false, with observe as the only excitation: {words}; leave verify out"]
    return test.model_copy(update={"excitations": asked}), []


def _narrow_moves(loop: LoopConfig, request: RetuneRequest) -> tuple[PermittedTest, list[str]]:
    """To where and how fast the test may move the set-point by the request, and the errors in that."""
    test, unit, problems = loop.test, loop.pv_unit, []
    directions = request.directions or test.directions
    if test.directions not in ("both", directions):
        problems.append(
            f"directions {directions} is asked for, loops.yaml permits {test.directions} (test: directions)"
        )
    rate, permitted = request.sp_rate_max_per_s, test.sp_rate_max_per_s
    if rate is not None and permitted is not None and rate > permitted:
        problems.append(f"sp_rate_max_per_s {rate:g} is more than the configured {permitted:g} {unit}/s")
    return test.model_copy(update={"directions": directions, "sp_rate_max_per_s": rate or permitted}), problems


def _not_kept(test: PermittedTest, request: RetuneRequest) -> list[str]:
    """What a retune by steps of the set-point cannot keep, in sentences; empty for one by pulses."""
    if request.pulses_setpoint:
        return []
    mirrored = request.known_model is not None
    return not_kept(Directions(test.directions), test.sp_rate_max_per_s or math.inf, request.stages(()), mirrored)


def _given_dead_time_s(request: RetuneRequest) -> float:
    """The dead time of the plant given for a dry run, s; 0 if no plant is given."""
    if not request.dry_run:
        return 0.0
    if request.plant is not None:
        return request.plant.dead_time_s
    return request.model.plant().L if request.model is not None else 0.0
