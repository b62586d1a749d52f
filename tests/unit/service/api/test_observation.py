"""GET /loops/{tag}/observation and `loopwright observe`: a proposal from what operators did, and what is missing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError
from typer.testing import CliRunner

from loopwright.service.cli import loops
from loopwright.service.cli import main as cli
from loopwright.service.inputs.request import FastRetune
from loopwright.service.listening.rings import Rings
from loopwright.service.observing.hearing import question
from loopwright.service.results import FindingSource, GainsView
from loopwright.service.store import knowledge
from loopwright.service.store.clock import stamp
from loopwright.service.store.job_rows import find
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import DesignSpec
from loopwright.tuning.gains import Gains
from loopwright.tuning.plan import Mode
from loopwright.tuning.reasons import Reason
from tests.unit.service.api.test_api import assert_problem, start
from tests.unit.service.apps import app_of
from tests.unit.service.cli.test_cli_jobs import Through
from tests.unit.service.fakes import TAG, Service
from tests.unit.service.observing.findings import finding, gains
from tests.unit.service.observing.operated import HeardBefore, Operated

MOVES = {1000: 1.0, 1900: -0.8, 2800: 0.9}
LOOP = Operated()


@pytest.fixture
def store_findings(service: Service) -> Callable[[], int]:
    """The number of findings that are stored of the loop."""
    return lambda: len(knowledge.read(service.store, TAG))


@contextmanager
def asked(service: Service, rings: Rings, no_data: str | None = None) -> Iterator[TestClient]:
    service.controller.state = replace(service.controller.state, gains=LOOP.gains, sample_time_s=LOOP.Ts)
    app = app_of(service.jobs, listening=HeardBefore(rings, no_data))
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def answer(service: Service, rings: Rings, no_data: str | None = None, **query: Any) -> dict[str, Any]:
    with asked(service, rings, no_data) as client:
        found = client.get(f"/loops/{TAG}/observation", params=query)
        assert found.status_code == 200, found.text
        return dict(found.json())


def heard(moves: Mapping[int, float] = MOVES, **what: Any) -> Rings:
    return LOOP.heard(moves, 3800, time.time(), **what)


def true_Ms(gains: dict[str, Any]) -> float:
    return margins(LOOP.plant, GainsView.model_validate(gains).gains()).Ms


@pytest.mark.parametrize("ms", [1.4, 1.6])
def test_three_set_point_changes_of_operators_are_a_proposal(service: Service, ms: float) -> None:
    found = answer(service, heard(), Ms=ms)
    assert (found["state"], found["reason"]) == ("proposal", None), found["detail"]
    assert true_Ms(found["proposed"]["gains"]) == pytest.approx(ms, abs=0.05), "on the plant, not on the model"
    assert found["proposed"]["Ms"] == pytest.approx(ms, abs=0.01) and 0.0 < found["proposed"]["uncertainty"] < 0.06
    present = found["present"]
    assert abs(true_Ms(present["gains"]) - present["Ms"]) < max(0.03, present["uncertainty"])
    assert found["known"].endswith("from 3 set-point changes") and found["known"].startswith("Ms known to +-0.0")
    begin_s = found["data"]["to_s"] - 3799 * LOOP.Ts
    assert [each["at_s"] - begin_s for each in found["changes_used"]] == pytest.approx([100.0, 190.0, 280.0], abs=0.2)
    assert [each["size"] for each in found["changes_used"]] == pytest.approx([1.0, 0.8, 0.9])
    assert found["changes_dropped"] == [] and found["model"]["dead_time_error_s"] > 0.0
    assert found["pv_range"]["low"] < 50.2 and found["pv_range"]["high"] > 50.9
    assert found["tested_on_loop"] is False and "never tested" in found["tested_text"]


def test_nothing_is_written_and_the_trial_is_a_request_that_is_taken(service: Service) -> None:
    with asked(service, heard()) as client:
        before = service.controller.state
        found = client.get(f"/loops/{TAG}/observation").json()
        assert (
            client.get("/jobs").json() == [] and service.controller.state == before and not service.controller.session
        )
        preview = client.post(f"/loops/{TAG}/retune/preview", json=found["retune"])
        assert preview.status_code == 200, preview.text
        assert [each["stage"] for each in preview.json()["stages"]][-1] == "verify"


def test_a_load_that_comes_with_a_change_does_not_make_a_wrong_proposal(service: Service) -> None:
    found = answer(service, heard(load=lambda n: 1.0 if n > 1930 else 0.0))
    if found["state"] == "proposal":
        assert true_Ms(found["proposed"]["gains"]) == pytest.approx(1.6, abs=0.1)
        assert found["loads"] or found["changes_dropped"]
    else:
        assert found["reason"] and found["detail"] and found["advice"] and found["proposed"] is None


@pytest.mark.parametrize(
    "rings, no_data, word",
    [
        (Rings(), "listening is turned off", "turned off"),
        (Rings(), None, "no data in automatic"),
        (heard({}), None, "no set-point change"),
        (heard(unknown=range(3800)), None, "no data in automatic"),
        (heard(mode=lambda n: int(Mode.MANUAL)), None, "no data in automatic"),
        (heard({1000: 0.02}), None, "no set-point change of"),
    ],
    ids=["off", "nothing heard", "no change", "gains unknown", "in manual", "a change in the noise"],
)
def test_what_is_missing_is_said(service: Service, rings: Rings, no_data: str | None, word: str) -> None:
    found = answer(service, rings, no_data)
    assert (found["state"], found["reason"]) == ("missing", "uncertain")
    assert word in found["detail"] and found["advice"]
    assert (found["proposed"], found["retune"], found["tested_text"]) == (None, None, None)
    assert found["present"]["gains"]["Kp"] == LOOP.gains.Kp


def test_a_set_point_that_another_controller_moves_is_refused_in_words(service: Service) -> None:
    found = answer(service, heard({n: 0.3 * (-1) ** (n // 7) for n in range(100, 3700, 3)}))
    assert (found["state"], found["reason"]) == ("missing", "setpoint_is_driven")
    assert "another controller" in found["detail"]


def test_the_inner_loop_of_a_cascade_is_refused_by_its_configuration(service: Service) -> None:
    service.loops[TAG] = service.loops[TAG].model_copy(update={"setpoint_from": "remote", "outer_loop": "FIC-2"})
    found = answer(service, heard())
    assert (found["state"], found["reason"]) == ("missing", "setpoint_is_driven") and "FIC-2" in found["detail"]


def test_changes_during_a_test_are_no_operation(service: Service) -> None:
    begun_s = time.time()
    rings, state = LOOP.heard(MOVES, 3800, begun_s + 400.0), replace(service.controller.state, sample_time_s=LOOP.Ts)
    at = service.store, service.loops[TAG], state, DesignSpec(), (), lambda: begun_s + 400.0
    assert len(question(HeardBefore(rings), *at).heard()) == 1
    service.tune.hold.clear()
    with asked(service, rings) as client:
        start(client)
        assert question(HeardBefore(rings), *at).heard() == [], "the test that began at the begin goes on"
        service.tune.hold.set()


def test_a_test_that_a_clock_set_back_makes_later_than_its_acceptance_does_not_count(service: Service) -> None:
    begun_s = time.time()
    job_id = service.jobs.start(TAG, FastRetune()).id
    service.wait(job_id)
    with service.store.writing() as session:  # it has lasted as long as some samples
        find(session, job_id).started_at = stamp(datetime.fromtimestamp(begun_s - 1.0, UTC))
    rings, state = LOOP.heard(MOVES, 3800, begun_s + 200.0), replace(service.controller.state, sample_time_s=LOOP.Ts)
    at = service.store, service.loops[TAG], state, DesignSpec(), (), lambda: begun_s + 200.0
    assert len(question(HeardBefore(rings), *at).heard()) == 2
    assert len(question(HeardBefore(rings), *at, time.time()).heard()) == 2
    assert len(question(HeardBefore(rings), *at, begun_s - 60.0).heard()) == 1


def test_the_test_of_a_neighbour_is_said_and_left_out(service: Service) -> None:
    for tag in (TAG, "FIC-2"):
        service.loops[tag] = service.loops[tag].model_copy(update={"area": "top"})
    service.tune.hold.clear()
    with asked(service, heard()) as client:
        assert client.get(f"/loops/{TAG}").json()["disturbed_by"] is None
        job = client.post("/loops/FIC-2/retune", json={"by": "me"}).json()
        assert service.tune.inside.wait(60)
        assert client.get(f"/loops/{TAG}").json()["disturbed_by"] == f"FIC-2 is under test (job {job['id']})"
        assert client.get("/loops/FIC-2").json()["disturbed_by"] is None, "it is the one under test"
        (disturbed,) = client.get(f"/loops/{TAG}/history").json()["disturbed"]
        assert disturbed["loop"] == "FIC-2" and disturbed["from_s"] < disturbed["to_s"] <= time.time()
        found = client.get(f"/loops/{TAG}/observation").json()
        assert found["data"]["disturbed_by"] == ["FIC-2"]
        begun = datetime.fromisoformat(client.get(job["url"]).json()["started_at"]).timestamp()
        assert found["data"]["to_s"] is not None and found["data"]["to_s"] <= begun, "what came before is used"
        service.tune.hold.set()
        service.wait(job["id"])
        assert client.get(f"/loops/{TAG}").json()["disturbed_by"] is None
        assert client.get("/loops/FIC-2/observation").json()["data"]["disturbed_by"] == []


def test_a_silent_loop_an_unknown_one_and_a_wrong_question(service: Service) -> None:
    with asked(service, Rings()) as client:
        assert_problem(client.get("/loops/NONE/observation"), 404)
        assert client.get(f"/loops/{TAG}/observation?Ms=3").status_code == 422
        job = client.post(f"/loops/{TAG}/retune", json={"by": "me", "method": "observe"})
        assert job.status_code == 422 and "GET /loops/TAG/observation" in job.text
        service.controller.absent = Reason.NODE_LOST
        assert client.get(f"/loops/{TAG}/observation").status_code == 503


def test_what_an_observation_told_is_known_of_the_loop(
    service: Service, store_findings: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with asked(service, heard()) as client:
        assert client.get(f"/loops/{TAG}").json()["knowledge"] is None
        answers = [client.get(f"/loops/{TAG}/observation").json() for _ in range(2)]
        found = client.get(f"/loops/{TAG}").json()["knowledge"]
        assert found["Ms"] == answers[-1]["present"]["Ms"] and found["model"] == answers[-1]["model"]
        assert found["uncertainty"] == answers[-1]["present"]["uncertainty"]
        assert found["text"] == f"Ms known to +-{found['uncertainty']:.2g} from 3 set-point changes of normal operation"
        assert (found["source"], found["changes"], found["job"], found["Ms_asked"]) == ("operation", 3, None, 1.6)
        assert found["pv_range"] == answers[-1]["pv_range"] and found["gains"] == answers[-1]["present"]["gains"]
        assert found["proposed"] == answers[-1]["proposed"] and store_findings() == 1, "the second takes its place"
        monkeypatch.setattr(loops, "Client", lambda _url: Through(client))
        done = CliRunner().invoke(cli.app, ["loop", TAG])
        assert found["text"] in " ".join(done.output.split()) and done.exit_code == 0
        service.controller.state = replace(service.controller.state, gains=Gains(1.0, 6.0))
        changed = client.get(f"/loops/{TAG}").json()["knowledge"]
        assert changed["gains"]["Kp"] == 1.0 and changed["uncertainty"] is None
        assert changed["Ms"] == pytest.approx(margins(LOOP.plant, Gains(1.0, 6.0)).Ms, abs=0.05)


def test_an_observation_without_an_answer_leaves_nothing(service: Service, store_findings: Callable[[], int]) -> None:
    assert answer(service, heard({}))["knowledge"] is None
    assert store_findings() == 0


def test_what_a_test_told_is_said_where_operation_tells_nothing(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"source": FindingSource.JOB, "changes": None, "last_change_s": None, "job": "j1", "method": "fast"}
    knowledge.add(service.store, TAG, finding(1.7, 0.02, present=gains(LOOP.gains, 1.7, 0.02), **found), {})
    with asked(service, heard({})) as client:
        found = client.get(f"/loops/{TAG}/observation").json()
        assert (found["state"], found["knowledge"]["Ms"]) == ("missing", 1.7)
        monkeypatch.setattr(loops, "Client", lambda _url: Through(client))
        done = CliRunner().invoke(cli.app, ["observe", TAG])
        assert "Known already: Ms known to +-0.02 from job j1 (fast)" in " ".join(done.output.split())


def test_an_observation_that_cannot_be_kept_is_answered(
    service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OperationalError("INSERT", {}, Exception("database or disk is full"))

    monkeypatch.setattr(knowledge, "add", full)
    assert answer(service, heard())["state"] == "proposal"
    assert f"what was found of loop {TAG} could not be stored" in caplog.text


def test_a_test_that_does_not_agree_is_of_an_older_plant(service: Service) -> None:
    knowledge.add(service.store, TAG, finding(1.1, 0.01, present=gains(LOOP.gains, 1.1, 0.01)), {})
    with asked(service, heard()) as client:
        answered = client.get(f"/loops/{TAG}/observation").json()["knowledge"]
        found = client.get(f"/loops/{TAG}").json()["knowledge"]
    assert answered == found
    assert found["source"] == "operation" and found["Ms"] == pytest.approx(1.75, abs=0.05) and found["consistent"] == 0
    assert "another one since" in found["superseded"]


def test_the_command_shows_it(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        client = stack.enter_context(asked(service, heard()))
        monkeypatch.setattr(loops, "Client", lambda _url: Through(client))
        done = CliRunner().invoke(cli.app, ["observe", TAG])
        assert done.exit_code == 0, done.output
        for words in (
            f"{TAG}: Ms known to +-0.0",
            "from 3 set-point changes",
            "never tested",
            '"start": "design"',
            "1.6 +-",
        ):
            assert words in " ".join(done.output.split()), words
        client = stack.enter_context(asked(service, Rings()))
        done = CliRunner().invoke(cli.app, ["observe", TAG])
        assert done.exit_code == 3 and "Wait for further" in done.output
