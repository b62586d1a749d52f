"""Which of the findings of a loop is what is known of it."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from loopwright.service.observing.knowledge import Ms_of, adds_nothing, disagreeing, known, of_trial, replaced
from loopwright.service.results import TYPED_IN, FastResult, Finding, FindingSource, GainsView
from loopwright.service.store.knowledge import Known
from loopwright.tuning.gains import Gains
from tests.unit.service.observing.findings import OTHER, PRESENT, PROPOSED, SIMC_MS, finding, gains, job, model

TEST = {"source": FindingSource.JOB, "changes": None, "last_change_s": None, "job": "j1", "method": "fast"}


def stored(*findings: Finding) -> list[Known]:
    return [Known(n, each, None) for n, each in enumerate(findings, start=1)]


def test_nothing_is_known_without_a_finding() -> None:
    assert known([], PRESENT) is None and known([Known(1, finding(), "of an older plant")], PRESENT) is None


def test_what_is_known_is_said_in_a_sentence() -> None:
    found = known(stored(finding(uncertainty=0.03)), PRESENT)
    assert found is not None and found.text == "Ms known to +-0.03 from 3 set-point changes of normal operation"
    assert (found.Ms, found.uncertainty, found.changes, found.job, found.consistent) == (1.30, 0.03, 3, None, 0)
    assert found.proposed is not None and found.proposed.gains.gains() == PROPOSED and found.superseded is None
    one = known(stored(finding(changes=1)), PRESENT)
    assert one is not None and one.source_text == "1 set-point change of normal operation"
    test = known(stored(finding(**TEST)), PRESENT)
    assert test is not None and (test.job, test.source_text) == ("/jobs/j1", "job j1 (fast)")


def test_the_least_uncertain_of_those_that_agree_is_what_is_known_and_nothing_is_averaged() -> None:
    older, newer = finding(1.30, 0.02, **TEST), finding(1.36, 0.05)
    assert disagreeing(newer, stored(older)) == {}
    found = known(stored(older, newer), PRESENT)
    assert found is not None and (found.Ms, found.uncertainty, found.consistent) == (1.30, 0.02, 1)
    equal = known(stored(finding(1.30), finding(1.31)), PRESENT)
    assert equal is not None and equal.Ms == 1.31, "of two alike the newer one"


@pytest.mark.parametrize("Ms, agrees", [(1.399, True), (1.401, False), (1.201, True), (1.199, False), (None, False)])
def test_two_findings_agree_within_both_uncertainties(Ms: float | None, agrees: bool) -> None:
    why = disagreeing(finding(Ms, None if Ms is None else 0.06), stored(finding(1.30, 0.04)))
    assert bool(why) is not agrees


def test_the_older_of_two_that_do_not_agree_is_of_an_older_plant() -> None:
    older, newer = finding(1.30, 0.02, **TEST), finding(1.50, 0.05, at="2026-02-01T12:00:00.000Z")
    (why,) = disagreeing(newer, stored(older)).values()
    for words in ("job j1 (fast)", "2026-01-31T12:00", "Ms 1.3 +- 0.02", "Ms 1.5 +- 0.05", "another one since"):
        assert words in why
    found = known([Known(1, older, why), Known(2, newer, None)], PRESENT)
    assert found is not None and (found.Ms, found.uncertainty, found.consistent) == (1.50, 0.05, 0)
    assert found.superseded == why
    assert disagreeing(newer, [Known(1, older, "already")]) == {}, "once is enough"


def test_findings_under_other_gains_are_compared_under_the_present_ones() -> None:
    """The older one was found under other gains, which had another Ms."""
    older = finding(1.42, 0.04, present=gains(PROPOSED, 1.42, 0.04), proposed=None)
    newer = finding(SIMC_MS, 0.02, present=gains(OTHER, SIMC_MS, 0.02), proposed=None)
    assert disagreeing(newer, stored(older)) == {}
    half_more = finding(1.42, 0.04, present=gains(PROPOSED, 1.42, 0.04), proposed=None, model=model(1.5))
    assert disagreeing(newer, stored(half_more)).keys() == {1}


def test_Ms_of_the_gains_in_effect() -> None:
    found = known(stored(finding()), PROPOSED)
    assert found is not None and (found.Ms, found.uncertainty) == (1.42, 0.04), "the proposal was accepted"
    assert found.proposed is None
    found = known(stored(finding()), OTHER)
    assert found is not None and found.Ms == pytest.approx(SIMC_MS, abs=0.005) and found.uncertainty is None
    assert "not known for these gains" in found.text
    unstable = known(stored(finding()), Gains(20.0, 8.0))  # k = 2.5 > pi/2
    assert unstable is not None and unstable.Ms is None and "not stable" in unstable.text
    unread = known(stored(finding()), None)
    assert unread is not None and unread.gains.gains() == PRESENT
    assert Ms_of(finding(), replace(OTHER, Tf=0.0)).Ms == pytest.approx(SIMC_MS, abs=0.005)


def test_a_further_look_at_the_same_changes_takes_the_place_of_the_earlier_one() -> None:
    findings = stored(finding(last_change_s=900.0), finding(last_change_s=1000.0), finding(**TEST))
    assert replaced(finding(last_change_s=1000.4), findings) == [2]
    assert replaced(finding(last_change_s=1500.0), findings) == []
    assert replaced(finding(last_change_s=1005.0, sample_s=4.0), findings) == [2]
    assert replaced(finding(**TEST), findings) == [], "each test is one of its own"
    tried = finding(source=FindingSource.TRIAL, job="j2")
    assert replaced(tried, stored(finding(model=model(2.0)), finding(**TEST))) == [2], "whose gains were tried"
    assert replaced(finding(), stored(tried)) == [], "that they were tried is not forgotten"


def test_a_look_at_less_of_the_history_does_not_displace_a_better_one() -> None:
    better = stored(finding(1.30, 0.02))
    assert adds_nothing(finding(1.31, 0.03), better) and not adds_nothing(finding(1.31, 0.01), better)
    assert not adds_nothing(finding(1.31, 0.02), better), "the newer one of two alike"
    assert not adds_nothing(finding(1.31, 0.03, last_change_s=2000.0), better), "a further change"
    assert not adds_nothing(finding(1.50, 0.03), better), "another plant"
    assert not adds_nothing(finding(1.31, 0.03, **TEST), better)
    assert not adds_nothing(finding(1.31, 0.03), [Known(1, finding(1.30, 0.02), "older")])


def test_an_accepted_trial_says_so_of_the_finding_whose_model_it_has() -> None:
    at = datetime(2026, 2, 1, tzinfo=UTC)
    tried = model().model_copy(update={"structure": TYPED_IN})
    result = FastResult(method="fast", model=tried, new_gains=GainsView.of(PROPOSED))
    found = of_trial(job(result), stored(finding()), at)
    assert found is not None and found.source is FindingSource.TRIAL and found.at == "2026-02-01T00:00:00.000Z"
    view = known(stored(finding(), found), PROPOSED)
    assert view is not None and (view.Ms, view.uncertainty) == (1.42, 0.04) and view.source is FindingSource.TRIAL
    assert view.source_text == "3 set-point changes of normal operation, tried and accepted in job j2"
    nearly = of_trial(
        job(result.model_copy(update={"new_gains": GainsView.of(Gains(3.21, 8.05))})), stored(finding()), at
    )
    assert nearly is not None and nearly.proposed is not None and nearly.proposed.uncertainty == 0.04
    assert nearly.proposed.Ms == pytest.approx(1.42, abs=0.03)
    later = model(1.01)  # of a later look, which has taken the place of the one whose model was tried
    replaced = of_trial(job(result), stored(finding(1.31, 0.03, model=later)), at)
    assert replaced is not None and replaced.model == later and replaced.source is FindingSource.TRIAL
    other = result.model_copy(update={"model": model(2.0).model_copy(update={"structure": TYPED_IN})})
    assert of_trial(job(other), stored(finding()), at) is None
    assert of_trial(job(result), [Known(1, finding(), "older")], at) is None
    assert of_trial(job(result.model_copy(update={"model": model()})), stored(finding()), at) is None, "a test itself"
