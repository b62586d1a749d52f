"""Controller settings in the ISA (standard) form, the only one used inside Loopwright, and in the forms of others.

    ISA          Kp (1 + 1/(Ti s) + Td s/(1 + Tf s))             `Gains`
    parallel     Kp + Ki/s + Kd s/(1 + Tf s)                     the s-plane paper's C_i, from the highest power of s
    series       Kp (1 + 1/(Ti s)) (1 + Td s)/(1 + Tf s)         interacting; exists while both its zeros are real
    reciprocal   Kp + 1/(Ti s)                                   the ME-PSO paper's PI: its Ti is 1/Ki, no time

The whole controller is u = Kp * ( b*SP - PV  +  1/Ti * integral(SP - PV)  +  Td * d/dt(c*SP - PV) / (1 + Tf*s) ). The
conversions cover the terms that act on the measurement; set-point weights belong to the ISA controller only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Protocol

from loopwright.tuning.reasons import Reason, Refused


@dataclass(frozen=True, slots=True)
class Gains:
    """ISA gains of a PI(D) controller.

    Kp: MV units per PV unit (positive; the direction of action is the controller's).
    Ti: integral time, s; 0 means no integral action (as in the device's object dictionary).
    Td: derivative time, s.  Tf: derivative filter time, s.
    b, c: set-point weights of the proportional and derivative paths.
    """

    Kp: float
    Ti: float = 0.0
    Td: float = 0.0
    Tf: float = 0.0
    b: float = 1.0
    c: float = 0.0

    def __post_init__(self) -> None:
        for name in ("Kp", "Ti", "Td", "Tf", "b", "c"):
            value = getattr(self, name)
            if type(value) is not float and (isinstance(value, bool) or not isinstance(value, Real)):
                raise TypeError(f"{name} must be a number, not {value!r}")

    def __str__(self) -> str:
        """The gains in words: Kp 0.83, Ti 10 s, b 0.8."""
        times = [f"{name} {value:.6g} s" for name, value in (("Td", self.Td), ("Tf", self.Tf)) if value]
        usual = (("b", self.b, 1.0), ("c", self.c, 0.0))
        weights = [f"{name} {value:.6g}" for name, value, without in usual if value != without]
        integral = f"Ti {self.Ti:.6g} s" if self.Ti else "no Ti"
        return ", ".join([f"Kp {self.Kp:.6g}", integral, *times, *weights])


class WithGains(Protocol):
    """What has been found with gains, such as the result of `tune`; None where none were found."""

    @property
    def gains(self) -> Gains | None: ...


AnyGains = Gains | WithGains
"""What `as_gains` takes."""


def as_gains(given: AnyGains) -> Gains:
    """The gains, or those of a result that has some. Raises TypeError for what has none."""
    if isinstance(given, Gains):
        return given
    if isinstance(found := getattr(given, "gains", None), Gains):
        return found
    if hasattr(given, "gains"):
        raise TypeError(f"this {type(given).__name__} has no gains: {given!r}")
    raise TypeError(f"{type(given).__name__} has no gains: give Gains(Kp=..., Ti=...), or a result of tune")


@dataclass(frozen=True, slots=True)
class Parallel:
    """The parallel form.

    Kp: the proportional gain, MV units per PV unit.
    Ki: the integral gain, MV units per PV unit and s.
    Kd: the derivative gain, MV units * s per PV unit.
    Tf: the derivative filter time, s.
    """

    Kp: float
    Ki: float = 0.0
    Kd: float = 0.0
    Tf: float = 0.0


@dataclass(frozen=True, slots=True)
class Series:
    """The series form.

    Kp: the proportional gain, MV units per PV unit.
    Ti: the integral time, s; 0 is no integral action.
    Td: the derivative time, s, the smaller of the two times.
    Tf: the derivative filter time, s.
    """

    Kp: float
    Ti: float = 0.0
    Td: float = 0.0
    Tf: float = 0.0


@dataclass(frozen=True, slots=True)
class Reciprocal:
    """The reciprocal form of the ME-PSO paper.

    Kp: the proportional gain, MV units per PV unit.
    Ti: the reciprocal 1/Ki of the integral gain, PV units * s per MV unit.
    """

    Kp: float
    Ti: float


def to_parallel(gains: Gains) -> Parallel:
    """The parallel form of ISA gains: Ki = Kp/Ti (0 for Ti = 0), Kd = Kp Td."""
    _check_isa(gains)
    Ki = gains.Kp / gains.Ti if gains.Ti > 0.0 else 0.0
    return Parallel(gains.Kp, Ki, gains.Kp * gains.Td, gains.Tf)


def of_parallel(form: Parallel) -> Gains:
    """The ISA gains of a parallel form: Ti = Kp/Ki, Td = Kd/Kp. Raises Refused for Kp = 0, which the ISA form cannot
    express."""
    _check(positive={"Kp": form.Kp}, not_negative={"Ki": form.Ki, "Kd": form.Kd, "Tf": form.Tf})
    return Gains(form.Kp, form.Kp / form.Ki if form.Ki > 0.0 else 0.0, form.Kd / form.Kp, form.Tf)


def to_reciprocal(gains: Gains) -> Reciprocal:
    """The reciprocal form of ISA gains: its Ti is Ti/Kp. Raises Refused for a controller with derivative or without
    integral action."""
    _check_isa(gains)
    if gains.Td > 0.0 or gains.Ti == 0.0:
        raise Refused(
            Reason.BAD_INPUT, f"the reciprocal form is a PI: Ti > 0 and Td = 0, not {gains.Ti} s, {gains.Td} s"
        )
    return Reciprocal(gains.Kp, gains.Ti / gains.Kp)


def to_series(gains: Gains) -> Series:
    """The series form of ISA gains. Its two times are the roots of x^2 - (Ti + Tf) x + Ti (Td + Tf).

    Raises Refused, OUTSIDE_RANGE, where the roots are complex: without a filter that is for Ti < 4 Td.
    """
    _check_isa(gains)
    if gains.Td == 0.0 or gains.Ti == 0.0:
        # without the integral the filter is one of the lead's two poles still: Kp (1 + (Td + Tf) s)/(1 + Tf s)
        lead = gains.Td + gains.Tf if gains.Td > 0.0 else 0.0
        return Series(gains.Kp, gains.Ti, lead, gains.Tf if gains.Td > 0.0 else 0.0)
    total, product = gains.Ti + gains.Tf, gains.Ti * (gains.Td + gains.Tf)
    root = total * total - 4.0 * product
    if root < -1e-12 * total * total:
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"no series form: its zeros are complex for Ti = {gains.Ti:g} s, Td = {gains.Td:g} s, Tf = {gains.Tf:g} s; "
            "without a filter Ti >= 4 Td is accepted",
        )
    Ti = 0.5 * (total + math.sqrt(max(root, 0.0)))
    return Series(gains.Kp * Ti / gains.Ti, Ti, product / Ti, gains.Tf)


def of_series(form: Series) -> Gains:
    """The ISA gains of a series form: their Ti is Ti + Td - Tf, their Td is (Ti - Tf)(Td - Tf)/(Ti + Td - Tf), their Kp
    is Kp (Ti + Td - Tf)/Ti, with the form's values on the right. Raises Refused, OUTSIDE_RANGE, where the filter is too
    long.
    """
    _check(positive={"Kp": form.Kp}, not_negative={"Ti": form.Ti, "Td": form.Td, "Tf": form.Tf})
    if form.Ti == 0.0:
        Kp, Ti, Td = form.Kp, 0.0, form.Td - form.Tf
    else:
        Ti = form.Ti + form.Td - form.Tf
        Kp = form.Kp * Ti / form.Ti
        Td = (form.Ti - form.Tf) * (form.Td - form.Tf) / Ti if Ti > 0.0 else -1.0
    if Td < 0.0:
        raise Refused(
            Reason.OUTSIDE_RANGE,
            f"no ISA form: Tf = {form.Tf:g} s must be shorter than Ti = {form.Ti:g} s and Td = {form.Td:g} s",
        )
    return Gains(Kp, Ti, Td, form.Tf)


def _check_isa(gains: Gains) -> None:
    _check(positive={"Kp": gains.Kp}, not_negative={"Ti": gains.Ti, "Td": gains.Td, "Tf": gains.Tf})


def _check(positive: dict[str, float], not_negative: dict[str, float] | None = None) -> None:
    for name, value in positive.items():
        if not (math.isfinite(value) and value > 0.0):
            raise Refused(Reason.BAD_INPUT, f"{name} must be a number > 0, not {value!r}")
    for name, value in (not_negative or {}).items():
        if not (math.isfinite(value) and value >= 0.0):
            raise Refused(Reason.BAD_INPUT, f"{name} must be a number >= 0, not {value!r}")
