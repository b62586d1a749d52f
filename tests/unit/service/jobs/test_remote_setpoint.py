"""The inner loop of a cascade: its set-point comes from another controller, and is never pulsed."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError
from typer.testing import CliRunner

from loopwright.service.cli import loops as cli
from loopwright.service.errors import RemoteSetpoint
from loopwright.service.inputs.config import LoopConfig
from loopwright.service.inputs.request import retune_request
from loopwright.service.jobs.fleet import Fleet, fleet_request
from loopwright.service.jobs.manager import Jobs
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import state_json
from loopwright.tuning.reasons import Reason
from tests.unit.service.fakes import TAG, Service, loop_entry
from tests.unit.service.jobs.test_recovery import in_the_session, left

INNER = "FIC-2"
PULSED = {"method": "setpoint"}


def remote(outer: str | None = TAG) -> LoopConfig:
    return LoopConfig.model_validate(loop_entry(tag=INNER, channel=2, setpoint_from="remote", outer_loop=outer))


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path)
    service.loops[INNER] = remote()
    yield service
    service.close()


def test_it_is_refused_in_words_that_name_the_outer_loop(service: Service, client: TestClient) -> None:
    answer = client.post(f"/loops/{INNER}/retune", json=PULSED | {"by": "me"})
    assert (answer.status_code, answer.json()["reason"]) == (409, "setpoint_is_driven")
    for words in (f"comes from {TAG}", "to local set-point", "setpoint_from: operator", f"{TAG} in manual"):
        assert words in answer.json()["detail"]
    assert client.get(f"/loops/{INNER}/jobs").json() == [], "there is no job of it"
    (obstacle,) = client.post(f"/loops/{INNER}/retune/preview", json=PULSED).json()["obstacles"]
    assert (obstacle["reason"], obstacle["detail"]) == ("setpoint_is_driven", answer.json()["detail"])
    service.loops[INNER] = remote(outer=None)
    refused = client.post(f"/loops/{INNER}/retune", json=PULSED | {"by": "me"})
    assert "comes from another controller" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("tag", "options"),
    [(INNER, {}), (INNER, {"method": "five-stage"}), (INNER, PULSED | {"dry_run": True}), (TAG, PULSED)],
)
def test_what_does_not_pulse_it_is_taken(
    service: Service, client: TestClient, tag: str, options: dict[str, Any]
) -> None:
    assert client.post(f"/loops/{tag}/retune", json=options | {"by": "me"}).status_code == 202
    assert "setpoint_is_driven" not in str(client.post(f"/loops/{tag}/retune/preview", json=options).json())


def test_among_many_loops_it_is_passed_over_with_the_reason(service: Service) -> None:
    fleet = Fleet(service.jobs)
    row = fleet.start(fleet_request(pattern="*", **PULSED))
    fleet.poll()
    parts = {part.loop: part for part in fleet.get(row.id)[1]}
    assert parts[INNER].reason == "setpoint_is_driven" and parts[INNER].job_id is None
    assert parts[TAG].job_id is not None


def test_a_job_that_waited_while_the_configuration_changed_is_refused(service: Service) -> None:
    row = service.store.create(INNER, retune_request(**PULSED).asked(), "me", False)
    service.jobs.worker.work(row.id)
    ended = service.store.get(row.id)
    assert (ended.state, ended.reason) == (JobState.REFUSED, Reason.SETPOINT_IS_DRIVEN)
    assert service.controller.session_last == 0, "the loop was not touched"


def test_a_job_cut_off_by_a_kill_does_not_go_on_with_it(tmp_path: Path) -> None:
    class Later(Service):
        def more_jobs(self, open_loop: Any, *more: Any, **settings: Any) -> Jobs:
            in_the_session(self.controller)
            self.loops[TAG] = self.loops[TAG].model_copy(update={"setpoint_from": "remote"})
            return super().more_jobs(open_loop, *more, **settings)

    job_id = left(tmp_path, request=PULSED)
    later = Later(tmp_path)
    row = later.store.get(job_id)
    assert (row.state, row.reason) == (JobState.INTERRUPTED, Reason.SETPOINT_IS_DRIVEN)
    assert row.restored == state_json(later.controller.state) and later.controller.session == 0
    later.close()


def test_who_moves_the_set_point_is_shown(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = client.get(f"/loops/{INNER}").json()
    assert (shown["setpoint_from"], shown["outer_loop"]) == ("remote", TAG)
    shown = client.get(f"/loops/{TAG}").json()
    assert (shown["setpoint_from"], shown["outer_loop"]) == ("operator", None)

    class Through:
        def __init__(self, url: str) -> None: ...

        def get(self, path: str) -> Any:
            return client.get(path).json()

    monkeypatch.setattr(cli, "Client", Through)
    said = {tag: CliRunner().invoke(cli.app, ["loop", tag]).output for tag in (INNER, TAG)}
    assert f"remote, {TAG}" in said[INNER] and "operator" in said[TAG]


def test_the_refusal_crosses_to_another_process_as_it_is() -> None:
    there = pickle.loads(pickle.dumps(RemoteSetpoint("comes from TIC-1")))
    assert isinstance(there, RemoteSetpoint)
    assert (there.reason, there.detail) == (Reason.SETPOINT_IS_DRIVEN, "comes from TIC-1")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"outer_loop": "TIC-100"}, "add setpoint_from: remote"),
        ({"setpoint_from": "remote", "outer_loop": INNER}, "this loop itself"),
        ({"setpoint_from": "cascade"}, "'operator' or 'remote'"),
    ],
)
def test_a_configuration_that_contradicts_itself_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        LoopConfig.model_validate(loop_entry(tag=INNER, **change))
