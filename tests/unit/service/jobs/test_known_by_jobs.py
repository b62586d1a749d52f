"""Jobs and their acceptance feed what is known of their loops, and depend on nothing of it."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.jobs.retention import RetentionPolicy, delete_old_history
from loopwright.service.observing import knowledge as pure
from loopwright.service.results import TYPED_IN, EvidenceView, FastResult, GainsView, KnownMsView
from loopwright.service.store import knowledge
from loopwright.service.store.store import Store
from tests.unit.service import fakes
from tests.unit.service.api.test_api import finished
from tests.unit.service.fakes import NEW, OLD, TAG, Service
from tests.unit.service.observing.findings import finding, gains, model
from tests.unit.service.processes import until

EVIDENCE = EvidenceView(
    structure="fopdt", Ms=1.6, uncertainty=0.03, ambiguity=0.01, residual=1.0, loads=[], drift=False, switches=4,
    period_s=4.0, reason=None, detail="",
)  # fmt: skip
FOUND = FastResult(
    method="fast",
    model=model(),
    previous_gains=GainsView.of(OLD),
    new_gains=GainsView.of(NEW),
    evidence=EVIDENCE,
    known_previous=KnownMsView(Ms=2.1, uncertainty=0.08),
)
TRIAL = FastResult(
    method="fast",
    model=model().model_copy(update={"structure": TYPED_IN}),
    previous_gains=GainsView.of(OLD),
    new_gains=GainsView.of(NEW),
)


def known(client: TestClient) -> dict[str, Any]:
    """What is known of the loop; the end of a job is shown a moment before what it adds."""

    def found() -> Any:
        return client.get(f"/loops/{TAG}").json()["knowledge"]

    until(found)
    return dict(found())


def test_a_test_and_its_acceptance(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fakes, "RESULT", FOUND)
    job = finished(service, client)
    found = known(client)
    assert (found["Ms"], found["uncertainty"], found["job"], found["source"]) == (2.1, 0.08, job["url"], "job")
    assert found["text"] == f"Ms known to +-0.08 from job {job['id']} (fast)" and found["at"] == job["ended_at"]
    assert found["pv_range"] == {"low": 50.0, "high": 50.0} and found["proposed"]["uncertainty"] == 0.03
    client.post(f"{job['url']}/accept")
    found = known(client)
    assert (found["Ms"], found["uncertainty"], found["proposed"]) == (1.6, 0.03, None)
    assert found["gains"]["Kp"] == NEW.Kp
    client.post(f"{job['url']}/rollback")
    assert known(client)["Ms"] == 2.1


def test_an_accepted_trial_of_what_operation_told(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_both = {"present": gains(OLD, 1.1, 0.02), "proposed": gains(NEW, 1.15, 0.03)}
    knowledge.add(service.store, TAG, finding(**of_both), {})
    monkeypatch.setattr(fakes, "RESULT", TRIAL)
    job = finished(service, client)
    assert known(client)["source"] == "operation", "a trial is a proposal, and none is accepted as yet"
    client.post(f"{job['url']}/accept")
    found = known(client)
    assert (found["Ms"], found["uncertainty"], found["source"], found["job"]) == (1.15, 0.03, "trial", job["url"])
    assert found["text"].endswith(f"normal operation, tried and accepted in job {job['id']}")


@pytest.mark.parametrize("dry_run, result", [(True, FOUND), (False, fakes.RESULT), (False, TRIAL)])
def test_what_tells_nothing(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch, dry_run: bool, result: Any
) -> None:
    """A dry run; the model of five-stage, which has no uncertainty; one that somebody typed in."""
    monkeypatch.setattr(fakes, "RESULT", result)
    finished(service, client, dry_run=dry_run)
    assert client.get(f"/loops/{TAG}").json()["knowledge"] is None


def test_a_defect_does_not_keep_a_job_from_its_end(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(fakes, "RESULT", FOUND)
    monkeypatch.setattr(pure, "of_test", broken)
    assert finished(service, client)["state"] == "proposed"
    until(lambda: "a defect while storing what was found" in caplog.text)


def test_it_is_kept_as_long_as_the_history_and_the_latest_one_for_ever(store: Store) -> None:
    for month in (1, 2, 3):
        knowledge.add(store, "A", finding(at=f"2026-0{month}-01T00:00:00.000Z"), {})
    at = datetime(2026, 3, 2, tzinfo=UTC)
    delete_old_history(store, RetentionPolicy(history_days=None), at)
    assert len(knowledge.read(store, "A")) == 3
    delete_old_history(store, RetentionPolicy(history_days=40.0), at, ages_from=at)
    assert len(knowledge.read(store, "A")) == 3, "the clock has jumped"
    delete_old_history(store, RetentionPolicy(history_days=40.0), at)
    assert len(knowledge.read(store, "A")) == 2
    delete_old_history(store, RetentionPolicy(history_days=0.1), at)
    assert [each.finding.at[:7] for each in knowledge.read(store, "A")] == ["2026-03"]
