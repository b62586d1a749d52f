"""What GET /loops and GET /loops/{tag} say of the latest job and of the gains accepted last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.inputs.request import FastRetune
from loopwright.service.listening.listening import Listening
from loopwright.service.states.loop_state import LoopState
from loopwright.tuning.gains import Gains
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import NEW, OLD, TAG, Service
from tests.unit.service.processes import until


@pytest.fixture
def listening(service: Service) -> Listening:
    return Listening(service.jobs.directory.loops, service.store, on=False)


@pytest.fixture
def client(service: Service, listening: Listening) -> Iterator[TestClient]:
    with TestClient(app_of(service.jobs, listening=listening)) as client:
        yield client


def both(client: TestClient) -> tuple[dict[str, Any], dict[str, Any]]:
    """The loop by itself, and in the list."""
    listed = next(loop for loop in client.get("/loops").json() if loop["tag"] == TAG)
    return client.get(f"/loops/{TAG}").json(), listed


def proposed(service: Service) -> str:
    job = service.jobs.start(TAG, FastRetune()).id
    until(lambda: service.store.get(job).state == "proposed")
    until(lambda: service.jobs.running(job) is None)
    return job


def test_a_loop_without_a_job(client: TestClient) -> None:
    for loop in both(client):
        assert loop["last_job"] is loop["accepted"] is loop["gains_differ"] is None


def test_the_latest_job_and_the_gains_accepted_last(
    service: Service, client: TestClient, listening: Listening, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = proposed(service)
    for loop in both(client):
        assert loop["last_job"]["url"] == f"/jobs/{job}" and loop["last_job"]["state"] == "proposed"
        assert loop["last_job"]["at"] == service.store.get(job).ended_at and loop["accepted"] is None
    service.jobs.decisions.accept(job, "A. Lind")
    for loop in both(client):
        assert (loop["accepted"]["url"], loop["accepted"]["by"]) == (f"/jobs/{job}", "A. Lind")
        assert loop["accepted"]["gains"]["Kp"] == NEW.Kp and loop["last_job"]["state"] == "accepted"

    def differ(gains: Gains, on_trial: bool = False) -> list[bool | None]:
        state: LoopState = replace(service.controller.state, gains=gains, on_trial=on_trial)
        service.controller.state = state
        monkeypatch.setattr(listening, "gains_of", lambda tag: None if on_trial else gains)
        return [loop["gains_differ"] for loop in both(client)]

    assert differ(NEW) == [False, False]
    assert differ(OLD) == [True, True]
    assert differ(NEW, on_trial=True) == [None, None]

    undecided = proposed(service)
    later = proposed(service)
    superseded = {each: client.get(f"/jobs/{each}").json()["superseded_by"] for each in (job, undecided, later)}
    assert superseded == {job: None, undecided: f"/jobs/{later}", later: None}, "an accepted one was decided"
    for loop in both(client):
        assert loop["last_job"]["url"] == f"/jobs/{later}" and loop["accepted"]["url"] == f"/jobs/{job}"


def test_a_job_says_who_decided_and_who_stopped_it(service: Service, client: TestClient) -> None:
    job = proposed(service)
    found = client.get(f"/jobs/{job}").json()
    assert found["decided"] is found["stopping"] is None and found["sample_time_s"] == 0.1
    service.jobs.decisions.accept(job, "A. Lind")
    decided = client.get(f"/jobs/{job}").json()["decided"]
    assert (decided["what"], decided["by"]) == ("accept", "A. Lind") and decided["at"].endswith("Z")
    service.jobs.decisions.rollback(job, "B. Berg")
    decided = client.get(f"/jobs/{job}").json()["decided"]
    assert (decided["what"], decided["by"]) == ("rollback", "B. Berg")

    service.tune.hold.clear()
    stopped = service.jobs.start(TAG, FastRetune()).id
    until(lambda: service.store.get(stopped).state == "running")
    service.jobs.abort(stopped, "C. Falk")
    assert client.get(f"/jobs/{stopped}").json()["stopping"]["by"] == "C. Falk"
    service.tune.hold.set()


def test_gains_that_were_rolled_back_are_not_those_accepted(service: Service, client: TestClient) -> None:
    job = proposed(service)
    service.jobs.decisions.accept(job, "A. Lind")
    service.jobs.decisions.rollback(job, "A. Lind")
    for loop in both(client):
        assert loop["accepted"] is loop["gains_differ"] is None and loop["last_job"]["state"] == "rolled_back"
