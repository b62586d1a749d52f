"""What a controller that does not do what its gains say does instead, in words; and the refusal without a model."""

from __future__ import annotations

from loopwright.tuning.experiments.control_law import ControlLaw, LawDifference, alternatives
from loopwright.tuning.experiments.control_record import control_record
from loopwright.tuning.experiments.controller_check import ControllerCheck, OtherLaw, check_controller
from loopwright.tuning.experiments.primitives import Facts, Trace
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Reason, Refused

GAIN, INTEGRAL_TIME = (0.87, 1.15), (0.75, 1.9)
"""Factors of Kp and of Ti outside which an Ms of 1.6 would be off by more than 0.1 on nearly any plant."""
FILTER_T95 = 0.05
"""Time constant of a filter of PV, in T95, that only a model of the plant tells harmless."""
MAX_WEIGHT = 0.2
"""Largest difference of a set-point weight, which does not change Ms but how PV answers the set-point."""
MAX_AWAY, ROUNDINGS = 0.15, 2.0
"""MV that no law explains is that of another controller where it is usually further away from the computed MV than this
part of its motion, and further than this many rounding errors of the record."""


def law_instead(other: OtherLaw, gains: Gains, Ts: float) -> ControlLaw | None:
    """The law that a controller with this deviation has for these gains, None where there is none."""
    found = next(each for each in alternatives(gains, Ts) if each.kind is other.kind)
    return found.law(gains, found.neutral if other.size is None else other.size)


def in_words(check: ControllerCheck, gains: Gains) -> str:
    """How far the recorded MV is from the computed one, and what fits instead. gains: those that are said to be in
    effect."""
    away = (
        f"MV on record is {100.0 * check.away:.2g} % of its motion away from what the controller's gains "
        f"(Kp {gains.Kp:.4g}{f', Ti {gains.Ti:.4g} s' if gains.Ti > 0.0 else ''}"
        f"{f', Td {gains.Td:.4g} s' if gains.Td > 0.0 else ''}) make of set-point and PV"
    )
    if check.other is None:
        return f"{away}, and none of the other laws that were tried gives it"
    return f"{away}; {_instead(check.other, gains)} fits instead, and leaves {100.0 * check.other.left:.2g} %"


def _instead(other: OtherLaw, gains: Gains) -> str:
    size = "" if other.size is None else f"{other.size:.3g} +- {2.0 * (other.deviation or 0.0):.1g}"
    match other.kind:
        case LawDifference.GAIN:
            return f"Kp times {size}"
        case LawDifference.INTEGRAL_TIME:
            return f"Ti times {size}"
        case LawDifference.PV_FILTER:
            return f"a filter of PV inside the controller of {size} s"
        case LawDifference.SETPOINT_WEIGHT:
            return f"a set-point weight b of {size} in place of {gains.b:.3g}"
        case LawDifference.DERIVATIVE_ON_ERROR:
            return f"a derivative of the error (set-point weight c of {size} in place of {gains.c:.3g})"
        case LawDifference.PARALLEL:
            same = f", here Ti times {gains.Kp:.3g}" if gains.Ti > 0.0 else ""
            return f"the parallel form (integral{' and derivative' if gains.Td > 0.0 else ''} not times Kp{same})"
        case LawDifference.SERIES:
            return "the series form (Kp, Ti and Td interact)"
    return "a derivative without its filter"


def mismatch_of(check: ControllerCheck, gains: Gains, T95_s: float) -> str | None:
    """What the controller does instead, in words, where its law makes gains wrong on any plant; None where it does not,
    or only a model of the plant could tell.

    gains: those that are said to be in effect.
    """
    if check.exact:
        return None
    text, other = in_words(check, gains), check.other
    if other is None:
        return text if is_unexplained(check) else None
    kind, size = other.kind, other.size
    if kind is LawDifference.PARALLEL:
        kind, size = LawDifference.INTEGRAL_TIME, gains.Kp
    match kind:
        case LawDifference.NO_DERIVATIVE_FILTER:
            return f"{text}: the noise would move MV far more than the gains say"
        case LawDifference.SETPOINT_WEIGHT | LawDifference.DERIVATIVE_ON_ERROR:
            weight = gains.b if kind is LawDifference.SETPOINT_WEIGHT else gains.c
            far = size is not None and abs(size - weight) > MAX_WEIGHT
            return f"{text}: PV would answer the set-point otherwise" if far else None
        case LawDifference.GAIN:
            low, high = GAIN
        case LawDifference.INTEGRAL_TIME:
            low, high = INTEGRAL_TIME
        case LawDifference.PV_FILTER:
            low, high = 0.0, FILTER_T95 * T95_s
        case _:
            return None
    return None if size is None or low <= size <= high else text


def is_unexplained(check: ControllerCheck) -> bool:
    """Whether MV on record is that of another controller, although no law that was tried gives it."""
    return check.other is None and check.usually_away > max(MAX_AWAY, ROUNDINGS * check.rounded)


def check_law_at_rest(facts: Facts, listened: Trace) -> None:
    """Raises Refused, CONTROLLER_MISMATCH, where the time at rest shows that the controller has another law than it is
    said to have. listened: the samples at rest, in automatic."""
    check = _checked(facts, listened, facts.previous_gains)
    if check.other is not None and (text := mismatch_of(check, facts.previous_gains, facts.T95_s)) is not None:
        raise Refused(Reason.CONTROLLER_MISMATCH, f"at rest {text}")


def check_law_in_step(facts: Facts, step: Trace, gains: Gains) -> None:
    """Raises Refused, CONTROLLER_MISMATCH, where a set-point step shows another law. gains: those in effect."""
    if (text := mismatch_of(_checked(facts, step, gains), gains, facts.T95_s)) is not None:
        raise Refused(Reason.CONTROLLER_MISMATCH, f"in the set-point step {text}")


def _checked(facts: Facts, trace: Trace, gains: Gains) -> ControllerCheck:
    return check_controller(control_record(facts, trace, [(0, len(trace), gains)]))
