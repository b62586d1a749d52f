"""What is computed of a job after its end: its record with the model, and the gains from robust to fast. Pure."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from loopwright.service.errors import Conflict
from loopwright.service.jobs.alternatives import asked_spec, designable, job_model
from loopwright.service.jobs.design_curve import DesignCurve, design_curve
from loopwright.service.jobs.job_record import FittedRecord, JobRecord, job_record, unpack
from loopwright.service.jobs.stored_record import StoredRecord, last_attempt, record_columns, record_of
from loopwright.service.planning.found_model import FoundModel
from loopwright.service.results import DESIGNED, FastResult, LoadStepView
from loopwright.service.store.jobs import Job, JobEvent
from loopwright.service.store.packed_figures import PackedFigures
from loopwright.service.store.sample_blocks import Block
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.evaluation import Evaluation
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.reasons import Ended

log = logging.getLogger(__name__)

VERSION = 2
"""Version of this computation. What another version has stored is computed anew."""
_HIGHEST_MS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class JobFigures:
    """What was computed of a job. record: None without samples.  designs: None without a model that may be used."""

    record: JobRecord | None
    designs: DesignCurve | None

    def pack(self) -> PackedFigures:
        """Returns the figures as bytes."""
        designs = None if self.designs is None else zlib.compress(self.designs.model_dump_json().encode())
        return PackedFigures(None if self.record is None else self.record.pack(), designs)


def unpacked(figures: PackedFigures) -> JobFigures:
    """Returns the figures that were packed."""
    designs = None
    if figures.designs is not None:
        designs = DesignCurve.model_validate_json(zlib.decompress(figures.designs))
    return JobFigures(None if figures.record is None else unpack(figures.record), designs)


def job_figures(row: Job, events: Sequence[JobEvent], blocks: Sequence[Block]) -> JobFigures:
    """Returns the figures of a job that is over.

    events: those of the job.
    blocks: its samples.
    """
    attempt = last_attempt(record_columns(blocks))
    record = record_of(attempt) if attempt is not None and row.request.get("method") in DESIGNED else None
    model: FoundModel | None = None
    with suppress(Conflict):
        model = job_model(row, events)
    evaluation = None if record is None else _evaluated(row, record)
    shown = None
    if attempt is not None:
        fitted = None
        if record is not None and evaluation is not None:
            fitted = FittedRecord(record, evaluation.fit, evaluation.chosen.best)
        shown = job_record(attempt, fitted, model, _loads(row, events), _noise(events, fitted))
    designs = None
    with suppress(Conflict):
        designs = _designs(row, designable(row, events, evaluation is not None), evaluation)
    return JobFigures(shown, designs)


def _designs(row: Job, model: FoundModel, evaluation: Evaluation | None) -> DesignCurve | None:
    try:
        return design_curve(row, model, evaluation)
    except (Ended, ArithmeticError, ValueError):  # the record is shown all the same
        log.exception("no gains from robust to fast could be designed for job %s", row.id)
        return None


def _evaluated(row: Job, record: StoredRecord) -> Evaluation | None:
    """Returns the evaluation of the record for the Ms asked. The model does not depend on Ms; where no gains have the
    Ms asked, the evaluation is that for a larger one."""
    evidence = record.experiment_record()
    if evidence is None:
        return None
    asked = row.request.get("Ms")
    for Ms in (float(asked) if isinstance(asked, int | float) else DesignSpec().Ms, _HIGHEST_MS):
        try:
            return evaluate_again(evidence, asked_spec(row, Ms))
        except Ended as ended:
            log.info("job %s has no model of its record for Ms %g: %s", row.id, Ms, ended.detail)
        except (ArithmeticError, ValueError):  # the record is shown all the same
            log.exception("the record of job %s could not be evaluated", row.id)
    return None


def _loads(row: Job, events: Sequence[JobEvent]) -> Sequence[LoadStepView]:
    """Returns the load disturbances of the result; for a job without one, those of its latest design stage."""
    if isinstance(row.result, FastResult) and row.result.evidence is not None:
        return row.result.evidence.loads
    for done in (event.stage_ended() for event in reversed(events)):
        if done and done.result and isinstance(loads := done.result.get("loads"), list):
            return [LoadStepView.model_validate(each) for each in loads]
    return ()


def _noise(events: Sequence[JobEvent], fitted: FittedRecord | None) -> float | None:
    """Returns the standard deviation of PV at rest, PV units."""
    if fitted is not None:
        return fitted.fit.record.noise
    for done in (event.stage_ended() for event in reversed(events)):
        if done and done.result and isinstance(noise := done.result.get("noise"), int | float):
            return float(noise)
    return None
