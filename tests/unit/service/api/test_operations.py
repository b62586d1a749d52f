from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
import threading
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import update
from sqlalchemy.exc import OperationalError

from loopwright.protocol.station import Station
from loopwright.protocol.tuner import FailureKind, Tuner, TunerError
from loopwright.service.api import operations
from loopwright.service.api.operations import Readiness
from loopwright.service.inputs.config import parse_site
from loopwright.service.loops.bus_watch import BusWatch
from loopwright.service.server.serving import listen, tell_systemd
from loopwright.service.store.tables import JobRow
from loopwright.service.telemetry.logs import JsonLines, about
from loopwright.service.telemetry.metrics import SAMPLES_LOST
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.api.test_api import finished, start
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, FakeLoop, Service, loop_entry
from tests.unit.service.processes import until


def test_alive(client: TestClient) -> None:
    assert client.get("/healthz").json() == {"status": "alive"}


def ready(service: Service, **checks: Any) -> tuple[int, dict[str, Any]]:
    with TestClient(app_of(service.jobs, checks=checks or None)) as client:
        answer = client.get("/readyz")
        return answer.status_code, answer.json()


def test_ready_names_database_engine_and_each_bus(service: Service) -> None:
    status, body = ready(service)
    assert status == 200 and body["ready"] is True
    assert list(body["parts"]) == ["database", "engine", "bus virtual:test"]


def test_what_is_not_ready_is_named(service: Service) -> None:
    def broken() -> None:
        raise OSError("no such device")

    status, body = ready(service, good=lambda: None, bad=broken)
    assert status == 503 and body["ready"] is False
    assert body["parts"] == {
        "good": {"ready": True, "detail": None}, "bad": {"ready": False, "detail": "no such device"},
    }  # fmt: skip


def test_what_is_worth_knowing_of_a_part_that_is_ready(service: Service) -> None:
    status, body = ready(service, samples=lambda: "none are deleted before 2027")
    assert status == 200 and body["parts"] == {"samples": {"ready": True, "detail": "none are deleted before 2027"}}


def test_a_service_that_stops_is_not_ready_but_alive(service: Service) -> None:
    client = TestClient(app_of(service.jobs))
    service.jobs.request_stop()
    assert client.get("/healthz").status_code == 200
    body = client.get("/readyz")
    assert body.status_code == 503 and "shutting down" in body.json()["parts"]["engine"]["detail"]


def test_a_database_that_is_gone_is_named(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    client = TestClient(app_of(service.jobs))

    def gone() -> None:
        raise OSError("server closed the connection")

    monkeypatch.setattr(service.store, "ping", gone)
    body = client.get("/readyz")
    assert body.status_code == 503 and body.json()["parts"]["database"]["detail"] == "server closed the connection"


def test_an_answer_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operations, "CHECK_S", 0.05)
    never = threading.Event()

    async def ask() -> operations.Ready:
        found = await Readiness({"stuck": lambda: assert_set(never), "good": lambda: None}).ask()
        assert not never.is_set()
        never.set()  # only now may the stuck one end
        return found

    assert [part.ready for part in asyncio.run(ask()).parts.values()] == [False, True]


def assert_set(event: threading.Event) -> None:
    assert event.wait(60)


def test_the_parts_are_not_asked_more_often_than_they_need_to_be() -> None:
    asked = []

    async def often() -> None:
        readiness = Readiness({"bus": lambda: asked.append(1)})
        await asyncio.gather(*(readiness.ask() for _ in range(20)))

    asyncio.run(often())
    assert len(asked) == 1


@pytest.mark.parametrize("url", ["socketcan:nothere0", "socketcand:127.0.0.1:1", "nonsense"])
def test_a_bus_that_is_not_there(url: str) -> None:
    with pytest.raises(Exception, match=r"nothere0|refused|kernel|not a bus|no SocketCAN"):
        BusWatch(url).check()


# metrics


def samples(client: TestClient) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    answer = client.get("/metrics")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/plain")
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def test_loops_and_jobs_are_counted(service: Service, client: TestClient) -> None:
    finished(service, client)
    service.tune.ends = Failed(Reason.NODE_LOST, "silent")
    finished(service, client)
    service.tune.ends = None
    service.tune.hold.clear()
    service.tune.inside.clear()
    start(client)
    service.tune.inside.wait(60)
    found = samples(client)
    assert found["loopwright_loops", (("bus", "virtual:test"),)] == 2
    jobs = {tuple(v for _, v in key[1]): n for key, n in found.items() if key[0] == "loopwright_jobs"}
    assert jobs == {("", "proposed"): 1, ("node_lost", "failed"): 1, ("", "running"): 1, ("", "queued"): 0}


