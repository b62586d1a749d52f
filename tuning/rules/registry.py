"""The registry of tuning methods, and one call for all of them: `tune(name, model, **options)`.

A model that is not of a kind that the method takes is reduced where a sound reduction exists, and a note says so: by
the half rule, or by the tangent for rules made on the reaction curve. Otherwise the method refuses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Literal

from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model, TransferFunction, integrators
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.reduction.half_rule import exact, half_rule
from loopwright.tuning.reduction.tangent import tangent
from loopwright.tuning.rules import tyreus_luyben, ziegler_nichols
from loopwright.tuning.rules.amigo import amigo
from loopwright.tuning.rules.chien_hrones_reswick import chien_hrones_reswick
from loopwright.tuning.rules.cohen_coon import cohen_coon
from loopwright.tuning.rules.common import in_words
from loopwright.tuning.rules.direct_synthesis import PAPER_C, STABLE_C, direct_synthesis
from loopwright.tuning.rules.imc import imc_pi, imc_pid
from loopwright.tuning.rules.kappa_tau import kappa_tau
from loopwright.tuning.rules.lambda_tuning import lambda_tuning
from loopwright.tuning.rules.me_pso import ROBUST_MS, me_pso
from loopwright.tuning.rules.robust_pi import robust
from loopwright.tuning.rules.s_plane import s_plane
from loopwright.tuning.rules.setting import Setting
from loopwright.tuning.rules.simc import simc

Value = float | str | bool | None


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a method.

    unit: the unit of the value, "" for none.
    default: the default value, None where it depends on the model.
    meaning: the meaning of the option, for the user.
    choices: the only permitted values, empty for any.
    range: the smallest and the largest value, None for no limit; a rule may refuse more, depending on the model.
    kind: the kind of the value.
    """

    unit: str
    default: Value
    meaning: str
    choices: tuple[str | float, ...] = ()
    range: tuple[float | None, float | None] = (None, None)
    kind: Literal["number", "whole", "flag", "choice"] = "number"

    def check(self, name: str, value: object) -> Value:
        """The value as the rule takes it. Raises Refused, BAD_INPUT, for a value that is not permitted."""
        if value is None and self.default is None:
            return None
        if self.kind == "choice":
            for choice in self.choices:
                # a choice that reads as a number may come as one
                if (value == choice or str(value) == choice) and not isinstance(value, bool):
                    return choice
            raise _bad(name, value, "one of " + ", ".join(f"{c}" for c in self.choices))
        if self.kind == "flag":
            if isinstance(value, bool):
                return value
            raise _bad(name, value, "true or false")
        kind = Integral if self.kind == "whole" else Real
        if isinstance(value, bool) or not isinstance(value, kind) or not math.isfinite(number := float(value)):
            raise _bad(name, value, f"a {'whole ' if self.kind == 'whole' else ''}number")
        low, high = self.range
        if (low is not None and number < low) or (high is not None and number > high):
            ends = (
                f"{low:g} or more" if high is None else f"{high:g} or less" if low is None else f"{low:g} to {high:g}"
            )
            raise _bad(name, value, f"{ends} {self.unit}".rstrip())
        return int(number) if self.kind == "whole" else number


