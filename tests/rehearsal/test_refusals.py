"""Each cause for which fast refuses, provoked in a rehearsal, with its picture and its place in the documents."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.refusals import cases, draw, rehearsed
from loopwright.service.jobs.relay_record import relay_record
from loopwright.tuning.fast.design import DesignSpec
from loopwright.tuning.fast.verdict import evaluate_again
from loopwright.tuning.reasons import ADVICE, Reason

PAGE = (Path(__file__).parents[2] / "docs" / "refusals.md").read_text(encoding="utf-8")
WITH_FIT = {"unexplained", "disturbed", "uncertain", "surprise", "diverges"}


@pytest.mark.parametrize("cause", cases())
def test_a_fault_is_refused_with_its_cause_and_shown(cause: str, tmp_path: Path) -> None:
    job = rehearsed(cause, cases()[cause])
    assert (job["state"], job["reason"]) == ("refused", cause), job["detail"]
    assert job["detail"] and job["advice"] == ADVICE[Reason(cause)]
    # what the record came to is told wherever it was enough for a fit
    assert (job["evidence"] is not None) == (cause in WITH_FIT)
    if cause in WITH_FIT - {"diverges"}:
        assert job["evidence"]["cause"] == cause
    picture = draw(tmp_path, cause, job)
    assert 5_000 < picture.stat().st_size < 60_000
    name = cause.replace("_", "-")
    assert f"## {cause}\n" in PAGE and f"refusals/{name}.png" in PAGE
    assert " ".join(ADVICE[Reason(cause)].split()) in " ".join(PAGE.split())


@pytest.mark.parametrize("Ms", [1.4, 1.6])
def test_what_the_step_has_refuted_is_no_alternative_either(Ms: float) -> None:
    """The record as a whole fits well, with a story of loads: only its parts tell."""
    record = relay_record(rehearsed("surprise", cases()["surprise"])["samples"])
    assert record is not None
    evidence = record.evidence()
    assert evidence is not None and len(evidence.steps) == 2
    assert evaluate_again(evidence, DesignSpec(Ms)).cause == "surprise"
