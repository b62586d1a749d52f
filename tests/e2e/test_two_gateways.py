"""Two services over one PostgreSQL database, each with a loop on the hub: one watches and decides the other's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import httpx
import pytest

from tests.e2e.gatewaysite import CASE, LOOP, OTHER, UNREACHED, WATCHING, GatewaySite, database_server, patiently
from tests.unit.service.live_viewer import viewing
from tests.unit.service.postgres import Server

pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def database() -> Iterator[Server]:
    with database_server() as server:
        yield server


@pytest.fixture(scope="module")
def site(database: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewaySite]:
    with ExitStack() as stack:
        yield GatewaySite(stack, tmp_path_factory.mktemp("two"), database)


def test_what_is_seen(site: GatewaySite) -> None:
    found = site.live()
    assert (found["mode"], found["sp"], found["on_trial"]) == ("automatic", CASE.sp, False)
    assert (found["gains"]["Kp"], found["gains"]["Ti"]) == (pytest.approx(CASE.kp), pytest.approx(CASE.ti))
    with viewing(site.url) as viewer:
        row = viewer.row(LOOP, lambda row: row["pv"] is not None)
        assert row["gateway"] == OTHER and row["age_s"] < 3.0
        before = row["pv"], row["age_s"]
        assert viewer.row(LOOP, lambda row: (row["pv"], row["age_s"]) != before)["no_data"] is None
    gateways = {each["name"]: each for each in site.get("/gateways")}
    other = gateways[OTHER]
    assert (other["answers"], other["loops"], other["url"]) == (True, 1, "https://gw-2.example")
    assert other["buses"] == [{"bus": site.bus, "up": True, "why": None}] and gateways[WATCHING]["here"]
    # The loop of the gateway that watches has no node on the bus: as the other one sees it.
    answer = httpx.get(f"{site.other.wait_ready().split()[1]}/loops/{UNREACHED}", timeout=30.0, trust_env=False)
    assert answer.json()["live_error"]["reason"] == "node_lost", answer.text


def test_a_test_is_followed_and_aborted(site: GatewaySite) -> None:
    job = site.retune()
    with viewing(site.url, f"/live?loops={LOOP}") as viewer:
        seen = viewer.until("jobs", lambda found: any((each["progress"] or 0.0) > 0.05 for each in found["jobs"]))
        assert seen["jobs"][0]["gateway"] == OTHER and seen["jobs"][0]["remaining_plant_time_s"] > 0.0
        viewer.row(LOOP, lambda row: row["under_test"])
        assert site.post(f"{job}/abort", by="A. Lind").status_code == 202
        viewer.until("job", lambda event: event["data"].get("state") == "aborted")
        viewer.row(LOOP, lambda row: row["under_test"] is False)
    assert site.kp() == pytest.approx(CASE.kp)


def test_accepted_and_rolled_back(site: GatewaySite) -> None:
    job = site.proposal()
    new = site.get(job)["new_gains"]["Kp"]
    answer = site.post(f"{job}/accept", by="A. Lind")
    accepted_s = site.answered_s
    assert answer.status_code == 200 and answer.json()["state"] == "accepted", answer.text
    assert site.kp() == pytest.approx(new) and abs(new - CASE.kp) > 1.0
    patiently(lambda: site.live()["gains"]["Kp"] == pytest.approx(new))
    answer = site.post(f"{job}/rollback", by="A. Lind")
    assert answer.status_code == 200 and answer.json()["state"] == "rolled_back", answer.text
    assert site.kp() == pytest.approx(CASE.kp)
    print(f"accept answered in {accepted_s:.2f} s, rollback in {site.answered_s:.2f} s")
    decided = site.get(f"/decisions?loop={LOOP}")
    assert [(each["what"], each["by"], each["gateway"]) for each in decided[:2]] == [
        ("rollback", "A. Lind", WATCHING), ("accept", "A. Lind", WATCHING),
    ]  # fmt: skip


def test_the_other_gateway_is_killed(site: GatewaySite) -> None:
    job = site.proposal()
    site.other.kill()
    answer = site.post(f"{job}/accept", by="A. Lind")  # it was there just now: waited for, then withdrawn
    assert answer.status_code == 503 and answer.json()["reason"] == "gateway_lost", answer.text
    with viewing(site.url) as viewer:
        row = viewer.row(LOOP, lambda row: row["no_data"] and f"gateway {OTHER} does not answer" in row["no_data"])
        assert row["pv"] is None
    error = site.get(f"/loops/{LOOP}")["live_error"]
    assert error["reason"] == "gateway_lost" and OTHER in error["detail"]
    assert not next(each for each in site.get("/gateways") if each["name"] == OTHER)["answers"]
    answer = site.post(f"{job}/accept", by="A. Lind")
    assert answer.status_code == 503 and site.answered_s < 5.0, "it does not answer: nobody waits for it"
    site.start_other()
    assert site.live()["gains"]["Kp"] == pytest.approx(CASE.kp)
    assert site.get(job)["state"] == "proposed" and site.kp() == pytest.approx(CASE.kp)


def test_the_database_is_restarted(site: GatewaySite, database: Server) -> None:
    job = site.proposal()
    with viewing(site.url) as viewer:
        viewer.row(LOOP, lambda row: row["pv"] is not None)
        database.stop()
        away = "the database, by which it is seen, does not answer"
        row = viewer.row(LOOP, lambda row: row["no_data"] and away in row["no_data"])
        assert row["pv"] is None
        assert site.post(f"{job}/accept", by="A. Lind").status_code == 503
        assert site.kp() == pytest.approx(CASE.kp), "the loop goes on"
        database.start()
        assert viewer.row(LOOP, lambda row: row["pv"] is not None)["no_data"] is None
    patiently(lambda: site.post(f"{job}/accept", by="A. Lind").status_code in (200, 409))
    assert site.get(job)["state"] == "accepted"
    assert site.post(f"{job}/rollback", by="A. Lind").status_code == 200
    assert site.kp() == pytest.approx(CASE.kp)
