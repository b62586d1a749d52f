"""Process models as JSON objects, in five forms that a user can type, and the conversion back.

{"K": 2, "T_s": 10, "L_s": 3}                            first order with dead time
{"K": 2, "T1_s": 10, "T2_s": 4, "L_s": 3}                second order, two real lags
{"K": 2, "T_s": 6, "zeta": 0.5, "L_s": 3}                second order by its damping ratio; complex poles too
{"K": 0.1, "L_s": 3, "integrating": true, "T_s": 5}      integrating; T_s, a lag, may be left out
{"num": [2], "den": [10, 1], "dead_time_s": 3}           transfer function, highest power of s first

The unit may be left out of the names, {"K": 2, "T": 10, "L": 3}, and so may the JSON of the first four: K=2,T=10,L=3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    Discriminator,
    Field,
    JsonValue,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from loopwright.service.inputs.plausible import MAX_TIME_S, MIN_TIME_S, Implausible, check_damping, check_model
from loopwright.service.inputs.validation import STRICT, branch, branch_of, did_you_mean, lines
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction

MAX_COEFFICIENTS = 12
_BESIDE = frozenset(
    {"name", "sample_time_s", "t95_s", "noise_std", "seed", "mv_limits", "sp_deviation", "gains", "reverse_acting"}
)
"""Fields of a plant file of `loopwright rehearse` that do not belong to the model."""


class BadModel(ValueError):
    """The input is no valid model. The message names the quantity, its value, and what is accepted."""


_WITH_UNIT = {"T": "T_s", "T1": "T1_s", "T2": "T2_s", "L": "L_s"}
_TEXT = "such as K=2,T=10,L=3"


def named(given: object) -> object:
    """The object with the names that the forms have, of one whose names lack the unit, or of a text such as
    K=2,T=10,L=3. Anything else is returned as it is. Raises ValueError for a text that is none."""
    data = _of_text(given) if isinstance(given, str) else given
    if not isinstance(data, Mapping):
        return data
    full = {"L": "dead_time_s", "L_s": "dead_time_s"} if "num" in data or "den" in data else _WITH_UNIT
    return {name if full.get(name, name) in data else full.get(name, name): value for name, value in data.items()}


def _of_text(text: str) -> dict[str, object]:
    found: dict[str, object] = {}
    for part in text.replace(";", ",").split(","):
        name, equals, value = (each.strip() for each in part.partition("="))
        if name == "integrating" and value in ("", "true"):
            found[name] = True
        elif not equals or not name:
            raise ValueError(f"{_shown(text)} is no model: a text {_TEXT} is expected, or a JSON object; {accepted()}")
        else:
            try:
                number = float(value)
            except ValueError:
                raise ValueError(f"{name} must be a finite number, not {_shown(value)}") from None
            if name in found:
                raise ValueError(f"{name} is given twice: leave one of them out")
            found[name] = number
    return found


def finite(value: object, name: str) -> float:
    """The value as a finite float. Raises ValueError for anything but a number, also for a bool."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    raise ValueError(f"{name} must be a finite number, not {_shown(value)}")


def _gain(value: object, info: ValidationInfo) -> float:
    if (number := finite(value, _name(info))) == 0.0:
        raise ValueError(f"{info.field_name} must not be 0: PV would not answer MV")
    return number


def _positive(value: object, info: ValidationInfo) -> float:
    if (number := finite(value, _name(info))) <= 0.0:
        unit = " (s)" if _name(info).endswith("_s") else ""
        raise ValueError(f"{info.field_name} must be a number > 0{unit}, not {number:g}")
    return number


def _time_constant(value: object, info: ValidationInfo) -> float:
    return _in_seconds(_positive(value, info), info, MIN_TIME_S)


def _dead_time(value: object, info: ValidationInfo) -> float:
    if (number := finite(value, _name(info))) < 0.0:
        raise ValueError(f"{info.field_name} must be a number >= 0 (s), not {number:g}")
    return _in_seconds(number, info, 0.0)


def _in_seconds(number: float, info: ValidationInfo, minimum: float) -> float:
    if not minimum <= number <= MAX_TIME_S:
        raise Implausible(
            f"{info.field_name} {number:.3g} s is not plausible; permitted are {minimum:g} to {MAX_TIME_S:g} s: "
            "check that times are in seconds"
        )
    return number


def _coefficients(value: object, info: ValidationInfo) -> list[float]:
    if not isinstance(value, list | tuple) or not 1 <= len(value) <= MAX_COEFFICIENTS:
        raise ValueError(f"{info.field_name} must be a list of 1 to {MAX_COEFFICIENTS} numbers, not {_shown(value)}")
    return [finite(each, f"{info.field_name}[{i}]") for i, each in enumerate(value)]


