"""The checks that the rules share, and the making of a setting."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Integrating, Model
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.setting import Setting


def setting(
    Kp: float,
    Ti: float = 0.0,
    Td: float = 0.0,
    *,
    b: float = 1.0,
    c: float = 0.0,
    chosen: Mapping[str, float] | None = None,
    notes: tuple[str, ...] = (),
) -> Setting:
    """The setting with these gains; Ti, Td: s.

    Raises Refused, OUTSIDE_RANGE, when a gain or time is not a usable number: the units of the model are wrong by far,
    or L is close to zero.
    """
    if not (all(math.isfinite(x) for x in (Kp, Ti, Td)) and Kp > 0.0):
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"the settings are no usable numbers: Kp={Kp:g}, Ti={Ti:g} s, Td={Td:g} s; check the model's units",
        )
    return Setting(Gains(Kp=Kp, Ti=Ti, Td=Td, b=b, c=c), chosen or {}, notes)


def in_words(model: FOPDT | SOPDT | Integrating) -> str:
    """The reduced model in words, for a note; a SOPDT must have real poles."""
    if isinstance(model, FOPDT):
        return f"first order with K = {model.K:.4g}, T = {model.T:.4g} s, L = {model.L:.4g} s"
    if isinstance(model, SOPDT):
        return f"second order with K = {model.K:.4g}, T1 = {model.T1:.4g} s, T2 = {model.T2:.4g} s, L = {model.L:.4g} s"
    lag = f", T = {model.T:.4g} s" if model.T > 0.0 else ""
    return f"an integrator with K = {model.K:.4g} per s{lag}, L = {model.L:.4g} s"


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raises Refused, BAD_INPUT, unless the value is one of those allowed."""
    if value not in allowed:
        raise Refused(Reason.BAD_INPUT, f"{name} must be one of {', '.join(allowed)}, not {value!r}")


def positive(name: str, value: float, unit: str) -> float:
    """The value; raises Refused, BAD_INPUT, unless it is a positive number."""
    if not (math.isfinite(value) and value > 0.0):
        raise Refused(Reason.BAD_INPUT, f"{name} must be a number > 0 {unit}, not {value!r}")
    return value


def needs_dead_time(model: FOPDT | SOPDT | Integrating, rule: str) -> None:
    """Raises Refused, OUTSIDE_RANGE, for a model without dead time: the rule divides by it."""
    if model.L == 0.0:
        raise Refused(Reason.OUTSIDE_RANGE, f"{rule} needs a dead time L > 0 s, not L = 0: its gain grows as 1/L")


def no_lag(model: Integrating, rule: str) -> None:
    """Raises Refused, OUTSIDE_RANGE, for an integrating plant with a lag: the rule is made for K exp(-L s)/s."""
    if model.T > 0.0:
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"{rule} takes an integrating plant without lag, T = 0 s, not {model.T:g} s; reduce it",
        )


def stable_plant(model: Model, rule: str) -> None:
    """Raises Refused, OUTSIDE_RANGE, for an unstable plant: rules on the ultimate cycle assume a stable one."""
    if np.any(np.roots(model.den).real > 0.0):
        raise Refused(
            Reason.OUTSIDE_RANGE, f"{rule} takes stable plants, and this one has a pole in the right half-plane"
        )


def refuse_unstable(model: Model, found: Setting, rule: str) -> Setting:
    """The setting; raises Refused, OUTSIDE_RANGE, if its loop with this self-regulating model is unstable."""
    if not margins(model, found.gains).stable:
        raise Refused(Reason.OUTSIDE_RANGE, f"{rule} would make the loop of this model unstable; choose another method")
    return found


def ratio_within(model: FOPDT, low: float, high: float, rule: str, extrapolate: bool | None = None) -> tuple[str, ...]:
    """The notes on the range of L/T that a rule was made for.

    Raises Refused, OUTSIDE_RANGE, unless low <= L/T <= high. With `extrapolate` a note is given instead; None means
    that the rule has no such option.
    """
    needs_dead_time(model, rule)
    ratio = model.L / model.T
    # a model made at the very edge must not fall off it by rounding
    if low * (1.0 - 1e-9) <= ratio <= high * (1.0 + 1e-9):
        return ()
    text = f"L/T = {ratio:.4g} is outside {low:g} to {high:g}, the range {rule} was made for"
    if not extrapolate:
        way_out = "" if extrapolate is None else "; extrapolate = true uses it nevertheless"
        raise Refused(Reason.OUTSIDE_RANGE, text + way_out)
    return (f"{text}.",)
