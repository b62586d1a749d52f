"""What is known of a loop: findings of tests and of normal operation, and which of them is in effect. Pure.

Two findings agree where the Ms that their models give the present gains differ by no more than both uncertainties
together. Where they do not, the newer one is what is known, and the older one is of an older plant. Of those that agree
the one with the smallest uncertainty is what is known. They are not averaged: the errors of two models of the same
structures are not independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple
from datetime import datetime
from functools import lru_cache

from loopwright.service.observing.observed import ObservationState, ObservationView
from loopwright.service.results import (
    FastResult,
    Finding,
    FindingSource,
    GainsView,
    KnowledgeView,
    KnownGainsView,
    KnownMsView,
    RangeView,
    TransferModelView,
)
from loopwright.service.states.loop_state import same_gains
from loopwright.service.store.clock import stamp
from loopwright.service.store.jobs import Job
from loopwright.service.store.knowledge import Known
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import TransferFunction
from loopwright.tuning.reasons import Ended

SAME_CHANGE_S = 1.0
"""Difference of two times within which they are the time of the same set-point change, s, where the samples are
shorter."""
SAME_GAINS = 0.02
"""Largest relative difference of gains whose Ms is known equally well."""


# -- findings


def of_observation(found: ObservationView, Ms_asked: float, sample_time_s: float, at: datetime) -> Finding | None:
    """What an observation has shown; None where it had no answer.

    sample_time_s: the sample time of the controller, s.
    """
    if found.state is ObservationState.MISSING or found.model is None or found.proposed is None:
        return None
    return Finding(
        source=FindingSource.OPERATION,
        at=stamp(at),
        changes=len(found.changes_used),
        last_change_s=max(each.at_s for each in found.changes_used),
        sample_s=found.data.sample_s,
        present=found.present,
        proposed=found.proposed,
        Ms_asked=Ms_asked,
        model=found.model,
        sampling_delay_s=0.5 * sample_time_s,
        pv_range=found.pv_range,
        mv_range=found.mv_range,
    )


def of_test(
    job: Job, sample_time_s: float, pv_range: tuple[float, float] | None, mv_range: tuple[float, float] | None
) -> Finding | None:
    """What a finished test has shown; None where its model has no uncertainty: that of five-stage, or one typed in.

    pv_range, mv_range: the ranges during the test.
    """
    found = job.result
    if job.dry_run or job.ended_at is None or not isinstance(found, FastResult):
        return None
    if found.model is None or found.evidence is None or found.previous_gains is None or found.known_previous is None:
        return None
    proposed: KnownGainsView | None = None
    if found.new_gains is not None and found.evidence.uncertainty is not None:
        known = max(found.evidence.uncertainty, found.evidence.ambiguity)
        proposed = KnownGainsView(gains=found.new_gains, Ms=found.evidence.Ms, uncertainty=known)
    before = found.known_previous
    return Finding(
        source=FindingSource.JOB,
        at=job.ended_at,
        job=job.id,
        method=found.method,
        present=KnownGainsView(gains=found.previous_gains, Ms=before.Ms, uncertainty=before.uncertainty),
        proposed=proposed,
        Ms_asked=found.comparison.Ms_asked if found.comparison else None,
        model=found.model,
        sampling_delay_s=0.5 * sample_time_s,
        pv_range=_range(pv_range),
        mv_range=_range(mv_range),
    )


def of_trial(job: Job, findings: Sequence[Known], at: datetime) -> Finding | None:
    """What an accepted trial of gains has shown, which were designed on the model of an earlier finding; None where no
    finding that is in effect has the model, or gives the gains the same Ms: a later look at the history may have taken
    the place of the one whose model it was."""
    found = job.result
    if not isinstance(found, FastResult) or found.model is None or not found.model.typed_in or found.new_gains is None:
        return None
    model, gains = found.model, found.new_gains
    in_effect = [each.finding for each in reversed(findings) if not each.superseded]
    base = next((each for each in in_effect if _same(each.model, model)), None)
    base = base or next((each for each in in_effect if _same_Ms(each, model, gains.gains())), None)
    if base is None:
        return None
    known = Ms_of(base, gains.gains(), SAME_GAINS)
    return base.model_copy(
        update={
            "source": FindingSource.TRIAL,
            "at": stamp(at),
            "job": job.id,
            "method": found.method,
            "proposed": KnownGainsView(gains=gains, Ms=known.Ms, uncertainty=known.uncertainty),
        }
    )


def _same(one: TransferModelView, other: TransferModelView) -> bool:
    return (one.num, one.den, one.dead_time_s) == (other.num, other.den, other.dead_time_s)


def _same_Ms(finding: Finding, model: TransferModelView, gains: Gains) -> bool:
    """Whether a finding gives gains the Ms that they have on a model, within the uncertainty of the finding."""
    Ms, on_model = (_Ms_on(_sampled(each, finding.sampling_delay_s), gains) for each in (finding.model, model))
    return Ms is not None and on_model is not None and abs(Ms - on_model) <= _largest(finding)


def _range(found: tuple[float, float] | None) -> RangeView | None:
    return None if found is None else RangeView(low=found[0], high=found[1])


def replaced(finding: Finding, findings: Sequence[Known]) -> list[int]:
    """The numbers of the findings whose place this one takes: of a trial the one whose gains were tried, and of normal
    operation those with the same latest set-point change."""
    return [each.number for each in findings if _repeats(finding, each.finding)]


def adds_nothing(finding: Finding, findings: Sequence[Known]) -> bool:
    """Whether the same is known better already: an earlier look had more of the history before the same latest
    set-point change."""
    return any(
        each.superseded is None
        and _repeats(finding, each.finding)
        and _disagreement(finding, each.finding) is None
        and _uncertainty(each.finding, finding.present.gains.gains()) < (finding.present.uncertainty or math.inf)
        for each in findings
        if finding.source is FindingSource.OPERATION
    )


def _repeats(newer: Finding, older: Finding) -> bool:
    if newer.source is FindingSource.TRIAL:
        return newer.model == older.model
    if not newer.source is older.source is FindingSource.OPERATION:
        return False
    if newer.last_change_s is None or older.last_change_s is None:
        return False
    return abs(older.last_change_s - newer.last_change_s) <= max(SAME_CHANGE_S, 2.0 * newer.sample_s)


def of_operation(findings: Sequence[Known]) -> list[int]:
    """The numbers of the findings that come from normal operation, tested on the loop or not, and count still."""
    return [each.number for each in findings if each.finding.changes is not None and each.superseded is None]


# -- what of them is in effect


def Ms_of(finding: Finding, gains: Gains, tolerance: float = 0.0) -> KnownMsView:
    """Ms of gains on the model of a finding. The uncertainty is known of the gains of the finding alone.

    tolerance: largest relative difference from these.
    """
    found = _found_with(finding, gains)
    if found is not None:
        return KnownMsView(Ms=found.Ms, uncertainty=found.uncertainty)
    close = (each.uncertainty for each in _both(finding) if tolerance and _close(each.gains.gains(), gains, tolerance))
    Ms = _Ms_on(_sampled(finding.model, finding.sampling_delay_s), gains)
    return KnownMsView(Ms=Ms, uncertainty=None if Ms is None else next(close, None))


def _both(finding: Finding) -> list[KnownGainsView]:
    return [each for each in (finding.present, finding.proposed) if each is not None]


def _found_with(finding: Finding, gains: Gains) -> KnownGainsView | None:
    """What a finding itself says of these gains; None for others than its own."""
    return next((each for each in _both(finding) if same_gains(each.gains.gains(), gains)), None)


def _sampled(model: TransferModelView, sampling_delay_s: float) -> TransferFunction:
    return TransferFunction(tuple(model.num), tuple(model.den), model.dead_time_s + sampling_delay_s)


@lru_cache(256)
def _Ms_on(plant: TransferFunction, gains: Gains) -> float | None:
    """Ms on a model; None where the loop is not stable on it. It takes 8 ms, and a page may ask every second."""
    try:
        found = margins(plant, gains)
    except Ended:
        return None
    return found.Ms if found.stable else None


def _close(one: Gains, other: Gains, tolerance: float) -> bool:
    pairs = zip(astuple(one), astuple(other), strict=True)
    return all(math.isclose(a, b, rel_tol=tolerance) for a, b in pairs)


def disagreeing(finding: Finding, findings: Sequence[Known]) -> dict[int, str]:
    """The findings that do not agree with a newer one, by number, each with the reason in words."""
    found = {}
    for each in findings:
        if each.superseded is None and (why := _disagreement(finding, each.finding)) is not None:
            found[each.number] = why
    return found


def _disagreement(newer: Finding, older: Finding) -> str | None:
    gains = newer.present.gains.gains()
    now, then = newer.present, Ms_of(older, gains)
    uncertainty = then.uncertainty if then.uncertainty is not None else _largest(older)
    if now.Ms is None or then.Ms is None:
        agree = now.Ms is then.Ms
    else:
        agree = abs(now.Ms - then.Ms) <= (now.uncertainty or 0.0) + uncertainty
    if agree:
        return None
    return (
        f"the model found {older.at} from {source_text(older)} gives the gains of {newer.at} "
        f"{_in_words(then.Ms, uncertainty)}, the one from {source_text(newer)} "
        f"{_in_words(now.Ms, now.uncertainty or 0.0)}: the plant is another one since, or differs with its range"
    )


def _largest(finding: Finding) -> float:
    """The largest uncertainty of a finding, for gains of which it has none."""
    return max(each.uncertainty or 0.0 for each in _both(finding))


def _in_words(Ms: float | None, uncertainty: float) -> str:
    return "no stable loop" if Ms is None else f"Ms {Ms:.3g} +- {uncertainty:.2g}"


def source_text(finding: Finding) -> str:
    """From what something is known, in words."""
    by_operation = f"{finding.changes} set-point change{'s' * (finding.changes != 1)} of normal operation"
    if finding.source is FindingSource.OPERATION:
        return by_operation
    if finding.source is FindingSource.JOB:
        return f"job {finding.job} ({finding.method})"
    tried = f"tried and accepted in job {finding.job}"
    return f"{by_operation}, {tried}" if finding.changes is not None else f"a test, {tried}"


def best(findings: Sequence[Known], gains: Gains) -> Known:
    """The one of these findings that knows Ms of the gains best, the latest of several; oldest first."""
    return min(reversed(findings), key=lambda each: _uncertainty(each.finding, gains))


def known(findings: Sequence[Known], gains: Gains | None) -> KnowledgeView | None:
    """What is known of a loop; None where nothing is.

    findings: oldest first.
    gains: the gains in effect; None: those of the latest finding.
    """
    valid = [each for each in findings if each.superseded is None]
    if not valid:
        return None
    gains = gains or valid[-1].finding.present.gains.gains()
    finding = best(valid, gains).finding
    found = Ms_of(finding, gains)
    proposed = finding.proposed
    if proposed is not None and same_gains(proposed.gains.gains(), gains):
        proposed = None
    return KnowledgeView(
        text=_sentence(found, finding),
        gains=GainsView.of(gains),
        Ms=found.Ms,
        uncertainty=found.uncertainty,
        source=finding.source,
        source_text=source_text(finding),
        changes=finding.changes,
        job=None if finding.job is None else f"/jobs/{finding.job}",
        at=finding.at,
        pv_range=finding.pv_range,
        mv_range=finding.mv_range,
        model=finding.model,
        proposed=proposed,
        Ms_asked=finding.Ms_asked,
        consistent=len(valid) - 1,
        superseded=next((each.superseded for each in reversed(findings) if each.superseded), None),
    )


def _uncertainty(finding: Finding, gains: Gains) -> float:
    """Infinite where it is not known."""
    found = _found_with(finding, gains)
    return math.inf if found is None or found.uncertainty is None else found.uncertainty


def _sentence(found: KnownMsView, finding: Finding) -> str:
    source = source_text(finding)
    if found.Ms is None:
        return f"the gains in effect are not stable on the model from {source}"
    if found.uncertainty is None:
        return f"Ms {found.Ms:.3g} on the model from {source}; how well it is known is not known for these gains"
    return f"Ms known to +-{found.uncertainty:.2g} from {source}"
