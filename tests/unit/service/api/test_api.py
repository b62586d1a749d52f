from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event

from loopwright.service.jobs import worker
from loopwright.service.planning.t95 import t95_mismatch
from loopwright.service.store.job_rows import append
from loopwright.tuning.reasons import ADVICE, Failed, Reason, Refused
from tests.unit.service.fakes import NEW, OLD, TAG, Service
from tests.unit.service.processes import until

GOLDEN = Path(__file__).parents[3] / "golden" / "openapi.json"


def start(client: TestClient, **options: Any) -> str:
    answer = client.post(f"/loops/{TAG}/retune", json={"by": "me"} | options)
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"] == f"/jobs/{answer.json()['id']}"
    return str(answer.json()["id"])


def finished(service: Service, client: TestClient, **options: Any) -> dict[str, Any]:
    job_id = start(client, **options)
    service.wait(job_id)
    job: dict[str, Any] = client.get(f"/jobs/{job_id}").json()
    return job


def assert_problem(answer: Any, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = answer.json()
    assert body["status"] == status and body["detail"] and body["title"]
    return body


def test_loops_and_live_state(client: TestClient) -> None:
    assert [loop["tag"] for loop in client.get("/loops").json()] == ["FIC-2", TAG]
    loop = client.get(f"/loops/{TAG}").json()
    assert loop["live"]["sp"] == 50.0 and loop["live"]["mode"] == "automatic"
    assert loop["live"]["gains"]["Kp"] == OLD.Kp and loop["active_job"] is None


def test_live_state_of_a_busy_loop_comes_from_its_job(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job_id = start(client)
    service.tune.inside.wait(60)
    loop = client.get(f"/loops/{TAG}").json()
    assert loop["live"]["gains"]["Kp"] == NEW.Kp and loop["live"]["on_trial"] is True
    assert loop["active_job"] == f"/jobs/{job_id}"
    assert service.controller.open == 1


def test_a_retune_ends_as_a_proposal(service: Service, client: TestClient) -> None:
    job = finished(service, client, by="me")
    assert job["state"] == "proposed" and job["progress"] == 1.0 and job["by"] == "me"
    assert job["previous_gains"]["Kp"] == OLD.Kp and job["new_gains"]["Kp"] == NEW.Kp
    assert job["new_gains"]["form"] == "ISA"
    assert [s["stage"] for s in job["stages"]] == ["preflight", "relay"]
    assert job["stages"][0]["result"] == {"Ku": 2.05, "Pu_s": 3.32}
    assert job["restored"]["gains"]["Kp"] == OLD.Kp and job["restored"]["mode"] == "automatic"
    assert job["notes"] == ["nearly there", "all quiet"]
    assert service.controller.state.gains == OLD
    assert service.controller.open == 0


def test_a_decision_with_a_name_that_is_not_known_is_refused(service: Service, client: TestClient) -> None:
    job = finished(service, client)["id"]
    refused = client.post(f"/jobs/{job}/accept", json={"roll_back_by_itself": False})
    assert_problem(refused, 422)
    assert "body.roll_back_by_itself: unknown name; did you mean auto_rollback?" in refused.json()["detail"]
    assert service.store.get(job).state == "proposed"


def test_accept_then_roll_back(service: Service, client: TestClient) -> None:
    url = finished(service, client)["url"]
    assert client.post(f"{url}/accept", json={"by": "op"}).json()["state"] == "accepted"
    assert service.controller.state.gains == NEW
    assert_problem(client.post(f"{url}/accept"), 409)
    assert client.post(f"{url}/rollback").json()["state"] == "rolled_back"
    assert service.controller.state.gains == OLD


def test_accept_refuses_when_the_gains_were_changed_since(service: Service, client: TestClient) -> None:
    first, second = finished(service, client), finished(service, client)
    assert client.post(f"{first['url']}/accept").status_code == 200
    assert "changed" in assert_problem(client.post(f"{second['url']}/accept"), 409)["detail"]
    assert client.post(f"{second['url']}/rollback").json()["state"] == "rolled_back"
    assert service.controller.state.gains == NEW


def test_busy_loop_answers_409_with_the_active_job(service: Service, client: TestClient) -> None:
    done = finished(service, client)
    service.tune.hold.clear()
    job_id = start(client)
    answer = client.post(f"/loops/{TAG}/retune", json={"by": "me"})
    body = assert_problem(answer, 409)
    assert body["job"] == f"/jobs/{job_id}" == answer.headers["location"]
    assert assert_problem(client.post(f"{done['url']}/accept"), 409)["job"] == f"/jobs/{job_id}"
    assert client.post("/loops/FIC-2/retune", json={"by": "me"}).status_code == 202


def test_progress_and_abort(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job_id = start(client)
    service.tune.inside.wait(60)
    job = client.get(f"/jobs/{job_id}").json()
    assert job["state"] == "running" and 0 <= job["progress"] < 1 and job["remaining_plant_time_s"] > 0
    assert client.post(f"/jobs/{job_id}/abort").status_code == 202
    service.wait(job_id)
    job = client.get(f"/jobs/{job_id}").json()
    assert job["state"] == "aborted" and job["reason"] == "operator"
    assert service.controller.state.gains == OLD
    assert_problem(client.post(f"/jobs/{job_id}/abort"), 409)


@pytest.mark.parametrize(
    ("ended", "state"),
    [
        (Refused(Reason.NOT_AT_REST, "PV drifts"), "refused"),
        (Failed(Reason.NODE_LOST, "silent"), "failed"),
        (ValueError("a defect"), "failed"),
    ],
)
def test_every_other_end_has_reason_and_advice(
    service: Service, client: TestClient, ended: Exception, state: str
) -> None:
    service.tune.ends = ended
    job = finished(service, client)
    reason = getattr(ended, "reason", Reason.INTERNAL)
    assert (job["state"], job["reason"], job["advice"]) == (state, reason.value, ADVICE[reason])
    assert str(getattr(ended, "detail", ended)) in job["detail"]
    assert_problem(client.post(f"{job['url']}/accept"), 409)


def test_absent_node(service: Service, client: TestClient) -> None:
    service.controller.absent = Reason.NODE_LOST
    answer = client.get(f"/loops/{TAG}")
    assert answer.status_code == 200 and answer.json()["live"] is None
    assert answer.json()["live_error"] == {
        "reason": "node_lost", "detail": "node 32 does not answer", "advice": ADVICE[Reason.NODE_LOST],
    }  # fmt: skip
    job = finished(service, client)
    assert job["state"] == "failed" and job["reason"] == "node_lost"


@pytest.mark.parametrize(
    ("body", "reason", "words"),
    [
        ({"mv_low": 60, "mv_high": 40}, "bad_limits", "mv_low"),
        ({"pv_low": -5}, "bad_limits", "wider"),
        ({"sp_deviation": 3}, "bad_limits", "more than"),
        ({"pv_low": 49, "pv_high": 51}, "bad_limits", "twice"),
        ({"sp_deviation": -1}, "bad_input", "sp_deviation"),
        ({"method": "five-stage", "start": "zn_pi"}, "bad_input", "Ku, Pu_s"),
        # options of one procedure with the other
        ({"start": "zn_pi", "Ku": 2, "Pu_s": 3}, "bad_input", "Ku, Pu_s, start: of the five-stage experiment, not of"),
        ({"overshoot_window_pct": [8, 50]}, "bad_input", 'add "method": "five-stage"'),
        ({"baseline": True}, "bad_input", "baseline: of the five-stage"),
        ({"method": "fast", "method_options": {"Ms": 1.4}}, "bad_input", "method_options: of the five-stage"),
        ({"method": "five-stage", "Ms": 1.4, "min_switches": 6}, "bad_input", 'Ms, min_switches: of "method": "fast"'),
        ({"method": "simc", "amplitude_pct": 5}, "bad_input", 'amplitude_pct: of "method": "fast", not of simc'),
        ({"method": "simc", "start": "design"}, "bad_input", 'start: of "method": "fast"'),
        ({"start": "design"}, "bad_input", "start=design needs model"),
        ({"model": {"K": 1, "T_s": 3, "L_s": 1}}, "bad_input", "model is for start=design"),
        (
            {"method": "five-stage", "start": "optimise", "model": {"num": [1], "den": [3, 1]}},
            "bad_input",
            "five-stage takes a model of the form K, T_s, L_s",
        ),
        ({"start": "design", "model": {"num": [1], "den": [1]}}, "bad_input", "den must have a pole"),
        ({"Ms": 1.1}, "bad_input", "Ms"),
        ({"Ms": 2.1}, "bad_input", "Ms"),
        ({"amplitude_pct": 70}, "bad_limits", "needs 105 % of MV between its limits, which are 100 % apart"),
        ({"sp_devation": 1}, "bad_input", "sp_devation"),
        ({"plant": {"num": [1], "den": [1, 1]}}, "bad_input", "dry run"),
    ],
)
def test_bad_requests(shared_client: TestClient, body: dict[str, Any], reason: str, words: str) -> None:
    problem = assert_problem(shared_client.post(f"/loops/{TAG}/retune", json={"by": "me"} | body), 422)
    assert problem["reason"] == reason and words in problem["detail"]
    assert shared_client.get("/jobs").json() == []


def test_the_request_kept_has_the_options_of_its_method_alone(service: Service, client: TestClient) -> None:
    asked = finished(service, client, baseline=False)["request"]
    assert asked["method"] == "fast" and asked["Ms"] == 1.6 and "overshoot_window_pct" not in asked
    asked = finished(service, client, method="simc", method_options={"tau_c_s": 2})["request"]
    assert asked["method"] == "simc" and asked["method_options"] == {"tau_c_s": 2.0} and "Ms" not in asked


@pytest.mark.parametrize("body", ['{"sp_deviation": NaN}', '{"mv_low": Infinity}', "{", "[]"])
def test_nan_and_nonsense_are_problems(shared_client: TestClient, body: str) -> None:
    answer = shared_client.post(f"/loops/{TAG}/retune", content=body, headers={"content-type": "application/json"})
    assert_problem(answer, 422)


@pytest.mark.parametrize("path", ["/loops/NONE", "/jobs/none", "/jobs/none/events", "/jobs/none/samples", "/nowhere"])
def test_not_found(shared_client: TestClient, path: str) -> None:
    assert_problem(shared_client.get(path), 404)


def test_other_http_errors_are_problems(shared_client: TestClient) -> None:
    assert_problem(shared_client.delete("/loops"), 405)
    assert_problem(shared_client.get("/jobs?limit=0"), 422)
    assert_problem(shared_client.post("/loops/NONE/retune", json={"by": "me"}), 404)


def test_samples_as_columns_and_as_csv(service: Service, client: TestClient) -> None:
    url = finished(service, client)["url"]
    columns = client.get(f"{url}/samples").json()
    assert columns["t_s"][:3] == [0.1, 0.2, 0.3] and columns["stage"] == ["preflight"] * 10 + ["relay"] * 10
    only = client.get(f"{url}/samples?stage=relay&format=csv")
    assert only.headers["content-type"].startswith("text/csv")
    lines = only.text.splitlines()
    assert lines[0] == "stage,t_s,sp,pv,mv,mode" and lines[1] == "relay,1.1,50.0,50.0,40.0,2" and len(lines) == 11


def test_a_t95_that_is_wrong_is_noted(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant of these tests has about the T95 of its configuration, 9 s."""
    monkeypatch.setattr(worker, "t95_mismatch", lambda model, t95_s, record_s: t95_mismatch(model, 10.0 * t95_s))
    job = finished(service, client)
    noted = [data["text"] for _, kind, data in events(client.get(f"{job['url']}/events").text) if kind == "note"]
    assert job["state"] == "proposed" and any("about 9 times too long" in text for text in noted), noted


def test_the_end_of_a_job_does_not_depend_on_t95(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(model: object, t95_s: float) -> str:
        raise ArithmeticError("no roots")

    monkeypatch.setattr(worker, "t95_mismatch", broken)
    assert finished(service, client)["state"] == "proposed"


def events(text: str) -> list[tuple[int, str, dict[str, Any]]]:
    found = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if "event" in fields:  # else the time after which to come back
            found.append((int(fields.get("id", 0)), fields["event"], json.loads(fields["data"])))
    return found


def test_events_resume_after_the_last_one_seen(service: Service, client: TestClient) -> None:
    url = finished(service, client)["url"]
    everything = events(client.get(f"{url}/events").text)
    assert [n for n, _, _ in everything] == list(range(1, len(everything) + 1))
    assert [kind for _, kind, _ in everything] == [
        "state", "state", "stage_started", "stage_done", "stage_started", "stage_done", "note", "state",
    ]  # fmt: skip
    assert everything[-1][2]["state"] == "proposed"
    assert events(client.get(f"{url}/events", headers={"Last-Event-ID": "6"}).text) == everything[6:]
    assert client.get(f"{url}/events", headers={"Last-Event-ID": "8"}).status_code == 204


def test_a_dry_run_touches_nothing_and_does_not_block(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    start(client)
    job = finished(service, client, dry_run=True)
    assert job["state"] == "rehearsed" and job["dry_run"] is True
    assert_problem(client.post(f"{job['url']}/accept"), 409)


def test_stopping_takes_no_new_work(service: Service, client: TestClient) -> None:
    service.jobs.request_stop()
    answer = client.post(f"/loops/{TAG}/retune", json={"by": "me"})
    assert assert_problem(answer, 503)["reason"] == "service_stopped"


def test_a_list_of_jobs_asks_the_database_as_often_however_long_it_is(service: Service, client: TestClient) -> None:
    """A thousand jobs were a thousand queries, in which one who asked again and again kept a thread busy for ever."""
    asked: list[str] = []

    def listed() -> list[dict[str, Any]]:
        asked.clear()
        found: list[dict[str, Any]] = client.get("/jobs").json()
        return found

    @event.listens_for(service.store.engine, "before_cursor_execute")
    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if "FROM events" in statement:
            asked.append(statement)

    ids = [finished(service, client, dry_run=True)["id"] for _ in range(3)]
    until(lambda: listed() == [client.get(f"/jobs/{each}").json() for each in ids[::-1]])
    assert listed() and len(asked) == 1
    assert service.store.events_by_job([], limit=10) == {}
    some = service.store.events_by_job(ids, limit=2)
    assert [[each.seq for each in found] for found in some.values()] == [[1, 2]] * 3


def test_every_schema_has_a_name_of_its_own() -> None:
    """Two models of one name would be told apart by their modules: service__api__fleet__PartView."""
    names = json.loads(GOLDEN.read_text())["components"]["schemas"]
    assert not [name for name in names if "__" in name]


def test_models_and_retunes_are_unions_of_named_schemas(client: TestClient) -> None:
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    forms = {f"#/components/schemas/{name}Model" for name in (
        "FirstOrder", "TwoLag", "SecondOrder", "Integrating", "TransferFunction"
    )}  # fmt: skip
    assert {one["$ref"] for one in schemas["TuningRequest"]["properties"]["model"]["oneOf"]} == forms
    for kind in ("FastRetune", "FiveStageRetune", "RuleRetune", "FastRetunes", "FiveStageRetunes", "RuleRetunes"):
        union, null = schemas[kind]["properties"]["model"]["anyOf"]
        assert {one["$ref"] for one in union["oneOf"]} == forms and null == {"type": "null"}
        assert schemas[kind]["additionalProperties"] is False
    time = schemas["FirstOrderModel"]["properties"]["T_s"]
    assert (time["minimum"], time["maximum"]) == (1e-6, 1e8)


def test_openapi_is_the_golden_one(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    document["info"]["version"] = "0"
    text = json.dumps(document, indent=1, sort_keys=True) + "\n"
    if os.environ.get("LOOPWRIGHT_WRITE_GOLDEN"):
        GOLDEN.write_text(text)
    assert text == GOLDEN.read_text(), "the API changed: LOOPWRIGHT_WRITE_GOLDEN=1 writes the new golden file"


def test_a_stream_reads_a_long_history_in_parts(service: Service, client: TestClient) -> None:
    url = finished(service, client)["url"]
    job_id = url.removeprefix("/jobs/")
    with service.store.writing() as session:
        for n in range(450):
            append(session, job_id, "decision_begun", {"decision": "accept", "by": str(n)}, 0.0)
    found = events(client.get(f"{url}/events").text)
    assert [number for number, _, _ in found] == list(range(1, len(found) + 1)) and len(found) > 450
    assert [data["by"] for _, kind, data in found if kind == "decision_begun"] == list(map(str, range(450)))