def _integrates(value: object) -> object:
    if value is not True:
        raise ValueError(f"integrating must be true, or be left out, not {_shown(value)}")
    return value


def _name(info: ValidationInfo) -> str:
    return info.field_name or "the value"


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


Gain = Annotated[
    float,
    BeforeValidator(_gain),
    Field(
        description="Static gain, PV units per MV unit (on a loop: per percent), not 0, either sign",
        examples=[0.8],
        json_schema_extra={"not": {"const": 0}},
    ),
]
TimeConstant = Annotated[float, Field(ge=MIN_TIME_S, le=MAX_TIME_S), BeforeValidator(_time_constant)]
Lag = Annotated[float, Field(ge=0, le=MAX_TIME_S), BeforeValidator(_dead_time)]
DeadTime = Annotated[Lag, Field(description="Dead time, s", examples=[1.0])]
Coefficients = Annotated[
    list[Annotated[float, Field(allow_inf_nan=False)]],
    Field(min_length=1, max_length=MAX_COEFFICIENTS),
    BeforeValidator(_coefficients),
]


class _Form(BaseModel):
    model_config = STRICT

    def plant(self) -> Model:
        """The model as an object of `tuning`."""
        raise NotImplementedError

    @model_validator(mode="before")
    @classmethod
    def _quantities(cls, data: object) -> object:
        if isinstance(data, cls):
            return data
        if not isinstance(data, Mapping):
            raise ValueError(f"a model must be a JSON object, not {_shown(data)}; {accepted()}")
        foreign = [str(name) for name in data if name not in cls.model_fields]
        if foreign:
            meant = next(filter(None, (did_you_mean(name, list(cls.model_fields)) for name in foreign)), "")
            of = f"not a quantity of the form {cls.quantities()}{meant}"
            raise ValueError(f"{', '.join(foreign)}: {of}; {accepted()}")
        missing = [name for name, field in cls.model_fields.items() if field.is_required() and name not in data]
        if missing:
            raise ValueError(f"{', '.join(missing)}: missing in the form {cls.quantities()}; {accepted()}")
        return data

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        model = self.plant()
        check_model(model.num, model.den, model.L)
        return self

    @classmethod
    def quantities(cls) -> str:
        """The names of the quantities of this form, for messages."""
        fields = cls.model_fields.items()
        return (
            "{" + ", ".join(name if each.is_required() else f"{name} (may be left out)" for name, each in fields) + "}"
        )


class FirstOrderModel(_Form):
    """First order with dead time: K exp(-L s) / (T s + 1)."""

    K: Gain
    T_s: TimeConstant = Field(description="Time constant, s", examples=[3.0])
    L_s: DeadTime

    def plant(self) -> FOPDT:
        return FOPDT(self.K, self.T_s, self.L_s)


class TwoLagModel(_Form):
    """Second order with two real lags and dead time: K exp(-L s) / ((T1 s + 1)(T2 s + 1))."""

    K: Gain
    T1_s: TimeConstant = Field(description="One time constant, s", examples=[10.0])
    T2_s: TimeConstant = Field(description="The other time constant, s", examples=[4.0])
    L_s: DeadTime

    def plant(self) -> SOPDT:
        return SOPDT(K=self.K, T1=self.T1_s, T2=self.T2_s, L=self.L_s)


class SecondOrderModel(_Form):
    """Second order by its damping ratio, with dead time: K exp(-L s) / (T^2 s^2 + 2 zeta T s + 1)."""

    K: Gain
    T_s: TimeConstant = Field(description="1/(natural frequency), s", examples=[6.0])
    zeta: Annotated[float, Field(gt=0), BeforeValidator(_positive)] = Field(
        description="Damping ratio; below 1 the poles are complex", examples=[0.5]
    )
    L_s: DeadTime

    def plant(self) -> SOPDT:
        check_damping(self.zeta)
        return SOPDT(self.K, self.T_s, self.zeta, self.L_s)


class IntegratingModel(_Form):
    """Integrating with dead time and an optional lag: K exp(-L s) / (s (T s + 1))."""

    K: Gain = Field(
        description="Gain, PV units per MV unit (on a loop: per percent) and second, not 0, either sign", examples=[0.1]
    )
    L_s: DeadTime
    integrating: Annotated[Literal[True], BeforeValidator(_integrates)] = Field(description="true", examples=[True])
    T_s: Lag = Field(default=0.0, description="Time constant of the lag, s; 0: none", examples=[5.0])

    def plant(self) -> Integrating:
        return Integrating(self.K, self.L_s, self.T_s)


