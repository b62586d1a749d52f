"""Each reason for which fast refuses, provoked in a rehearsal, with its picture and its place in the documents."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from benchmarks.refusals import cases, draw, rehearsed
from loopwright.service.cli.rehearsed import RehearsedJob, shown_samples
from loopwright.service.execution.rehearsed import RehearsalRecord
from loopwright.service.jobs.stored_record import stored_record
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.fast.evaluation.record_evaluation import evaluate_again
from loopwright.tuning.reasons import ADVICE, Reason

PAGE = (Path(__file__).parents[2] / "docs" / "refusals.md").read_text(encoding="utf-8")
WITH_FIT = {"unexplained", "disturbed", "uncertain", "model_mismatch", "controller_mismatch", "diverges"}


@cache
def job_of(reason: str) -> tuple[RehearsedJob, RehearsalRecord]:
    return rehearsed(cases()[reason])


@pytest.mark.parametrize("reason", cases())
def test_a_fault_is_refused_with_its_reason_and_shown(reason: str, tmp_path: Path) -> None:
    job, samples = job_of(reason)
    assert (job.state, job.reason) == ("refused", reason), job.detail
    assert job.detail and job.advice == ADVICE[Reason(reason)]
    # what the record came to is told wherever it was enough for a fit
    assert (job.evidence is not None) == (reason in WITH_FIT)
    if reason in WITH_FIT - {"diverges"}:
        assert job.evidence is not None and job.evidence.reason == reason
    name = reason.replace("_", "-")
    picture = tmp_path / f"{name}.png"
    draw(picture, job, samples)
    assert 5_000 < picture.stat().st_size < 60_000
    assert f"## {reason}\n" in PAGE and f"refusals/{name}.png" in PAGE
    assert " ".join(ADVICE[Reason(reason)].split()) in " ".join(PAGE.split())


@pytest.mark.parametrize("Ms", [1.4, 1.6])
def test_what_the_step_has_refuted_is_no_alternative_either(Ms: float) -> None:
    """The record as a whole fits well, with load disturbances added: only its parts tell."""
    record = stored_record(shown_samples(job_of("model_mismatch")[1], None).columns())
    assert record is not None
    evidence = record.experiment_record()
    assert evidence is not None and len(evidence.steps) == 2
    assert evaluate_again(evidence, DesignSpec(Ms)).reason == "model_mismatch"
