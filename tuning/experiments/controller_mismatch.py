"""What a controller that does not do what its gains say does instead, in words; and the refusal of it at rest."""

from __future__ import annotations

from collections.abc import Sequence

from loopwright.tuning.experiments.control_law import ControlLaw, Deviation, alternatives
from loopwright.tuning.experiments.control_record import control_record
from loopwright.tuning.experiments.controller_check import ControllerCheck, OtherLaw, check_controller
from loopwright.tuning.experiments.primitives import Facts, Trace
from loopwright.tuning.gains import Gains
from loopwright.tuning.reasons import Reason, Refused

GAIN_AT_REST = (0.87, 1.15)
"""Factors of Kp at rest within which the test goes on: outside, an Ms of 1.6 would be off by more than 0.1."""
INTEGRAL_TIME_AT_REST = (0.75, 2.0)
"""The same of Ti; too long a Ti makes a loop slower, and Ms lower."""
FILTER_AT_REST_T95 = 0.05
"""Time constant of a filter of PV at rest up to which the test goes on, in T95. A model tells later what it does."""


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
        case Deviation.GAIN:
            return f"Kp times {size}"
        case Deviation.INTEGRAL_TIME:
            return f"Ti times {size}"
        case Deviation.PV_FILTER:
            return f"a filter of PV inside the controller of {size} s"
        case Deviation.SETPOINT_WEIGHT:
            return f"a set-point weight b of {size} in place of {gains.b:.3g}"
        case Deviation.DERIVATIVE_ON_ERROR:
            return f"a derivative of the error (set-point weight c of {size} in place of {gains.c:.3g})"
        case Deviation.PARALLEL:
            same = f", here Ti times {gains.Kp:.3g}" if gains.Ti > 0.0 else ""
            return f"the parallel form (integral{' and derivative' if gains.Td > 0.0 else ''} not times Kp{same})"
        case Deviation.SERIES:
            return "the series form (Kp, Ti and Td interact)"
    return "a derivative without its filter"


def mismatch_at_rest(check: ControllerCheck, facts: Facts) -> Refused | None:
    """The refusal where the noise at rest alone has shown another law, whose gains would be wrong on any plant."""
    other = check.other
    if other is None:
        return None
    kind, size = other.kind, other.size
    if kind is Deviation.PARALLEL:
        kind, size = Deviation.INTEGRAL_TIME, facts.old_gains.Kp
    wrong = kind is Deviation.NO_DERIVATIVE_FILTER
    if size is not None:
        for factor, (low, high) in ((Deviation.GAIN, GAIN_AT_REST), (Deviation.INTEGRAL_TIME, INTEGRAL_TIME_AT_REST)):
            wrong |= kind is factor and not low <= size <= high
        wrong |= kind is Deviation.PV_FILTER and size > FILTER_AT_REST_T95 * facts.T95_s
    return Refused(Reason.CONTROLLER_MISMATCH, f"at rest {in_words(check, facts.old_gains)}") if wrong else None


def check_law_at_rest(facts: Facts, listened: Trace) -> None:
    """Raises Refused, CONTROLLER_MISMATCH, where the time at rest shows that the controller has another law than it is
    said to have. listened: the samples at rest, in automatic."""
    check = check_controller(control_record(facts, listened, whole(listened, facts.old_gains)))
    refused = mismatch_at_rest(check, facts)
    if refused is not None:
        raise refused


def whole(trace: Trace, gains: Gains) -> Sequence[tuple[int, int, Gains]]:
    """The gains of `control_record` where they do not change."""
    return [(0, len(trace), gains)]
