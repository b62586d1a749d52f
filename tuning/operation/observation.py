"""What the set-point changes of normal operation tell of the plant, and of the gains that would be the best.

Every set-point change is a piece of one record: one plant for all, a level and a start of its own for each. The gains
are proposed when their Ms is known well enough and further checks agree: each change left out in turn, and what the
set-point alone moved (`setpoint_alone`), which finds the bias that loads and noise in a closed loop cause. Source of
the latter: P. Van den Hof, R. Schrama, Automatica 29, 1993.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopwright.tuning.analysis.margins import ultimate_point
from loopwright.tuning.experiments.control_record import ControlPiece, ControlRecord, rows_without_limit
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.controller_effect import with_controller
from loopwright.tuning.fast.evaluation.evaluation import MAX_UNCERTAINTY, Evaluation, evaluate
from loopwright.tuning.fast.evaluation.record_evaluation import PERIOD_IS_RIGHT, first_period
from loopwright.tuning.fast.evaluation.robustness import KnownMs, known_Ms
from loopwright.tuning.fast.record import LONGEST_DEAD_TIME, MIN_LISTENED, Excitation, ExperimentRecord, noise_of
from loopwright.tuning.fast.score_tests.score_tests import STANDARD_DEVIATIONS, ScoreTests, since
from loopwright.tuning.fast.score_tests.what_hides import OF_THE_RECORD, of_pv
from loopwright.tuning.gains import Gains
from loopwright.tuning.identification.disturbances import MIN_BIC_GAIN
from loopwright.tuning.operation.consistency import consistent
from loopwright.tuning.operation.faulty_valve import FaultyValve, likeliest_fault
from loopwright.tuning.operation.history import (
    HistoryPart,
    SetpointChange,
    Stretch,
    parts_at_rest,
    require_operator,
    setpoint_changes,
)
from loopwright.tuning.operation.plausible_models import Doubt, PlausibleModels, plausible_models
from loopwright.tuning.operation.setpoint_alone import Ms_by_setpoint_alone
from loopwright.tuning.reasons import Ended, Reason, Refused

BEFORE, AFTER = 1.0, 5.0
"""Periods before and after its first move that a set-point change is looked at."""
REST_PERIODS, REST_QUANTILE = (8.0, 4.0), 0.4
"""Length of a quiet part, in periods, and the shorter one where there is no such part; the quantile of the noise of all
quiet parts that is taken for the noise."""
MIN_SIZE = 5.0
"""Smallest set-point change that is looked at, in standard deviations of the noise."""
MIN_CHANGES, MAX_CHANGES = 2, 12
"""Smallest number of set-point changes that can check each other, and the largest number that are looked at together:
the latest ones."""
MIN_GAIN_CHANGE = 0.1
"""Smallest part by which the plant's gain must differ from one set-point change on for the earlier ones to be of an
older plant."""
MIN_LATER, LATER_DEVIATIONS = 0.03, 3.0
"""Smallest part of an ultimate period, and smallest number of standard deviations, by which the dead time must be
longer or shorter from one set-point change on. To leave earlier ones out by chance costs a few changes only."""
MIN_RESIDUAL = 0.7
"""Smallest residual of the model, in standard deviations of the noise at rest. A smaller one shows that the loop was
not at rest there, and that the residual was compared with more than the noise."""
MAX_BY_SETPOINT = 0.08
"""Largest difference of Ms by the set-point alone."""
REFITS, MAX_PERIOD_CHANGE = 4, 3.0
"""Number of times that the changes are looked at again with the ultimate period that the model has; the largest factor
between two of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What operation tells.

    reason: the reason why no gains are proposed; None where they are.
    detail: what is missing or what speaks against them, in a sentence with the numbers.
    evaluation: the evaluation of the record of all changes used, None without one.
    used: the changes that belong to one plant.
    dropped: further changes, which do not fit these.
    models: what else the record leaves possible, None where that was not looked at.
    valve: the fault of the valve that explains the record better; the model is then from the valve's position to PV.
    """

    reason: Reason | None
    detail: str
    evaluation: Evaluation | None = None
    used: tuple[SetpointChange, ...] = ()
    dropped: tuple[SetpointChange, ...] = ()
    models: PlausibleModels | None = None
    valve: FaultyValve | None = None

    @property
    def known_to(self) -> float | None:
        """How far Ms of the designed gains may be off, at best where none are proposed; None without a model."""
        return None if self.evaluation is None else self.known_Ms(self.evaluation.best.gains).uncertainty

    def known_Ms(self, gains: Gains) -> KnownMs:
        """Ms of these gains, with everything that may be wrong of it as far as that was looked at."""
        if self.models is not None:
            return self.models.known_Ms(gains)
        return KnownMs(None, None) if self.evaluation is None else known_Ms(self.evaluation, gains)


def observe(stretches: Sequence[Stretch], reverse: bool, spec: DesignSpec) -> Observation:
    """What the stretches of operation, oldest first and of one sample time, tell of the best gains.

    reverse: the action of the controller, see `Facts`.
    Raises Refused, SETPOINT_IS_DRIVEN.
    """
    known = [each for each in stretches if each.moves]
    require_operator(list(stretches))
    if not known:
        return Observation(Reason.UNCERTAIN, "no set-point change has been heard yet")
    try:
        return _named(_observed(known, stretches, reverse, spec), known)
    except Refused as refused:
        return Observation(refused.reason, refused.detail)


def _named(found: Observation, stretches: Sequence[Stretch]) -> Observation:
    """The observation, which names what hides in PV where its record is not explained."""
    if found.evaluation is None or found.reason not in OF_THE_RECORD:
        return found
    named = next(filter(None, (of_pv(each.pv, each.Ts) for each in stretches if each.held_s is None)), None)
    if named is None:
        return found
    known = found.reason in (Reason.UNCERTAIN, Reason.AMBIGUOUS)  # the model is right as far as it is known
    return replace(
        found,
        reason=found.reason if known else Reason.PV_ALTERED,
        detail=f"{named}; {found.detail}" if known else named,
    )


def _observed(known: list[Stretch], stretches: Sequence[Stretch], reverse: bool, spec: DesignSpec) -> Observation:
    period = _first_period(known)
    found: Observation | None = None
    for _ in range(1 + REFITS):
        again = _at(period, stretches, reverse, spec)
        if again.evaluation is None:
            return _without_scale(found, again.detail) if found else again
        found = again
        own = _own_period(again.evaluation)
        low, high = PERIOD_IS_RIGHT
        if low <= own / period <= high:
            return found
        period = min(max(own, period / MAX_PERIOD_CHANGE), period * MAX_PERIOD_CHANGE)
    assert found is not None
    return _without_scale(found, "the ultimate period is another one with each length that the changes are looked at")


def _without_scale(found: Observation, detail: str) -> Observation:
    """The observation as one whose changes were not looked at for as long as its model asks for: of no gains."""
    return found if found.reason is not None else replace(found, reason=Reason.UNCERTAIN, detail=detail)


def _own_period(evaluation: Evaluation) -> float:
    """The ultimate period of the model, in samples; a model that cannot oscillate has the period that it was designed
    at."""
    model = evaluation.model
    try:
        return ultimate_point(replace(model, L=model.L + evaluation.design_delay))[1] / evaluation.fit.record.Ts
    except Ended:
        return evaluation.period / evaluation.fit.record.Ts


def _first_period(stretches: Sequence[Stretch]) -> float:
    """The time scale of the largest set-point change, in samples. Raises Refused."""
    sizes = [(abs(float(each.sp[k] - each.sp[k - 1])), each, k) for each in stretches for k in each.moves]
    _, stretch, move = max(sizes, key=lambda each: each[0])
    later = [k for k in stretch.moves if k > move]
    before = max([k for k in stretch.moves if k < move], default=0)
    end = later[0] if later else len(stretch.sp)
    rest = slice(max(before, move - (end - move) // 2), move)
    if rest.stop - rest.start < 1:
        rest = slice(move - 1, move)
    u = stretch.mv[move:end] - float(np.mean(stretch.mv[rest]))
    y = stretch.pv[move:end] - float(np.mean(stretch.pv[rest]))
    return first_period(u, y, stretch.Ts)


def _at(period: float, stretches: Sequence[Stretch], reverse: bool, spec: DesignSpec) -> Observation:
    """What the changes tell at a time scale, in samples."""
    before, after = max(round(BEFORE * period), 2), max(round(AFTER * period), 20)
    lengths = (max(round(each * period), MIN_LISTENED) for each in REST_PERIODS)
    rest = next(filter(None, (_rest(stretches, length, after) for length in lengths)), None)
    if rest is None:
        text = f"the loop has not rested for {REST_PERIODS[-1]:g} ultimate periods with its set-point unmoved"
        return Observation(Reason.UNCERTAIN, text)
    noise = noise_of(rest.stretch.pv[rest.samples])
    changes = [each for s in stretches for each in setpoint_changes(s, before, after, MIN_SIZE * noise)]
    if not changes:
        text = f"no set-point change of {MIN_SIZE * noise:.3g} or more, followed for {AFTER:g} ultimate periods"
        return Observation(Reason.UNCERTAIN, text)
    latest = changes[-MAX_CHANGES:]
    used = [
        latest[i]
        for i in consistent(lambda which: _record(rest, [latest[i] for i in which], reverse, period), len(latest))
    ]
    evaluation = with_controller(evaluate(_record(rest, used, reverse, period), spec))
    together = len(used)
    while (older := _of_an_older_plant(evaluation, len(used))) > 0:
        used = used[older:]
        evaluation = with_controller(evaluate(_record(rest, used, reverse, period), spec))
    dropped = tuple(each for each in latest if each not in used)
    reason, detail = evaluation.reason, evaluation.detail
    if reason is None and len(latest) - together > together:
        reason = Reason.DISTURBED
        detail = f"one plant without disturbances explains only {together} of {len(latest)} set-point changes"
    if reason is None and latest[-1] not in used:
        text = "the latest set-point change does not fit the earlier ones"
        reason, detail = Reason.DISTURBED, f"{text}: it was disturbed, or the plant has changed; wait for the next"
    if reason is None and len(used) < MIN_CHANGES:
        reason, detail = Reason.UNCERTAIN, "one set-point change alone cannot be checked by another; wait for the next"
    found = Observation(reason, detail, evaluation, tuple(used), dropped)
    return found if found.reason is not None else _checked(found, _parts(rest, used), spec)


def _of_an_older_plant(evaluation: Evaluation, changes: int) -> int:
    """How many of the set-point changes, the oldest ones, are of a plant of another gain or dead time; 0 where none
    are."""
    tests, earlier = ScoreTests(evaluation.fit, evaluation.chosen.best), evaluation.fit.record.u_earlier
    shown = []
    for older in range(1, changes):  # the first piece is the rest
        before = tuple(u if piece > older else np.zeros(len(u)) for piece, u in enumerate(earlier))
        size, deviation = tests.score(since(1 + older), before)
        if abs(size) > max(MIN_GAIN_CHANGE, STANDARD_DEVIATIONS * deviation):
            shown.append((abs(size) / deviation, older))
        later, deviation = tests.later_since(1 + older)
        if abs(later) > max(MIN_LATER * evaluation.fit.period, LATER_DEVIATIONS * deviation):
            shown.append((abs(later) / deviation, older))
    return max(shown, default=(0.0, 0))[1]


def _rest(stretches: Sequence[Stretch], length: int, after: int) -> HistoryPart | None:
    """The quiet part whose noise is at the quantile of all quiet parts."""
    parts = [HistoryPart(each, part, part) for each in stretches for part in parts_at_rest(each, length, after)]
    parts.sort(key=lambda each: noise_of(each.stretch.pv[each.samples]))
    return parts[int(REST_QUANTILE * (len(parts) - 1))] if parts else None


def _parts(rest: HistoryPart, changes: Sequence[SetpointChange]) -> list[HistoryPart]:
    return [rest, *(HistoryPart(each.stretch, each.samples, slice(each.first, each.move)) for each in changes)]


def _record(rest: HistoryPart, changes: Sequence[SetpointChange], reverse: bool, period: float) -> ExperimentRecord:
    """The rest and the changes as one record of several pieces. Raises Refused as `ExperimentRecord`."""
    stretch, parts = rest.stretch, _parts(rest, changes)
    u = [each.deviations(each.stretch.mv) for each in parts]
    y = [each.deviations(each.stretch.pv) for each in parts]
    lengths, longest = tuple(map(len, u)), math.ceil(LONGEST_DEAD_TIME * period) + 1
    return ExperimentRecord(
        Ts=stretch.Ts,
        u=np.concatenate(u),
        y=np.concatenate(y),
        direction=1.0 if reverse else -1.0,
        listened=lengths[0],
        excited=sum(lengths),
        turns=len(changes),
        period=period,
        excitation=Excitation.OBSERVE,
        lengths=lengths,
        u_earlier=tuple(each.deviations_before(each.stretch.mv, longest) for each in parts),
        held_s=stretch.held_s,
        control=_control(parts, stretch.Ts, reverse) if stretch.held_s is None else None,
    )


def _control(parts: Sequence[HistoryPart], Ts: float, reverse: bool) -> ControlRecord:
    """What the samples of the parts show of the controller; means of several samples would not tell."""
    return ControlRecord(
        Ts,
        reverse,
        tuple(
            ControlPiece(s.gains, s.sp[at][rows], s.pv[at][rows], s.mv[at][rows])
            for s, at in ((each.stretch, each.samples) for each in parts)
            for rows in rows_without_limit(s.mv[at])
        ),
    )


def _checked(found: Observation, parts: Sequence[HistoryPart], spec: DesignSpec) -> Observation:
    """The observation, without gains where a check of the whole speaks against them."""
    evaluation, changes = found.evaluation, found.used
    assert evaluation is not None
    if evaluation.residual < MIN_RESIDUAL:
        text = f"the model leaves {evaluation.residual:.2g} of what moved PV where the loop seemed to rest"
        detail = f"{text}: something else moved PV there, and the noise is not known"
        return replace(found, reason=Reason.UNCERTAIN, detail=detail)
    limit = MAX_UNCERTAINTY[Excitation.OBSERVE]
    models = plausible_models(evaluation)
    doubt = models.doubt(evaluation.best.gains)
    if found.valve is None and doubt is not None and doubt.whole <= limit:
        likeliest = likeliest_fault(evaluation.fit, evaluation.chosen.best, parts)
        if likeliest is not None and (with_valve := _with_valve(found, likeliest, spec)) is not None:
            return with_valve if with_valve.reason is not None else _checked(with_valve, parts, spec)
        models = models.with_valve(parts, likeliest)
        doubt = models.doubt(evaluation.best.gains)
    found = replace(found, models=models)
    if doubt is None or doubt.whole > limit:
        return replace(found, reason=Reason.UNCERTAIN, detail=_in_words(doubt, len(changes)))
    alone = Ms_by_setpoint_alone(evaluation, changes, spec.N)
    if abs(alone - evaluation.Ms) > MAX_BY_SETPOINT:
        detail = f"what the set-point alone moved gives Ms {alone:.2f} instead of {evaluation.Ms:.2f}"
        return replace(found, reason=Reason.DISTURBED, detail=detail)
    return found


def _with_valve(found: Observation, valve: FaultyValve, spec: DesignSpec) -> Observation | None:
    """The observation with the position of this valve in place of MV, None where that does not explain the record
    better."""
    assert found.evaluation is not None
    if not valve.clear:
        return None
    fit = found.evaluation.fit
    evaluation = with_controller(evaluate(replace(fit.record, u=valve.u, u_earlier=valve.u_earlier), spec))
    if evaluation.chosen.best.bic > found.evaluation.chosen.best.bic - MIN_BIC_GAIN:
        return None
    return replace(found, reason=evaluation.reason, detail=evaluation.detail, evaluation=evaluation, valve=valve)


def _in_words(doubt: Doubt | None, changes: int) -> str:
    if doubt is None:
        return "Ms is not known: the loop is not stable on the model"
    parts = f"{doubt.standard_error:.2g} by its standard error, {doubt.on_others:.2g} on another model"
    parts += f", {doubt.on_valve:.2g} with a valve that moves a little less than MV" if doubt.on_valve else ""
    text = f"{doubt.left_out:.2g} without one of the {changes} set-point changes"
    return f"Ms is known to +-{doubt.whole:.2g} only: {parts}, {text}"
