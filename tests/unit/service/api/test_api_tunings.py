"""GET /methods, POST /tunings and the alternatives to what a job proposes."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.execution.procedures import rehearse
from loopwright.service.inputs.model_json import parse_model
from loopwright.service.inputs.request import PlantModel, retune_request
from loopwright.service.jobs.alternatives import alternatives
from loopwright.service.offline.tunings import tunings
from loopwright.service.planning.found_model import DISPROVED
from loopwright.service.results import ModelView
from loopwright.tuning.analysis.margins import margins
from loopwright.tuning.fast.design.design import Aim
from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, TransferFunction
from loopwright.tuning.reasons import Reason, Refused
from loopwright.tuning.rules.design import design
from loopwright.tuning.rules.registry import METHODS
from tests.unit.service import fakes
from tests.unit.service.api.test_api import assert_problem, finished, start
from tests.unit.service.fakes import RESULT, TAG, FakeLoop, Service

FAST = [name for name, method in METHODS.items() if not method.slow]


def test_methods(client: TestClient) -> None:
    found = {each["method"]: each for each in client.get("/methods").json()}
    assert list(found) == list(METHODS)
    for name, method in METHODS.items():
        assert found[name]["source"] == method.source and set(found[name]["options"]) == set(method.options)
    assert found["kappa-tau"]["options"]["Ms"]["choices"] == [1.4, 2.0]


def test_one_method(client: TestClient) -> None:
    body = {"model": {"K": 2, "T_s": 10, "L_s": 8}, "method": "simc", "options": {"tau_c_s": 4}}
    found = client.post("/tunings", json=body).json()
    (simc,) = found["methods"]
    assert found["model"] == {"K": 2.0, "T_s": 10.0, "L_s": 8.0}
    assert simc["outcome"] == "tuned" and simc["gains"]["form"] == "ISA"
    # k e^(-Ls)/s is left, k = 1/12
    assert simc["gains"]["Kp"] == pytest.approx(5.0 / 12.0) and simc["gains"]["Ti"] == 10.0
    assert simc["margins"]["PM_deg"] == pytest.approx(90.0 - math.degrees(8.0 / 12.0))


def test_all_methods_as_the_command_line_has_them(client: TestClient) -> None:
    body = {"model": {"K": 0.1, "L_s": 3, "integrating": True}}
    answer = client.post("/tunings", json=body)
    assert answer.status_code == 200
    assert answer.json() == tunings(parse_model(body["model"]))
    refused = [each for each in answer.json()["methods"] if each["outcome"] == "refused"]
    assert {each["reason"] for each in refused} >= {"not_self_regulating"}


def test_a_refusal_is_an_answer(client: TestClient) -> None:
    body = {"model": {"K": 0.1, "L_s": 3, "integrating": True}, "method": "robust"}
    (found,) = client.post("/tunings", json=body).json()["methods"]
    assert (found["outcome"], found["reason"], found["gains"]) == ("refused", "not_self_regulating", None)
    assert found["advice"]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({}, "model"),
        ({"model": 1}, "model"),
        ({"model": {"K": 2}}, "T_s, L_s: missing"),
        ({"model": {"K": 2, "T_s": -1, "L_s": 0}}, "T_s must be a number > 0 (s), not -1"),
        ({"model": {"K": 2, "T_s": 1, "L_s": 1}, "method": "magic"}, "method must be one of"),
        ({"model": {"K": 2, "T_s": 1, "L_s": 1}, "method": "simc", "options": {"Ms": 1}}, "no option 'Ms'"),
        ({"model": {"K": 2, "T_s": 1, "L_s": 1}, "options": {"tau_c_s": "fast"}}, "tau_c_s must be"),
        ({"model": {"K": 2, "T_s": 1, "L_s": 1}, "options": {"tau_c_s": [1]}}, "tau_c_s must be"),
        ({"model": {"K": 2, "T_s": 1, "L_s": 1}, "surplus": 1}, "surplus"),
    ],
)
def test_bad_requests(shared_client: TestClient, body: dict[str, Any], words: str) -> None:
    problem = assert_problem(shared_client.post("/tunings", json=body), 422)
    assert problem["reason"] == "bad_input" and words in problem["detail"]


def test_nan_is_a_problem(shared_client: TestClient) -> None:
    text = '{"model": {"K": NaN, "T_s": 1, "L_s": 1}}'
    answer = shared_client.post("/tunings", content=text, headers={"content-type": "application/json"})
    assert "body.model.K: NaN" in assert_problem(answer, 422)["detail"]


def test_alternatives_to_a_proposal(service: Service, client: TestClient) -> None:
    job = finished(service, client)
    found = client.get(f"{job['url']}/alternatives").json()
    assert (found["job"], found["loop"]) == (job["id"], job["loop"])
    # the job's model, in the form that POST /tunings takes
    assert found["model"] == {"K": 2.0, "T_s": 3.0, "L_s": 1.0}
    assert [each["method"] for each in found["methods"]] == FAST
    tried = {each["method"] for each in found["methods"] if each["retune"]}
    assert {"simc", "amigo", "robust"} <= tried < set(FAST)
    for each in found["methods"]:
        if each["outcome"] == "refused":
            assert each["retune"] is None
            continue
        try:
            design(each["method"], FOPDT(2.0, 3.0, 1.0), None)
        except Refused as refused:
            assert refused.reason is Reason.NOT_ROBUST and each["retune"] is None
        else:
            asked = retune_request(**each["retune"])
            assert asked.start == "optimise" and asked.method == each["method"]
            assert asked.model and asked.model.plant() == FOPDT(2.0, 3.0, 1.0)
    direct = client.post("/tunings", json={"model": found["model"], "method": "amigo"}).json()["methods"][0]
    (amigo,) = [each for each in found["methods"] if each["method"] == "amigo"]
    assert {name: value for name, value in amigo.items() if name in direct} == direct
    assert amigo["uncertainty"] is None and amigo["ambiguity"] is None
    client.post(f"{job['url']}/accept")
    assert client.get(f"{job['url']}/alternatives").json() == found


def test_the_slow_method_on_request(service: Service, client: TestClient) -> None:
    job = finished(service, client)
    assert "me-pso" not in FAST
    (found,) = client.get(f"{job['url']}/alternatives?method=me-pso").json()["methods"]
    assert found["outcome"] == "tuned" and found["retune"]["method"] == "me-pso"
    problem = assert_problem(client.get(f"{job['url']}/alternatives?method=magic"), 422)
    assert problem["reason"] == "bad_input"


def test_unstable_gains_are_not_to_be_tried(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    from loopwright.tuning.analysis.assessment import assess
    from loopwright.tuning.fast.known_plant import tuned as module

    # a hundred times the gains that the method found
    monkeypatch.setattr(module, "realisable", lambda gains, _filter: (Gains(100.0 * gains.Kp, gains.Ti), ()))
    job = finished(service, client)
    row, events = service.store.get(job["id"]), service.store.events(job["id"])
    answer: Any = alternatives(row, events, "simc")
    (found,) = answer["methods"]
    assert not assess(FOPDT(2.0, 3.0, 1.0), Gains(found["gains"]["Kp"], found["gains"]["Ti"])).stable
    assert found["outcome"] == "tuned" and found["margins"]["stable"] is False and found["retune"] is None


def test_a_second_order_model(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    model = ModelView(K=2.0, T_s=6.0, L_s=3.0, zeta=0.5, k_source="fit")
    monkeypatch.setattr(fakes, "RESULT", RESULT.model_copy(update={"model": model}))
    job = finished(service, client)
    found = client.get(f"{job['url']}/alternatives?method=direct-synthesis").json()
    assert parse_model(found["model"]) == SOPDT(2.0, 6.0, 0.5, 3.0)
    asked = retune_request(**found["methods"][0]["retune"])
    assert asked.model and asked.model.plant() == SOPDT(2.0, 6.0, 0.5, 3.0)


def test_a_refused_job_whose_stages_found_a_model(service: Service, client: TestClient) -> None:
    service.tune.ends = Refused(Reason.NOT_ROBUST, "Ms 2.4")
    job = finished(service, client)
    assert_problem(client.get(f"{job['url']}/alternatives"), 409)
    for K in (1.0, 2.0):
        result = {"K": K, "T_s": 3.0, "L_s": 1.0, "k_source": "k5", "k5": K, "ke": None}
        service.store.append(job["id"], "stage_done", {"stage": "estimate", "result": result}, 1.0)
    service.store.append(job["id"], "stage_done", {"stage": "optimise", "result": None}, 1.0)
    found = client.get(f"{job['url']}/alternatives?method=simc").json()
    assert job["state"] == "refused" and found["model"] == {"K": 2.0, "T_s": 3.0, "L_s": 1.0}


@pytest.mark.parametrize("reason", DISPROVED)
@pytest.mark.parametrize("query", ["", "?method=simc", "?Ms=1.4"])
def test_no_gains_on_a_model_that_the_job_has_disproved(
    service: Service, client: TestClient, reason: Reason, query: str
) -> None:
    service.tune.ends = Refused(reason, "the plant is another")
    job = finished(service, client)
    result = {"num": [1.0], "den": [3.0, 1.0], "L_s": 1.0, "reason": None}
    service.store.append(job["id"], "stage_done", {"stage": "design", "result": result}, 1.0)
    problem = assert_problem(client.get(f"{job['url']}/alternatives{query}"), 409)
    assert reason in problem["detail"] and "the plant is another" in problem["detail"]


def test_a_refused_job_whose_model_was_typed_in(service: Service, client: TestClient) -> None:
    service.tune.ends = Refused(Reason.NOT_CONFIRMED, "overshoot 60 %")
    model = {"K": 2.0, "T_s": 6.0, "L_s": 3.0, "zeta": 0.5}
    job = finished(service, client, method="five-stage", start="optimise", model=model)
    found = client.get(f"{job['url']}/alternatives?method=direct-synthesis").json()
    assert job["state"] == "refused" and found["model"] == {"K": 2.0, "T_s": 6.0, "zeta": 0.5, "L_s": 3.0}


@pytest.mark.parametrize(("Ms", "derivative"), [(1.2, False), (1.4, True), (2.0, False)])
def test_gains_of_fast_for_another_Ms(service: Service, client: TestClient, Ms: float, derivative: bool) -> None:
    """Of a job whose record is not kept: on its model."""
    job = finished(service, client)
    query = f"Ms={Ms}&derivative={str(derivative).lower()}"
    found = client.get(f"{job['url']}/alternatives?{query}").json()
    (fast,) = found["methods"]
    assert (fast["method"], fast["outcome"], fast["uncertainty"]) == ("fast", "tuned", None)
    gains = Gains(fast["gains"]["Kp"], fast["gains"]["Ti"], fast["gains"]["Td"], fast["gains"]["Tf"])
    # the fake loop samples every 0.1 s
    assert margins(FOPDT(2.0, 3.0, 1.05), gains).Ms == pytest.approx(Ms, abs=0.01)
    assert fast["margins"]["Ms"] == pytest.approx(Ms, abs=0.01) and fast["setpoint"]["IAE"] > 0
    assert (gains.Td > 0) == derivative and fast["gains"]["b"] <= 1.0
    more = client.get(f"{job['url']}/alternatives?{query}&setpoint_weight_max=2").json()["methods"][0]
    assert more["gains"]["b"] >= fast["gains"]["b"] and (Ms > 1.4 or more["gains"]["b"] > 1.0)
    assert more["retune"]["setpoint_weight_max"] == 2.0 and "setpoint_weight_max" not in fast["retune"]
    asked = retune_request(**fast["retune"])
    assert (asked.method, asked.start, asked.Ms, asked.derivative) == ("fast", "design", Ms, derivative)
    assert asked.model is not None
    plant = asked.model.plant()
    assert plant.num[-1] / plant.den[-1] == pytest.approx(2.0) and plant.L == 1.0
    assert client.post(f"/loops/{job['loop']}/retune", json=fast["retune"] | {"by": "me"}).status_code == 202


def test_the_aim_of_other_gains_is_that_of_the_job_unless_another_is_asked_for(
    service: Service, client: TestClient
) -> None:
    job = finished(service, client, aim="load")
    answers = {}
    for query in ("", *(f"&aim={aim}" for aim in Aim)):
        found = client.get(f"{job['url']}/alternatives?Ms=1.6{query}").json()
        (answers[query],) = found["methods"]
        asked = retune_request(**answers[query]["retune"])
        assert asked.aim == (query.removeprefix("&aim=") or "load")
    assert answers[""]["gains"] == answers["&aim=load"]["gains"]
    loads = {query: each["load"]["IAE"] for query, each in answers.items()}
    assert loads["&aim=load"] < loads["&aim=balanced"] < loads["&aim=setpoint"]
    steps = {query: each["setpoint"]["IAE"] for query, each in answers.items()}
    assert steps["&aim=setpoint"] < steps["&aim=balanced"] < steps["&aim=load"]
    assert answers["&aim=no_overshoot"]["setpoint"]["overshoot_pct"] < 1.5
    assert len({each["gains"]["b"] for each in answers.values()}) == len(Aim)


def test_other_gains_keep_the_movement_of_MV_that_the_job_asked_for_and_the_settling_time_that_the_query_does(
    service: Service, client: TestClient
) -> None:
    job = finished(service, client, mv_peak=0.7, settling_s=60.0)
    url = f"{job['url']}/alternatives?Ms=1.6"

    def found(query: str) -> dict[str, Any]:
        (method,) = client.get(url + query).json()["methods"]
        return dict(method)

    own, wide, slow = found(""), found("&mv_peak=9"), found("&settling_s=20")
    assert own["retune"]["mv_peak"] == 0.7 and "settling_s" not in own["retune"] and own["design"]["Ms"] == 1.6
    assert wide["setpoint"]["peak_u"] > 0.7 >= own["setpoint"]["peak_u"] * 0.9998
    assert slow["retune"]["settling_s"] == 20.0 and 1.1 <= slow["design"]["Ms"] < 1.55
    assert slow["margins"]["Ms"] == pytest.approx(slow["design"]["Ms"], abs=0.01)
    never = found("&settling_s=0.5")
    assert (never["outcome"], never["reason"], never["retune"]) == ("refused", "not_possible", None)
    again = found(f"&settling_s={re.findall(r'at least ([0-9.]+) s', never['detail'])[0]}")
    assert again["outcome"] == "tuned"
    assert client.post(f"/loops/{job['loop']}/retune", json=again["retune"] | {"by": "me"}).status_code == 202


@pytest.mark.parametrize(
    "query",
    [
        "settling_s=5", "mv_peak=2", "noise_gain=2", "Ms=1.4&settling_s=0", "Ms=1.4&mv_peak=-1",
        "Ms=1.4&noise_gain=nan", "Ms=1.1", "Ms=2.5", "Ms=nan", "Ms=1.4&method=simc", "derivative=true",
        "Ms=1.4&derivative=x", "aim=load", "Ms=1.4&aim=comfort",
    ],
)  # fmt: skip
def test_bad_wishes_for_another_Ms(service: Service, client: TestClient, query: str) -> None:
    job = finished(service, client)
    assert assert_problem(client.get(f"{job['url']}/alternatives?{query}"), 422)["reason"] == "bad_input"


def test_another_Ms_from_the_record_of_a_job(service: Service, client: TestClient) -> None:
    """The same gains as a job that was asked for it from the start, without its experiment."""
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller), rehearse)
    plant = {"num": [1.0], "den": [8.0, 6.0, 1.0], "dead_time_s": 1.0, "noise_std": 0.02, "sample_time_s": 0.1}
    rows = [
        jobs.start(TAG, retune_request(dry_run=True, plant=PlantModel(**plant), Ms=ms, verify=False))
        for ms in (1.4, 1.6)
    ]
    for row in rows:
        service.wait(row.id)
    asked, other = (client.get(f"/jobs/{row.id}").json() for row in rows)
    assert asked["state"] == other["state"] == "rehearsed", (asked["detail"], other["detail"])
    (found,) = client.get(f"{other['url']}/alternatives?Ms=1.4").json()["methods"]
    assert found["outcome"] == "tuned" and 0 < found["uncertainty"] < 0.1
    for gain in ("Kp", "Ti"):
        assert found["gains"][gain] == pytest.approx(asked["new_gains"][gain], rel=0.01)
        assert found["gains"][gain] != pytest.approx(other["new_gains"][gain], rel=0.01)
    true = TransferFunction((1.0,), (8.0, 6.0, 1.0), 1.05)
    assert margins(true, Gains(found["gains"]["Kp"], found["gains"]["Ti"])).Ms == pytest.approx(1.4, abs=0.05)
    (same,) = client.get(f"{other['url']}/alternatives?Ms=1.6").json()["methods"]
    assert same["gains"]["Kp"] == pytest.approx(other["new_gains"]["Kp"], rel=0.01)
    jobs.stop()


def test_jobs_without_a_model(service: Service, client: TestClient) -> None:
    assert_problem(client.get("/jobs/none/alternatives"), 404)
    service.tune.hold.clear()
    job_id = start(client)
    service.tune.inside.wait(5)
    assert "not over" in assert_problem(client.get(f"/jobs/{job_id}/alternatives"), 409)["detail"]