def test_a_proposal_that_a_later_test_has_followed_does_not_wait(service: Service, client: TestClient) -> None:
    for _ in range(2):
        finished(service, client)
    found = samples(client)
    assert found["loopwright_proposals_waiting", ()] == 1
    assert found["loopwright_jobs", (("reason", ""), ("state", "proposed"))] == 2


def test_the_jobs_of_another_gateway_are_counted_there(service: Service, client: TestClient) -> None:
    """The sum over the gateways of a database has each job once."""
    finished(service, client)
    with service.store.writing() as session:
        session.execute(update(JobRow).values(host="gw-2"))
    found = samples(client)
    assert found["loopwright_proposals_waiting", ()] == 0
    assert found["loopwright_jobs", (("reason", ""), ("state", "proposed"))] == 0


def test_samples_lost_are_counted_from_0_on(service: Service) -> None:
    """Prometheus sees no increase in a counter that begins with the first loss."""
    service.loops = parse_site({"loops": [loop_entry(bus="virtual:untouched")]}, "test").loops
    jobs = service.more_jobs(lambda config: FakeLoop(service.controller))
    found = samples(TestClient(app_of(jobs)))
    assert found["loopwright_samples_lost_total", (("bus", "virtual:untouched"),)] == 0
    jobs.stop()


def test_answers_500_are_counted_from_0_on(client: TestClient) -> None:
    found = {
        (labels["method"], labels["route"])
        for name, pairs in samples(client)
        if name == "loopwright_http_requests_total" and (labels := dict(pairs))["status"] == "500"
    }
    operations = client.get("/openapi.json").json()["paths"]
    assert {(method.upper(), path) for path, each in operations.items() for method in each} <= found
    assert ("GET", "none") in found


def test_stages_requests_and_samples_are_counted(service: Service, client: TestClient) -> None:
    before = samples(client)
    finished(service, client)
    finished(service, client, dry_run=True)
    client.get("/jobs/none")
    client.get("/jobs/nothing")
    client.get("/nowhere/at/all")
    SAMPLES_LOST.labels("virtual:test").inc(3)
    after = samples(client)

    def grown(name: str, **labels: str) -> float:
        key = name, tuple(sorted(labels.items()))
        return after[key] - before.get(key, 0.0)

    assert grown("loopwright_stage_plant_seconds_count", stage="relay") == 1
    # 10 samples of 0.1 s; the dry run's stage took nobody's time
    assert grown("loopwright_stage_plant_seconds_sum", stage="relay") == pytest.approx(1.0)
    assert grown("loopwright_stage_plant_seconds_count", stage="preflight") == 1
    assert grown("loopwright_http_requests_total", method="GET", route="/jobs/{job_id}", status="404") == 2
    assert grown("loopwright_http_requests_total", method="POST", route="/loops/{tag}/retune", status="202") == 2
    assert grown("loopwright_http_requests_total", method="GET", route="none", status="404") == 1
    assert grown("loopwright_http_request_seconds_count", route="/jobs/{job_id}") == 4
    assert grown("loopwright_samples_lost_total", bus="virtual:test") == 3


def test_the_retries_of_the_station_are_shown(service: Service) -> None:
    station = Station()
    client = TestClient(app_of(service.jobs, checks={}, sdo_retries=station.sdo_retries))
    shown = ("loopwright_sdo_retries_total", (("bus", "virtual:test"),))
    assert shown not in samples(client)
    station.sdo_retries["virtual:test"] += 2
    assert samples(client)[shown] == 2


