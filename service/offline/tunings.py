"""Tunes a model by one method or by all, for `loopwright tune` and POST /tunings.

The gains are those that a controller can carry out (see `tuning.rules.design.realisable`). Margins and step figures are
computed with these gains on the model as given, with its exact dead time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TypedDict

from loopwright.service.inputs.model_json import dump_model
from loopwright.service.inputs.plausible import Implausible, check_option
from loopwright.service.inputs.validation import did_you_mean
from loopwright.service.jsonable import JsonObject, json_object
from loopwright.service.offline.recommendation import recommended
from loopwright.tuning.analysis.assessment import Assessment
from loopwright.tuning.analysis.step_figures import StepFigures
from loopwright.tuning.fast.known_plant.tuned import METHODS, method_of, tune
from loopwright.tuning.gains import Gains, to_parallel
from loopwright.tuning.models import Model
from loopwright.tuning.reasons import Ended, Failed, Reason, Refused
from loopwright.tuning.rules.registry import Method, Option

ALL = "all"
FORM = "ISA: u = Kp*(b*SP - PV + integral(SP - PV)/Ti + Td*d/dt(c*SP - PV)/(1 + Tf*s)); Ti = 0: no integral"
FIGURES_ARE = (
    "Margins and figures are computed with these gains on the model as given, with its exact dead time; an ideal "
    "derivative is filtered first. setpoint: unit step of the set-point; load: unit step at the plant's input."
)
UNITS = {
    "Kp": "MV per PV unit",
    "Ti, Td, Tf": "s",
    "Ki": "MV per PV unit and s",
    "Kd": "MV s per PV unit",
    "PM_deg": "degrees",
    "bandwidth_rad_s": "rad/s",
    "*_s": "s",
    "IAE, ITAE": "PV units times s, s^2",
    "ISE, ITSE": "PV units^2 times s, s^2",
    "MIE, peak, settling_band": "PV units",
    "MIC, TV, peak_u": "MV units",
    "effort": "MV units^2 s",
}


class BadTuning(ValueError):
    """The request names an unknown method or option, or a value that the option does not take."""


@dataclass(frozen=True, slots=True)
class MethodResult:
    """The result of one method: the gains with their assessment on the model, or the refusal.

    design: the design parameters in effect, by name with unit.
    """

    method: Method
    gains: Gains | None = None
    design: Mapping[str, float] | None = None
    notes: tuple[str, ...] = ()
    assessment: Assessment | None = None
    refusal: Ended | None = None


def tune_model(model: Model, method: str = ALL, options: Mapping[str, object] | None = None) -> list[MethodResult]:
    """Tunes the model by the method named, or by all in their order.

    Each option goes to the methods that have it. A method that refuses the model is in the list with its refusal.

    Raises BadTuning.
    """
    return tune_each(model, list(METHODS) if method == ALL else [method], options)


def tune_each(model: Model, names: Sequence[str], options: Mapping[str, object] | None = None) -> list[MethodResult]:
    """Tunes the model by the methods named, in this order, as `tune_model` does. Raises BadTuning."""
    methods = []
    for name in names:
        try:
            methods.append(method_of(name))
        except Refused as refused:
            raise BadTuning(f"{refused.detail}{did_you_mean(name, list(METHODS))}") from None
    asked = options or {}
    for name, value in asked.items():
        _check(methods, name, value)
    return [_tuned(each, model, {k: v for k, v in asked.items() if k in each.options}) for each in methods]


def tunings(model: Model, method: str = ALL, options: Mapping[str, object] | None = None) -> dict[str, object]:
    """Returns the results of `tune_model` as the JSON object of POST /tunings. Raises BadTuning."""
    return {**answer(model, tune_model(model, method, options))}


class RecommendedMethod(TypedDict):
    """The method to take first, and why."""

    method: str
    reason: str


class Tunings(TypedDict):
    """The JSON object of the tunings of one model, as `tuning_views.TuningsView` describes it."""

    model: JsonObject
    methods: list[JsonObject]
    recommended: RecommendedMethod | None
    form: str
    figures_are: str
    units: dict[str, str]


def answer(model: Model, found: Sequence[MethodResult]) -> Tunings:
    """Returns the JSON object of `loopwright tune --json` and POST /tunings; what is not known is null."""
    first = recommended({each.method.name: each.assessment for each in found if each.assessment is not None})
    return {
        "model": dump_model(model),
        "methods": [as_json(each) for each in found],
        "recommended": {"method": first.method, "reason": first.reason} if first else None,
        "form": FORM,
        "figures_are": FIGURES_ARE,
        "units": UNITS,
    }


def as_json(found: MethodResult) -> JsonObject:
    """Returns the part of that JSON object for one method."""
    gains, assessed, refusal = found.gains, found.assessment, found.refusal
    parallel = to_parallel(gains) if gains else None
    return json_object(
        {
            "method": found.method.name,
            "title": found.method.title,
            "outcome": "refused" if refusal else "tuned",
            "reason": refusal.reason.value if refusal else None,
            "detail": refusal.detail if refusal else None,
            "advice": refusal.advice if refusal else None,
            "gains": {"form": "ISA", **asdict(gains)} if gains else None,
            "parallel": {"Kp": parallel.Kp, "Ki": parallel.Ki, "Kd": parallel.Kd, "Tf": parallel.Tf}
            if parallel
            else None,
            "design": dict(found.design) if found.design is not None else None,
            "notes": list(found.notes),
            "margins": _margins(assessed) if assessed else None,
            "setpoint": _figures(assessed.setpoint) if assessed else None,
            "load": _figures(assessed.load) if assessed else None,
        }
    )


def methods_json(methods: Mapping[str, Method] = METHODS) -> list[dict[str, object]]:
    """Returns the methods as the JSON array of GET /methods and `loopwright methods --json`."""
    return [
        {
            "method": method.name,
            "title": method.title,
            "source": method.source,
            "for_what": method.for_what,
            "needs": method.needs,
            "options": {name: _option(option) for name, option in method.options.items()},
        }
        for method in methods.values()
    ]


def _check(methods: list[Method], name: str, value: object) -> None:
    """Raises BadTuning unless one of the methods has the option and accepts the value."""
    knowing = [method for method in methods if name in method.options]
    if not knowing:
        who = methods[0].name if len(methods) == 1 else "no method"
        known = sorted({option for method in methods for option in method.options})
        verb = "has no option" if len(methods) == 1 else "has an option"
        raise BadTuning(f"{who} {verb} {name!r}; there are: {', '.join(known) or 'none'}")
    refusals = []
    for method in knowing:
        try:
            method.checked({name: value})
            check_option(name, method.options[name].unit, value)
        except Refused as refusal:
            refusals.append(refusal.detail)
        except Implausible as refusal:
            refusals.append(str(refusal))
    if len(refusals) == len(knowing):
        raise BadTuning("; ".join(dict.fromkeys(refusals)))


def _tuned(method: Method, model: Model, options: Mapping[str, object]) -> MethodResult:
    try:
        found = tune(model, method.name, 0.0, **options)
    except Ended as refusal:
        return MethodResult(method, refusal=refusal)
    except (ArithmeticError, ValueError) as error:
        # one method's defect must not take the other methods' answers with it
        return MethodResult(method, refusal=Failed(Reason.INTERNAL, f"{type(error).__name__}: {error}"))
    return MethodResult(method, found.gains, found.chosen, found.notes, found.assessment)


def _margins(found: Assessment) -> dict[str, object]:
    m = found.margins
    margins: dict[str, object] = {
        "Ms": m.Ms,
        "Mt": m.Mt,
        "GM": m.GM,
        "PM_deg": m.PM_deg,
        "delay_margin_s": m.delay_margin_s,
        "bandwidth_rad_s": m.bandwidth,
    }
    # the margins of an unstable loop would mislead
    return {"stable": m.stable} | (margins if m.stable else dict.fromkeys(margins))


def _figures(found: StepFigures | None) -> dict[str, object] | None:
    if found is None:
        return None
    figures = asdict(found)
    return {"settling_band": figures.pop("band")} | figures


def _option(option: Option) -> dict[str, object]:
    return {
        "kind": option.kind,
        "unit": option.unit,
        "default": option.default,
        "meaning": option.meaning,
        "choices": list(option.choices),
        "minimum": option.range[0],
        "maximum": option.range[1],
    }