class TransferFunctionModel(_Form):
    """Transfer function num(s)/den(s) exp(-dead_time_s s), PV units per MV unit; falling powers of s."""

    num: Coefficients = Field(description="Numerator, highest power of s first", examples=[[3.0, 2.0]])
    den: Coefficients = Field(description="Denominator, highest power of s first", examples=[[3.0, 4.0, 1.0]])
    dead_time_s: DeadTime = 0.0

    def plant(self) -> TransferFunction:
        num, den = self.num, self.den
        if den[0] == 0.0:
            raise ValueError(f"den must begin with a coefficient other than 0, not {_shown(den)}")
        if len(den) < 2 or (den[-1] == 0.0 and den[-2] == 0.0):
            raise ValueError(f"den must have a pole, and at most one at 0, not {_shown(den)}")
        if num[-1] == 0.0:
            raise ValueError(f"num must end with a coefficient other than 0, not {_shown(num)}: PV would come back")
        if len(num) > len(den):
            raise ValueError(f"num must have no more coefficients than den, {len(den)}, not {len(num)}")
        return TransferFunction(tuple(num), tuple(den), self.dead_time_s)


Form = FirstOrderModel | TwoLagModel | SecondOrderModel | IntegratingModel | TransferFunctionModel
_FORMS: tuple[type[Form], ...] = (
    FirstOrderModel,
    TwoLagModel,
    SecondOrderModel,
    IntegratingModel,
    TransferFunctionModel,
)


def accepted() -> str:
    return "accepted are " + ", ".join(form.quantities() for form in _FORMS)


def _form_of(data: object) -> type[Form]:
    """The form that the quantities of the object belong to."""
    if isinstance(data, _FORMS):
        return type(data)
    names: Sequence[object] | Mapping[object, object] = data if isinstance(data, Mapping) else ()
    if "num" in names or "den" in names:
        return TransferFunctionModel
    if "integrating" in names:
        return IntegratingModel
    if "T1_s" in names or "T2_s" in names:
        return TwoLagModel
    return SecondOrderModel if "zeta" in names else FirstOrderModel


ModelForm = Annotated[
    Annotated[FirstOrderModel, branch(FirstOrderModel)]
    | Annotated[TwoLagModel, branch(TwoLagModel)]
    | Annotated[SecondOrderModel, branch(SecondOrderModel)]
    | Annotated[IntegratingModel, branch(IntegratingModel)]
    | Annotated[TransferFunctionModel, branch(TransferFunctionModel)],
    Discriminator(lambda data: branch_of(_form_of(data))),
    BeforeValidator(named),
]
"""A model as JSON, in one of the five forms, or as a text."""
_ADAPTER: TypeAdapter[Form] = TypeAdapter(ModelForm)


def parse_model(data: object) -> Model:
    """The model that a JSON object, a text such as K=2,T=10,L=3 or a plant file of `loopwright rehearse` describes.
    Raises BadModel."""
    try:
        data = named(data)
    except ValueError as error:
        raise BadModel(str(error)) from None
    if isinstance(data, Mapping) and {"num", "den"} <= data.keys():
        data = {name: value for name, value in data.items() if name not in _BESIDE}
    try:
        return _ADAPTER.validate_python(data).plant()
    except ValidationError as error:
        raise BadModel(lines(error)) from None


def form_shown(data: object) -> object:
    """The form of a dumped model without validation, because an identified model may be outside the limits of input."""
    return _form_of(data).model_construct(**data) if isinstance(data, Mapping) else data


def dump_model(model: Model) -> dict[str, JsonValue]:
    """The JSON object from which `parse_model` makes the same model. A second-order model has T_s and zeta."""
    match model:
        case FOPDT(K, T, L):
            return {"K": K, "T_s": T, "L_s": L}
        case SOPDT(K, T, zeta, L):
            return {"K": K, "T_s": T, "zeta": zeta, "L_s": L}
        case Integrating(K, L, T):
            return {"K": K, "L_s": L, "integrating": True, "T_s": T}
        case TransferFunction(num, den, L):
            return {"num": list(num), "den": list(den), "dead_time_s": L}


def describe(data: Mapping[str, object]) -> str:
    """A dumped model as a line of text; a second-order model with real poles is shown by its two lags."""
    form = form_shown(data)
    if isinstance(form, SecondOrderModel) and form.zeta >= 1.0:
        model = SOPDT(form.K, form.T_s, form.zeta, form.L_s)
        data = {"K": model.K, "T1_s": model.T1, "T2_s": model.T2, "L_s": model.L}
    parts = []
    for name, value in data.items():
        if name != "integrating" and not (value == 0.0 and data.get("integrating") and name == "T_s"):
            shown = f"[{', '.join(f'{c:.4g}' for c in value)}]" if isinstance(value, list) else f"{value:.4g}"
            unit = " s" if name.endswith("_s") else ""
            parts.append(f"{name.removesuffix('_s').replace('_', ' ')} {shown}{unit}")
    return ("integrating, " if data.get("integrating") else "") + ", ".join(parts)
