"""Process models as JSON objects, in the five forms that a person may type, and back.

    {"K": 2, "T": 10, "L": 3}                            first order with dead time
    {"K": 2, "T1": 10, "T2": 4, "L": 3}                  second order, two real lags
    {"K": 2, "T": 6, "zeta": 0.5, "L": 3}                second order by its damping ratio; complex poles too
    {"K": 0.1, "L": 3, "integrating": true, "T": 5}      integrating; T, a lag, may be left out
    {"num": [2], "den": [10, 1], "dead_time_s": 3}       transfer function, highest power of s first

K: PV units per MV unit (integrating: that per s), not 0, either sign.  T, T1, T2, L, dead_time_s: s.
The other fields of a plant file of `loopwright rehearse` may stand beside num and den; they say nothing of the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from loopwright.service.plausible import Implausible, check_damping, check_model
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction

MAX_COEFFICIENTS = 12
_BESIDE = frozenset(
    {"name", "sample_time_s", "t95_s", "noise_std", "seed", "mv_limits", "sp_deviation", "gains", "reverse_acting"}
)


class BadModel(ValueError):
    """No model: the message names the quantity, its value, and what would be accepted."""


@dataclass(frozen=True, slots=True)
class _Form:
    needed: tuple[str, ...]
    optional: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "{" + ", ".join([*self.needed, *(f"{name} (may be left out)" for name in self.optional)]) + "}"


_FIRST = _Form(("K", "T", "L"))
_TWO_LAGS = _Form(("K", "T1", "T2", "L"))
_DAMPED = _Form(("K", "T", "zeta", "L"))
_INTEGRATING = _Form(("K", "L", "integrating"), ("T",))
_TRANSFER_FUNCTION = _Form(("num", "den"), ("dead_time_s",))
_ACCEPTED = "accepted are " + ", ".join(map(str, (_FIRST, _TWO_LAGS, _DAMPED, _INTEGRATING, _TRANSFER_FUNCTION)))


def parse_model(data: object) -> Model:
    """The model that a JSON object describes, in the kind of its form; raises BadModel."""
    if not isinstance(data, Mapping):
        raise BadModel(f"a model must be a JSON object, not {_shown(data)}; {_ACCEPTED}")
    model = _parsed(data)
    try:
        if "zeta" in data and isinstance(model, SOPDT):
            check_damping(model.zeta)
        check_model(model.num, model.den, model.L)
    except Implausible as error:
        raise BadModel(str(error)) from None
    return model


def _parsed(data: Mapping[str, object]) -> Model:
    form = _form(data)
    _match(data, form)
    if form is _TRANSFER_FUNCTION:
        return _transfer_function(data)
    K, L = _number(data, "K"), _time(data, "L")
    if K == 0.0:
        raise BadModel("K must not be 0: PV would not answer MV")
    if form is _INTEGRATING:
        if data["integrating"] is not True:
            raise BadModel(f"integrating must be true, or be left out, not {_shown(data['integrating'])}")
        return Integrating(K, L, _time(data, "T") if "T" in data else 0.0)
    if form is _TWO_LAGS:
        return SOPDT.of_time_constants(K, _positive(data, "T1"), _positive(data, "T2"), L)
    if form is _DAMPED:
        return SOPDT(K, _positive(data, "T"), _positive(data, "zeta"), L)
    return FOPDT(K, _positive(data, "T"), L)


def dump_model(model: Model) -> dict[str, Any]:
    """The JSON object that `parse_model` makes the same model of; a second order is given by T and zeta."""
    match model:
        case FOPDT(K, T, L):
            return {"K": K, "T": T, "L": L}
        case SOPDT(K, T, zeta, L):
            return {"K": K, "T": T, "zeta": zeta, "L": L}
        case Integrating(K, L, T):
            return {"K": K, "L": L, "integrating": True} | ({"T": T} if T > 0.0 else {})
        case TransferFunction(num, den, L):
            return {"num": list(num), "den": list(den), "dead_time_s": L}


def describe(data: Mapping[str, Any]) -> str:
    """A model as dumped, on one line for people; two real lags are shown as such."""
    model = parse_model(data)
    if isinstance(model, SOPDT) and model.zeta >= 1.0:
        data = {"K": model.K, "T1": model.T1, "T2": model.T2, "L": model.L}
    parts = []
    for name, value in data.items():
        if name != "integrating":
            shown = f"[{', '.join(f'{c:.4g}' for c in value)}]" if isinstance(value, list) else f"{value:.4g}"
            unit = " s" if name in ("T", "T1", "T2", "L", "dead_time_s") else ""
            parts.append(f"{name.removesuffix('_s').replace('_', ' ')} {shown}{unit}")
    return ("integrating, " if data.get("integrating") else "") + ", ".join(parts)


def _form(data: Mapping[str, object]) -> _Form:
    """The form whose own quantities are there."""
    if "num" in data or "den" in data:
        return _TRANSFER_FUNCTION
    if "integrating" in data:
        return _INTEGRATING
    if "T1" in data or "T2" in data:
        return _TWO_LAGS
    return _DAMPED if "zeta" in data else _FIRST


def _match(data: Mapping[str, object], form: _Form) -> None:
    known = {*form.needed, *form.optional} | (_BESIDE if form is _TRANSFER_FUNCTION else set())
    foreign = [str(name) for name in data if name not in known]
    if foreign:
        raise BadModel(f"{', '.join(foreign)}: not a quantity of the form {form}; {_ACCEPTED}")
    missing = [name for name in form.needed if name not in data]
    if missing:
        raise BadModel(f"{', '.join(missing)}: missing in the form {form}; {_ACCEPTED}")


def _transfer_function(data: Mapping[str, object]) -> TransferFunction:
    num, den = _coefficients(data, "num"), _coefficients(data, "den")
    dead_time = _time(data, "dead_time_s") if "dead_time_s" in data else 0.0
    if den[0] == 0.0:
        raise BadModel(f"den must begin with a coefficient other than 0, not {_shown(data['den'])}")
    if len(den) < 2 or (den[-1] == 0.0 and den[-2] == 0.0):
        raise BadModel(f"den must have a pole, and at most one at 0, not {_shown(data['den'])}")
    if num[-1] == 0.0:
        raise BadModel(f"num must end with a coefficient other than 0, not {_shown(data['num'])}: PV would come back")
    if len(num) > len(den):
        raise BadModel(f"num must have no more coefficients than den, {len(den)}, not {len(num)}")
    return TransferFunction(num, den, dead_time)


def _coefficients(data: Mapping[str, object], name: str) -> tuple[float, ...]:
    given = data[name]
    if not isinstance(given, list | tuple) or not 1 <= len(given) <= MAX_COEFFICIENTS:
        raise BadModel(f"{name} must be a list of 1 to {MAX_COEFFICIENTS} numbers, not {_shown(given)}")
    return tuple(_finite(value, f"{name}[{i}]") for i, value in enumerate(given))


def _number(data: Mapping[str, object], name: str) -> float:
    return _finite(data[name], name)


def _positive(data: Mapping[str, object], name: str) -> float:
    value = _number(data, name)
    if value <= 0.0:
        raise BadModel(f"{name} must be a number > 0{'' if name == 'zeta' else ' (s)'}, not {value:g}")
    return value


def _time(data: Mapping[str, object], name: str) -> float:
    value = _number(data, name)
    if value < 0.0:
        raise BadModel(f"{name} must be a number >= 0 (s), not {value:g}")
    return value


def _finite(value: object, name: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    raise BadModel(f"{name} must be a finite number, not {_shown(value)}")


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