@dataclass(frozen=True, slots=True)
class Method:
    """A tuning method.

    name, title: its name in requests, and its title for people.
    source: the publication.
    for_what: when to choose the method, in one sentence.
    needs: the models that it takes, in words.
    takes: the same models as types.
    rule: the function that computes the setting.
    options: its options by name.
    lag: whether an `Integrating` model may have a lag.
    reaction_curve: True for a rule made on the tangent of a step response.
    measured: the same rule from a measured (Ku, Pu), None without one.
    slow: True if the computation takes longer than 0.2 s, so that it is left out where all rules are shown at once.
    filter: Td/Tf where the loop realises an ideal derivative.
    """

    name: str
    title: str
    source: str
    for_what: str
    needs: str
    takes: tuple[type[Model], ...]
    rule: Callable[..., Setting]
    options: Mapping[str, Option] = field(default_factory=dict)
    lag: bool = False
    reaction_curve: bool = False
    measured: Callable[..., Setting] | None = None
    slow: bool = False
    filter: float = 10.0

    def tune(self, model: Model, **options: object) -> Setting:
        """The setting of the method for a model.

        Raises Refused: BAD_INPUT (an option), or as the rule does: NOT_SELF_REGULATING, OUTSIDE_RANGE,
        CANNOT_OSCILLATE.
        """
        checked = self.checked(options)
        fitted, notes = self._fitted(model)
        found = self.rule(fitted, **checked)
        return replace(found, notes=notes + found.notes)

    def tune_measured(self, Ku: float, Pu: float, **options: object) -> Setting:
        """The setting from the ultimate gain (MV units per PV unit) and period (s) measured on the loop. Raises
        Refused, BAD_INPUT, for a method that does not use them."""
        if self.measured is None:
            raise Refused(Reason.BAD_INPUT, f"{self.name} does not use the ultimate point")
        return self.measured(Ku, Pu, **self.checked(options))

    def checked(self, options: Mapping[str, object]) -> dict[str, Value]:
        """The options as the rule takes them. Raises Refused, BAD_INPUT, if one is unknown or out of range."""
        checked: dict[str, Value] = {}
        for name, value in options.items():
            if name not in self.options:
                known = ", ".join(self.options) or "none"
                raise Refused(Reason.BAD_INPUT, f"{self.name} has no option {name!r}; it has: {known}")
            checked[name] = self.options[name].check(name, value)
        return checked

    def _fitted(self, model: Model) -> tuple[Model, tuple[str, ...]]:
        """The model, reduced if need be to a kind that the rule takes, and a note on the reduction."""
        if isinstance(model, TransferFunction):
            model = exact(model)
        integrating = integrators(model) > 0
        if integrating and Integrating not in self.takes:
            raise Refused(Reason.NOT_SELF_REGULATING, f"{self.title} takes {self.needs}, and this plant integrates")
        bare = not isinstance(model, Integrating) or model.T == 0.0
        if isinstance(model, self.takes) and (bare or self.lag):
            return model, ()
        reduced: FOPDT | SOPDT | Integrating
        if isinstance(model, SOPDT) and self.reaction_curve:
            reduced, how = tangent(model), "its tangent"
        else:
            order: Literal[1, 2] = 2 if SOPDT in self.takes and not integrating else 1
            reduced, how = half_rule(model, order), "the half rule"
        return reduced, (f"The model was reduced by {how} to {in_words(reduced)}.",)


def tune(name: str, model: Model, **options: object) -> Setting:
    """The setting that the method with this name in `METHODS` gives for this model. Raises Refused as `Method.tune`."""
    if name not in METHODS:
        raise Refused(Reason.BAD_INPUT, f"method must be one of {', '.join(METHODS)}, not {name!r}")
    return METHODS[name].tune(model, **options)


def _bad(name: str, value: object, accepted: str) -> Refused:
    return Refused(Reason.BAD_INPUT, f"{name} must be {accepted}, not {value!r}")


def _controller(*choices: str) -> Option:
    return Option("", "pi", "terms of the controller", choices, kind="choice")


def _flag(meaning: str) -> Option:
    return Option("", False, meaning, kind="flag")