def test_a_scrape_goes_on_without_the_database(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert samples(client)["loopwright_database_up", ()] == 1

    def gone(*_: object) -> None:
        raise OperationalError("SELECT", {}, Exception("server closed the connection"))

    monkeypatch.setattr(service.store.engine, "connect", gone)
    found = samples(client)
    assert found["loopwright_database_up", ()] == 0 and ("loopwright_loops", (("bus", "virtual:test"),)) in found
    assert not any(name == "loopwright_jobs" for name, _ in found)


def test_an_sdo_without_answer_counts_its_retries() -> None:
    station = Station()
    tuner = Tuner("virtual:nobody", 0x20, None, station=station, sdo_timeout_s=0.0, sdo_tries=3)
    with pytest.raises(TunerError) as caught:
        tuner.read("controller_mode")
    tuner.close()
    assert caught.value.kind is FailureKind.TIMEOUT and station.sdo_retries == {"virtual:nobody": 2}


# logs


def test_lines_of_a_job_carry_job_and_loop(
    service: Service, client: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    lines: list[dict[str, Any]] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(json.loads(JsonLines().format(record)))  # in the thread that logs: there the fields are

    keep = Keep()
    logging.getLogger().addHandler(keep)
    caplog.set_level(logging.DEBUG)
    try:
        job = finished(service, client)["id"]
        service.tune.ends = ValueError("a defect")
        bad = finished(service, client)["id"]
        until(lambda: any(line["message"].startswith("job failed") for line in lines))  # it is told after it is stored
    finally:
        logging.getLogger().removeHandler(keep)
    told = [
        (x["message"].partition(",")[0], x["job"], x["loop"])
        for x in lines
        if x["logger"] == "loopwright.service.jobs.worker"
    ]
    assert told == [
        ("job started", job, TAG), ("job proposes new gains", job, TAG),
        ("job started", bad, TAG), ("a defect in the job", bad, TAG), ("job failed", bad, TAG),
    ]  # fmt: skip
    (failure,) = [x for x in lines if "exception" in x]
    assert "ValueError: a defect" in failure["exception"] and failure["level"] == "error"
    (asked, _) = [x for x in lines if x["logger"] == "loopwright.service.api.gate.access_log" and x["method"] == "POST"]
    assert (asked["loop"], asked["status"], asked["key"]) == (TAG, 202, "local")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", asked["at"])


def test_a_line_is_one_line_whatever_is_in_it() -> None:
    with about(loop="A\nB", nothing=None):
        line = JsonLines().format(logging.makeLogRecord({"msg": 'two\nlines "quoted"', "levelname": "INFO"}))
    assert "\n" not in line and json.loads(line)["message"] == 'two\nlines "quoted"'


def test_an_answer_names_its_request(client: TestClient) -> None:
    one, other = (client.get(path).headers["x-request-id"] for path in ("/loops", "/nowhere"))
    assert one != other


def test_systemd_is_told_when_requests_are_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tell_systemd("READY=1")  # without systemd: nothing
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        tell_systemd("READY=1")
        assert systemd.recv(100) == b"READY=1"
    tell_systemd("STOPPING=1")  # a socket nobody reads is no reason to fail


def test_answers_do_not_wait_for_acknowledgements() -> None:
    with listen("127.0.0.1", 0) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


# the page of the API


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.tags: set[str] = set()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_document_and_page_are_made_once(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody may ask for them, without a key and as often as they like."""
    paths = ("/openapi.json", "/docs")
    first = [client.get(path).content for path in paths]
    monkeypatch.delattr(operations, "page")
    monkeypatch.setattr(client.app, "openapi", lambda: pytest.fail("it was made again"))
    assert [client.get(path).content for path in paths] == first


def test_no_request_waits_for_the_random_numbers_of_the_system(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a system call the event loop gives the interpreter away, and waits behind every thread that has work."""
    monkeypatch.setattr("random.SystemRandom.randbytes", lambda *_: pytest.fail("asked for in the event loop"))
    answers = [client.get("/healthz") for _ in range(2)]
    first, second = (answer.headers["x-request-id"] for answer in answers)
    assert re.fullmatch("[0-9a-f]{8}", first) and first != second


def test_the_page_shows_every_operation_and_loads_nothing(client: TestClient) -> None:
    answer = client.get("/docs")
    page = _Links()
    page.feed(answer.text)
    assert page.links == ["openapi.json"] and "script" not in page.tags and "http" not in answer.text
    document = client.get("/openapi.json").json()
    for path, item in document["paths"].items():
        assert path in page.text
        assert all(operation["summary"] in page.text for operation in item.values())
    assert "sp_deviation (body)" in page.text
    assert client.get("/redoc").status_code == 404
