"""What every rule checks, and how it answers."""

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
    """Refused (outside_range) when a setting left the range of numbers: the model's units are far off, or L is next to
    nothing."""
    if not (all(math.isfinite(x) for x in (Kp, Ti, Td)) and Kp > 0.0):
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"the settings are no usable numbers: Kp={Kp:g}, Ti={Ti:g} s, Td={Td:g} s; check the model's units",
        )
    return Setting(Gains(Kp=Kp, Ti=Ti, Td=Td, b=b, c=c), chosen or {}, notes)


def in_words(model: FOPDT | SOPDT | Integrating) -> str:
    """For a note on what a plant was reduced to; a SOPDT with real poles."""
    if isinstance(model, FOPDT):
        return f"first order with K = {model.K:.4g}, T = {model.T:.4g} s, L = {model.L:.4g} s"
    if isinstance(model, SOPDT):
        return f"second order with K = {model.K:.4g}, T1 = {model.T1:.4g} s, T2 = {model.T2:.4g} s, L = {model.L:.4g} s"
    lag = f", T = {model.T:.4g} s" if model.T > 0.0 else ""
    return f"an integrator with K = {model.K:.4g} per s{lag}, L = {model.L:.4g} s"


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise Refused(Reason.BAD_INPUT, f"{name} must be one of {', '.join(allowed)}, not {value!r}")


def positive(name: str, value: float, unit: str) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise Refused(Reason.BAD_INPUT, f"{name} must be a number > 0 {unit}, not {value!r}")
    return value


def needs_dead_time(model: FOPDT | SOPDT | Integrating, rule: str) -> None:
    """Rules that divide by the dead time have no answer without it."""
    if model.L == 0.0:
        raise Refused(Reason.OUTSIDE_RANGE, f"{rule} needs a dead time L > 0 s, not L = 0: its gain grows as 1/L")


def no_lag(model: Integrating, rule: str) -> None:
    """Rules for K exp(-L s)/s know nothing of a lag."""
    if model.T > 0.0:
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"{rule} takes an integrating plant without lag, T = 0 s, not {model.T:g} s; reduce it",
        )


def stable_plant(model: Model, rule: str) -> None:
    """Rules on the ultimate cycle presume a plant that would not run away by itself."""
    if np.any(np.roots(model.den).real > 0.0):
        raise Refused(
            Reason.OUTSIDE_RANGE, f"{rule} takes stable plants, and this one has a pole in the right half-plane"
        )


def refuse_unstable(model: Model, found: Setting, rule: str) -> Setting:
    """The setting, if the loop of it and this self-regulating model is stable."""
    if not margins(model, found.gains).stable:
        raise Refused(Reason.OUTSIDE_RANGE, f"{rule} would make the loop of this model unstable; choose another method")
    return found


def ratio_within(model: FOPDT, low: float, high: float, rule: str, extrapolate: bool | None = None) -> tuple[str, ...]:
    """Refused unless low <= L/T <= high; with `extrapolate` a note instead (None: the rule has no such option)."""
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
