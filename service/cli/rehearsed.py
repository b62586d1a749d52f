"""A rehearsal and its samples as a plot takes those of a job."""

from __future__ import annotations

from dataclasses import dataclass

from loopwright.service.cli.plots.shown import ShownSamples
from loopwright.service.execution.rehearsed import Rehearsal, RehearsalRecord
from loopwright.service.results import (
    EvidenceView,
    FastResult,
    GainsView,
    ModelView,
    TransferModelView,
    VerificationView,
)
from loopwright.service.states.job_state import JobState, state_after
from loopwright.tuning.reasons import Reason


def shown_samples(record: RehearsalRecord, stage: str | None) -> ShownSamples:
    """Returns the samples of one stage, or all for None, as columns."""
    pairs = zip(record.stages, record.samples, strict=True)
    of = [(name, each) for name, each in pairs if stage is None or name == stage]
    return ShownSamples(
        stage=[name for name, _ in of],
        t_s=[each.t for _, each in of],
        sp=[each.sp for _, each in of],
        pv=[each.pv for _, each in of],
        mv=[each.mv for _, each in of],
        mode=[int(each.mode) for _, each in of],
    )


@dataclass
class RehearsedJob:
    """A rehearsal as a plot takes a job; see `Shown`."""

    loop: str
    method: str
    state: JobState
    reason: Reason | None
    detail: str | None
    advice: str | None
    model: ModelView | TransferModelView | None
    previous_gains: GainsView | None
    new_gains: GainsView | None
    evidence: EvidenceView | None
    verification: VerificationView | None
    id: str = "of this rehearsal"
    sample_time_s: float | None = None


def rehearsed_job(found: Rehearsal, method: str) -> RehearsedJob:
    """Returns a rehearsal as a job."""
    ended, result = found.ended, found.result
    fast = result if isinstance(result, FastResult) else None
    return RehearsedJob(
        loop="rehearsal" if found.plant is None or not found.plant.name else found.plant.name,
        method=method,
        state=JobState.PROPOSED if ended is None else state_after(ended),
        reason=ended.reason if ended else None,
        detail=ended.detail if ended else None,
        advice=ended.advice if ended else None,
        model=result.model,
        previous_gains=result.previous_gains,
        new_gains=result.new_gains,
        evidence=fast.evidence if fast else None,
        verification=fast.verification if fast else None,
        sample_time_s=None if found.plant is None else found.plant.sample_time_s,
    )