ANY = (FOPDT, SOPDT, Integrating, TransferFunction)
EXTRAPOLATE = {"extrapolate": _flag("use the rule outside the range it was made for, with a note")}
LAMBDA = {
    "lambda_s": Option(
        "s", None, "time constant of the filter; none: max(0.8 L, T/5), sqrt(10) L if integrating", range=(0.0, None)
    ),
    "psi_s": Option(
        "s", None, "integrating plants: take the integrator for a lag this long, as the paper does", range=(0.0, None)
    ),
    "extrapolate": _flag("allow a lambda below the safe range, with a note"),
}

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "zn-ultimate",
            "Ziegler-Nichols, ultimate cycle",
            "J. G. Ziegler, N. B. Nichols, Trans. ASME 64, 1942",
            "A first setting that recovers fast from loads and oscillates: Ms is 2 to 3.",
            "any stable plant that a P controller can make oscillate",
            ANY,
            ziegler_nichols.zn_ultimate,
            {"controller": _controller("p", "pi", "pid")},
            lag=True,
            measured=ziegler_nichols.ultimate,
        ),
        Method(
            "zn-step",
            "Ziegler-Nichols, step response",
            "J. G. Ziegler, N. B. Nichols, Trans. ASME 64, 1942",
            "A first setting from a step response; lively, little robustness.",
            "first order with dead time, L/T from 0.1 to 1, or integrating with dead time",
            (FOPDT, Integrating),
            ziegler_nichols.zn_step,
            {"controller": _controller("p", "pi", "pid"), **EXTRAPOLATE},
            lag=True,
            reaction_curve=True,
        ),
        Method(
            "tyreus-luyben",
            "Tyreus-Luyben",
            "B. D. Tyreus, W. L. Luyben, Ind. Eng. Chem. Res. 31, 1992",
            "Well damped loops on plants that integrate or have one large lag; slow integral action.",
            "any stable plant that a P controller can make oscillate",
            ANY,
            tyreus_luyben.tyreus_luyben,
            {
                "controller": _controller("pi", "pid"),
                "variant": Option(
                    "", "2.2", "Ti = 2.2 Pu, or Pu/0.45 as in the ME-PSO paper", ("2.2", "0.45"), kind="choice"
                ),
            },
            lag=True,
            measured=tyreus_luyben.ultimate,
        ),
        Method(
            "cohen-coon",
            "Cohen-Coon",
            "G. H. Cohen, G. A. Coon, Trans. ASME 75, 1953",
            "Fast load recovery with more dead time than Ziegler-Nichols bears; oscillates.",
            "first order with dead time, L/T from 0.05 to 1",
            (FOPDT,),
            cohen_coon,
            {
                "controller": _controller("p", "pi", "pid"),
                "variant": Option(
                    "",
                    "original",
                    "original, or the PI of the ME-PSO paper, far higher in gain",
                    ("original", "tau"),
                    kind="choice",
                ),
                **EXTRAPOLATE,
            },
            reaction_curve=True,
        ),
        Method(
            "chr",
            "Chien-Hrones-Reswick",
            "K. L. Chien, J. A. Hrones, J. B. Reswick, Trans. ASME 74, 1952",
            "Fast answers with a chosen overshoot, to the set-point or to loads.",
            "first order with dead time, L/T from 0.1 to 1",
            (FOPDT,),
            chien_hrones_reswick,
            {
                "controller": _controller("p", "pi", "pid"),
                "aim": Option("", "setpoint", "what the loop answers to", ("setpoint", "load"), kind="choice"),
                "overshoot_pct": Option("%", 0.0, "overshoot aimed at", (0.0, 20.0), kind="choice"),
                **EXTRAPOLATE,
            },
            reaction_curve=True,
        ),
        Method(
            "kappa-tau",
            "Kappa-tau",
            "K. J. Astrom, T. Hagglund, PID controllers, 2nd edition, 1995",
            "Load rejection at a chosen robustness, for plants of any normalised dead time.",
            "first order with dead time, L/T from 0.1 to 5.5",
            (FOPDT,),
            kappa_tau,
            {"Ms": Option("", 1.4, "maximum sensitivity aimed at", (1.4, 2.0), kind="choice"), **EXTRAPOLATE},
        ),
        Method(
            "amigo",
            "AMIGO",
            "T. Hagglund, K. J. Astrom, Asian J. Control 4, 2002; J. Process Control 14, 2004",
            "Robust load rejection, Ms about 1.4: a safe default where the model is rough.",
            "first order or integrating, with dead time",
            (FOPDT, Integrating),
            amigo,
            {"controller": _controller("pi", "pid")},
        ),
        Method(
            "lambda",
            "Lambda tuning",
            "E. B. Dahlin, Instruments and Control Systems 41, 1968",
            "Smooth set-point answers of a speed that you choose; loops that must not disturb each other.",
            "first order with or without dead time, or integrating",
            (FOPDT, Integrating),
            lambda_tuning,
            {
                "lambda_s": Option(
                    "s", None, "time constant of the closed loop; none: 3 T, 3 L if integrating", range=(0.0, None)
                ),
            },
        ),
        Method(
            "simc",
            "SIMC",
            "S. Skogestad, J. Process Control 13, 2003",
            "The best compromise of speed, load rejection and robustness for most process loops; Ms about 1.6.",
            "first or second order, integrating, or more real lags (half rule)",
            ANY,
            simc,
            {
                "controller": _controller("pi", "pid"),
                "tau_c_s": Option(
                    "s", None, "time constant of the closed loop; none: the dead time", range=(0.0, None)
                ),
            },
            lag=True,
        ),
        Method(
            "imc-pi",
            "IMC, PI",
            "B. Mabu Sarif, D. V. Ashok Kumar, M. Venu Gopal Rao, IJECE 10(3), 2020, eq. (9), (10)",
            "Set-point answers without overshoot, one number for the speed; slow after loads on slow plants.",
            "first order or integrating",
            (FOPDT, Integrating),
            imc_pi,
            LAMBDA,
        ),
        Method(
            "imc-pid",
            "IMC, PID",
            "B. Mabu Sarif, D. V. Ashok Kumar, M. Venu Gopal Rao, IJECE 10(3), 2020, eq. (11), (12), (26)-(28), (36)",
            "As IMC-PI and faster, with a derivative on the error that needs a filter.",
            "first order, second order (complex poles too) or integrating",
            (FOPDT, SOPDT, Integrating),
            imc_pid,
            {
                **LAMBDA,
                "form": Option(
                    "",
                    "zero",
                    "first order: how the dead time's Pade factor is split",
                    ("zero", "all-pass"),
                    kind="choice",
                ),
            },
        ),
        Method(
            "direct-synthesis",
            "Direct synthesis",
            "I. A. Polishchuk, 2023, eq. (5), (6), (27)",
            "Set-point answers of second-order plants without overshoot; not for loads.",
            "second order with dead time (complex poles too), or first order",
            (SOPDT, FOPDT),
            direct_synthesis,
            {
                "c": Option(
                    "", PAPER_C, "K Kp L/(T1 + T2): no overshoot to 0.3679, unstable from pi/2", range=(0.0, STABLE_C)
                )
            },
            filter=20.0,
        ),
        Method(
            "robust",
            "Robust PI",
            "Stopakevych et al., Problemele Energeticii Regionale, criterion (7)",
            "The best set-point answer that K, T and L may each be 20 % off for.",
            "first order with dead time, L/T from 0.02 to 20",
            (FOPDT,),
            robust,
            {
                "horizon_s": Option("s", None, "length of the step response; none: 10 (T + L)", range=(0.0, None)),
                "scale_free": Option("", None, "weigh time in units of T; none: for T below 5 s", kind="flag"),
            },
        ),
        Method(
            "s-plane",
            "S-plane pole placement",
            "M. Horbiichuk, M. Vasylenchuk, I. Yednak, A. Lahoida, EEJET 1(2(133)), 2025",
            "Set-point answers with a damping that you prescribe, at the speed of least squared error and rate.",
            "a PI: no integrator; a PID with dead time: two poles more than zeros",
            ANY,
            s_plane,
            {
                "controller": _controller("pi", "pid"),
                "mu": Option("", 1.0, "imaginary over real part of the dominant pair", range=(0.0, None)),
                "tau_s": Option(
                    "s", None, "weight of the error's rate; none: a quarter of all lags", range=(0.0, None)
                ),
                "k1": Option("", 1.2, "PID: the real root over the pair's real part", range=(0.0, None)),
                "alpha_per_s": Option("1/s", None, "the pair's real part; none: searched", range=(0.0, None)),
            },
            lag=True,
            slow=True,
        ),
        Method(
            "me-pso",
            "ME-PSO",
            "Y. Romasevych, V. Loveikin, S. Usenko, PI-controller tuning optimization via PSO-based technique",
            "A PI by search, for the least error, control effort or settling time under a bound on Ms.",
            "any stable model, or integrating",
            ANY,
            me_pso,
            {
                "weighting": Option("", "error", "what weighs most", ("error", "control", "duration"), kind="choice"),
                "seed": Option("", 0, "the same seed gives the same gains", range=(0, None), kind="whole"),
                "optimiser": Option("", "me-pso", "how it searches", ("me-pso", "de", "nelder-mead"), kind="choice"),
                "Ms_max": Option("", ROBUST_MS, "bound on Ms, above 1; 0: none, as published", range=(0.0, None)),
                "horizon_s": Option("s", None, "simulated time; none: 20 times all lags", range=(0.0, None)),
                "Kp_max": Option("MV/PV", None, "end of the search; none: the ultimate gain", range=(0.0, None)),
                "Ki_min": Option("MV/(PV s)", None, "end of the search; none: from the model", range=(0.0, None)),
            },
            lag=True,
            slow=True,
        ),
    )
}
