from __future__ import annotations

import hashlib
import json
import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import update
from sqlalchemy.exc import OperationalError
from typer.testing import CliRunner

from loopwright.service.api.gate.gate import Policy, is_loopback
from loopwright.service.api.gate.limits import Buckets, RequestLimits
from loopwright.service.cli import main as cli
from loopwright.service.inputs.request import FastRetune
from loopwright.service.security.keys import Scope, hash_key, matches, new_key
from loopwright.service.server.serving import NotSafe, Setup, serve
from loopwright.service.store import audit
from loopwright.service.store.keyring import REVOKED_WITHIN_S, KeyProblem, Keyring
from loopwright.service.store.store import Store
from loopwright.service.store.tables import KeyRow
from loopwright.service.telemetry.logs import JsonLines, Lines
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import NEW, OLD, TAG, Service
from tests.unit.service.postgres import Server

Open = Callable[..., TestClient]


@pytest.fixture
def keyring(service: Service) -> Keyring:
    return Keyring(service.store.engine)


@pytest.fixture
def open_client(service: Service) -> Iterator[Open]:
    clients = []

    def make(keyring: Keyring | None = None, *, key: str | None = None, **limits: Any) -> TestClient:
        local = keyring is None
        app = app_of(service.jobs, Policy(keyring, RequestLimits(**limits), local_only=local), {})
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        url = "http://127.0.0.1:8080" if local else "http://plant.example"
        clients.append(TestClient(app, base_url=url, headers=headers, raise_server_exceptions=False))
        return clients[-1]

    yield make
    for client in clients:
        client.close()


def secret_of(key: str) -> str:
    """The part that is not its id; underlines may be in it."""
    return key.split("_", 2)[2]


# keys


def test_a_key_is_kept_as_its_scrypt_hash_only(service: Service, keyring: Keyring, tmp_path: Path) -> None:
    row, key = keyring.create("control room", Scope.OPERATE)
    _, n, r, p, salt, digest = row.hash.split("$")
    again = hashlib.scrypt(key.encode(), salt=bytes.fromhex(salt), n=int(n), r=int(r), p=int(p), dklen=32)
    assert again.hex() == digest and int(n) * int(r) * 128 >= 16 << 20
    secret = secret_of(key).encode()
    files = [path for path in tmp_path.iterdir() if path.is_file()]
    assert files and not any(secret in path.read_bytes() for path in files)


def test_keys_differ_and_so_do_hashes_of_one() -> None:
    keys = {new_key()[1] for _ in range(100)}
    assert len(keys) == 100
    key = keys.pop()
    one, other = hash_key(key), hash_key(key)
    assert one != other and matches(key, one) and matches(key, other)
    assert not matches(keys.pop(), one) and not matches(key, "nonsense")


def test_what_a_keyring_takes(keyring: Keyring) -> None:
    row, key = keyring.create("a", Scope.READ)
    _, expired = keyring.create("b", Scope.READ, timedelta(seconds=-1))
    found = keyring.check(key)
    assert found is not None and found.id == row.id
    assert keyring.check(expired) is None
    for wrong in ("", "lw_", key[:-1] + ("A" if key[-1] != "A" else "B"), key.replace(row.id, "0" * 12), key + "x"):
        assert keyring.check(wrong) is None
    with pytest.raises(KeyProblem, match="valid key named 'a'"):
        keyring.create("a", Scope.ADMIN)
    keyring.revoke("a")
    assert keyring.check(key) is None
    with pytest.raises(KeyProblem, match="no key 'a'"):
        keyring.revoke("a")
    keyring.create("a", Scope.ADMIN)


def test_a_key_in_use_is_hashed_once_and_its_revocation_is_seen(service: Service) -> None:
    now = [0.0]
    keyring = Keyring(service.store.engine, lambda: now[0])
    row, key = keyring.create("a", Scope.READ)
    assert keyring.known(key) is None
    assert keyring.check(key) is not None and keyring.known(key) is not None
    Keyring(service.store.engine).revoke(row.id)  # another process
    now[0] += REVOKED_WITHIN_S + 0.01
    assert keyring.known(key) is None and keyring.check(key) is None and keyring.known(key) is None


# the door


@pytest.mark.parametrize("has", Scope)
def test_scopes(keyring: Keyring, open_client: Open, has: Scope, service: Service) -> None:
    client = open_client(keyring, key=keyring.create(has, has)[1])
    may_operate, may_admin = has in ("operate", "admin"), has == "admin"
    assert client.get("/loops").status_code == 200
    answer = client.post(f"/loops/{TAG}/retune", json={"by": "me"})
    assert answer.status_code == (202 if may_operate else 403)
    if not may_operate:
        assert "operate" in assert_problem(answer, 403)["detail"]
        assert service.store.recent() == []
    assert client.get("/audit").status_code == (200 if may_admin else 403)


@pytest.mark.parametrize("value", ["", "Bearer", "Bearer ", "Basic YTpi", "Bearer lw_0123456789ab_x", "bearer \x7f"])
def test_no_key_no_answer(keyring: Keyring, open_client: Open, value: str) -> None:
    client = open_client(keyring)
    answer = client.get("/loops", headers={"Authorization": value})
    assert_problem(answer, 401)
    assert answer.headers["www-authenticate"].startswith("Bearer")
    assert_problem(client.post(f"/loops/{TAG}/retune", json={"by": "me"}), 401)
    assert_problem(client.get("/nowhere"), 401)


def test_what_needs_no_key_says_nothing_of_the_installation(keyring: Keyring, open_client: Open) -> None:
    client = open_client(keyring)
    for path in ("/healthz", "/docs", "/openapi.json"):
        answer = client.get(path)
        assert answer.status_code == 200 and not any(x in answer.text for x in ("FIC-2", "virtual:test"))
    for path in ("/readyz", "/metrics", "/docs/", "/healthz/", "/%61udit", "/openapi.json/x"):
        assert client.get(path, follow_redirects=False).status_code == 401


def test_a_new_route_is_closed_by_default(service: Service, keyring: Keyring, open_client: Open) -> None:
    client = open_client(keyring, key=keyring.create("r", Scope.READ)[1])
    client.app.post("/made-later")(lambda: "open")  # type: ignore[attr-defined]
    assert_problem(client.post("/made-later"), 403)


def test_guessing_is_slowed_down_and_disturbs_no_one_with_a_key(keyring: Keyring, open_client: Open) -> None:
    client = open_client(keyring, bad_keys_burst=3, bad_keys_per_s=0.01)
    _, key = keyring.create("a", Scope.READ)
    good = {"Authorization": f"Bearer {key}"}
    assert client.get("/loops", headers=good).status_code == 200
    guess = {"Authorization": f"Bearer {new_key()[1]}"}
    assert [client.get("/loops", headers=guess).status_code for _ in range(5)] == [401, 401, 401, 429, 429]
    assert int(client.get("/loops", headers=guess).headers["retry-after"]) > 60
    assert client.get("/loops", headers=good).status_code == 200


def test_keys_that_cannot_be_read_are_a_503(keyring: Keyring, open_client: Open, monkeypatch: Any) -> None:
    def gone(key: str) -> None:
        raise OperationalError("SELECT", {}, Exception("server closed the connection"))

    monkeypatch.setattr(keyring, "check", gone)
    answer = open_client(keyring, key=new_key()[1]).get("/loops")
    assert_problem(answer, 503)
    assert answer.headers["retry-after"]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:8080"}, 200),
        ({"Host": "[::1]:8080"}, 200),
        ({"Host": "[::1]"}, 200),
        ({"Host": "127.0.0.1"}, 200),
        ({"Host": "rebound.example:8080"}, 403),
        ({"Host": "127.0.0.1.example"}, 403),
        ({"Host": ""}, 403),
        ({"Origin": "http://127.0.0.1:8080"}, 200),
        ({"Origin": "https://evil.example"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_without_keys_a_web_page_cannot_reach_in(open_client: Open, headers: dict[str, str], status: int) -> None:
    assert open_client().get("/loops", headers=headers).status_code == status


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("127.8.8.8", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("::", False),
     ("10.0.0.1", False), ("example.org", False), ("", False)],
)  # fmt: skip
def test_which_addresses_are_this_machine(host: str, local: bool) -> None:
    assert is_loopback(host) is local


# limits


@pytest.mark.parametrize("chunked", [False, True])
def test_a_body_too_large(open_client: Open, chunked: bool, service: Service) -> None:
    client = open_client(body_bytes=2000)
    body = json.dumps({"by": "x" * 50}).encode() + b" " * 5000
    content = iter([body[:1000], body[1000:]]) if chunked else body
    json_headers = {"content-type": "application/json"}
    assert_problem(client.post(f"/loops/{TAG}/retune", content=content, headers=json_headers), 413)
    assert service.store.recent() == []
    assert client.post(f"/loops/{TAG}/retune", content=body[:1500], headers=json_headers).status_code == 202


def test_a_caller_that_asks_too_often(keyring: Keyring, open_client: Open) -> None:
    client = open_client(keyring, rate_per_s=0.1, burst=3)
    keys = [{"Authorization": f"Bearer {keyring.create(name, Scope.READ)[1]}"} for name in ("a", "b")]
    assert [client.get("/loops", headers=keys[0]).status_code for _ in range(4)] == [200, 200, 200, 429]
    answer = client.get("/loops", headers=keys[0])
    assert 1 <= int(assert_problem(answer, 429) and answer.headers["retry-after"]) <= 10
    assert client.get("/loops", headers=keys[1]).status_code == 200
    assert client.get("/healthz").status_code == 200
    assert client.get("/metrics", headers=keys[0]).status_code == 200


def test_too_many_at_once(open_client: Open) -> None:
    full = open_client(at_once=0)
    answer = full.get("/loops")
    assert_problem(answer, 503)
    assert answer.headers["retry-after"] == "1"
    assert full.get("/jobs/x/events").status_code == 404 and full.get("/healthz").status_code == 200
    assert open_client(streams_at_once=0).get("/jobs/x/events").status_code == 503
    busy = open_client(computations_at_once=0)
    assert busy.get("/jobs/x/alternatives").status_code == 503 and busy.get("/loops").status_code == 200
    one = open_client(at_once=1)
    assert [one.get("/loops").status_code for _ in range(3)] == [200, 200, 200]


def test_a_bucket_fills_again() -> None:
    now = [0.0]
    buckets = Buckets(2.0, 3, lambda: now[0], maximum=2)
    assert [buckets.take("a") for _ in range(3)] == [0.0, 0.0, 0.0]
    assert buckets.take("a") == pytest.approx(0.5)
    now[0] = 0.5
    assert buckets.take("a") == 0.0 and buckets.take("a") > 0
    now[0] = 100.0
    assert [buckets.take("a") == 0.0 for _ in range(4)] == [True, True, True, False]
    buckets.take("b")
    buckets.take("c")
    assert buckets.take("a") == 0.0  # forgotten: no more than two callers are remembered


# the audit log


def trail(client: TestClient) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = client.get("/audit").json()
    return entries


def test_every_change_is_written_down(service: Service, keyring: Keyring, open_client: Open) -> None:
    boss, key = keyring.create("boss", Scope.ADMIN)
    client = open_client(keyring, key=key)
    job = client.post(f"/loops/{TAG}/retune", json={"by": "night shift"}).json()["id"]
    service.wait(job)
    client.post(f"/jobs/{job}/accept", json={"by": "operator A"})
    client.post(f"/jobs/{job}/accept")  # a 409 changes nothing
    client.post(f"/jobs/{job}/rollback")
    service.tune.hold.clear()
    other = client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()["id"]
    client.post(f"/jobs/{other}/abort")
    service.wait(other)
    found = trail(client)
    assert [(x["what"], x["subject"]) for x in reversed(found)] == [
        ("key_create", boss.id), ("retune", job), ("accept", job), ("rollback", job), ("retune", other),
        ("abort", other),
    ]  # fmt: skip
    accept, rollback = found[3], found[2]
    assert (accept["key"], accept["key_id"], accept["by"], accept["loop"]) == ("boss", boss.id, "operator A", TAG)
    assert (accept["before"]["state"], accept["after"]["state"]) == ("proposed", "accepted")
    assert (accept["before"]["gains"]["Kp"], accept["after"]["gains"]["Kp"]) == (OLD.Kp, NEW.Kp)
    assert (rollback["before"]["gains"]["Kp"], rollback["after"]["gains"]["Kp"]) == (NEW.Kp, OLD.Kp)
    assert found[4]["after"]["by"] == "night shift" and found[0]["before"] == {"state": "running"}
    assert "hash" not in json.dumps(found) and key not in json.dumps(found)


def test_a_decision_that_failed_in_the_controller_is_written_down(
    service: Service, open_client: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = open_client()
    job = client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()["id"]
    service.wait(job)
    service.controller.absent = Reason.NODE_LOST
    assert client.post(f"/jobs/{job}/accept").status_code == 503
    last = trail(client)[0]
    assert (last["key"], last["what"], last["before"]) == ("local", "accept_failed", {"state": "proposed"})
    assert "node_lost" in last["after"]["error"]
    assert str(Failed(Reason.NODE_LOST, "node 32 does not answer").detail) in last["after"]["error"]


def test_the_audit_log_in_pages(keyring: Keyring, open_client: Open) -> None:
    for n in range(5):
        keyring.create(f"k{n}", Scope.READ)
    client = open_client()
    seen, url = [], "/audit?limit=2&what=key_create"
    while url:
        page = client.get(url)
        seen += [entry["after"]["name"] for entry in page.json()]
        url = page.links.get("next", {}).get("url", "")
    assert seen == ["k4", "k3", "k2", "k1", "k0"]
    assert client.get(f"/audit?loop={TAG}").json() == []


def test_keys_and_audit_log_on_a_shared_database(tmp_path: Path, postgres: Server) -> None:
    """A key made on one host is valid on the other, and the log is one."""
    url = postgres.database()
    stores = [Store(tmp_path / name, url, name) for name in ("one", "two")]
    one, two = (Keyring(store.engine) for store in stores)
    row, key = one.create("a", Scope.OPERATE)
    found = two.check(key)
    assert found is not None and found.id == row.id
    job = stores[1].create("L", {"x": 1}, "me", False)
    stores[1].request_stop(job.id, Reason.OPERATOR, "me")
    two.revoke(row.id)
    assert one.check(key) is None
    entries = [(entry.what, entry.subject) for entry in audit.trail(stores[0].engine, 10)]
    assert entries == [("key_revoke", row.id), ("abort", job.id), ("retune", job.id), ("key_create", row.id)]
    for store in stores:
        store.close()


def test_a_change_and_its_entry_are_one_transaction(service: Service) -> None:
    connection = sqlite3.connect(service.store.engine.url.database or "")
    connection.execute("DROP TABLE audit")
    connection.close()
    with pytest.raises(OperationalError):
        service.store.create(TAG, {}, "me", False)
    assert service.store.recent() == []


# logs


def test_no_key_gets_into_a_log(
    keyring: Keyring, open_client: Open, caplog: pytest.LogCaptureFixture, service: Service
) -> None:
    caplog.set_level(logging.DEBUG)
    _, key = keyring.create("a", Scope.OPERATE)
    client = open_client(keyring, key=key)
    client.post(f"/loops/{TAG}/retune?key={key}", json={"by": key})
    client.get(f"/jobs/{key}")
    logging.getLogger("loopwright.service").error("somebody typed %s", key)
    try:
        raise ValueError(key)
    except ValueError:
        logging.getLogger("loopwright.service").exception("and here")
    secret = secret_of(key)
    assert any(secret in record.getMessage() for record in caplog.records)  # else nothing would be proved
    for formatter in (JsonLines(), Lines()):
        lines = [formatter.format(record) for record in caplog.records]
        assert not any(secret in line for line in lines)
        assert any(key[:15] in line for line in lines)  # which key it was can be told
        assert any("key=a" in line or '"key": "a"' in line for line in lines)


# the commands


def run(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, list(arguments))


def test_keys_from_the_command_line(tmp_path: Path) -> None:
    data = ("--data", str(tmp_path / "data"))
    missing = run("key", "list", *data)
    assert missing.exit_code == 2 and "not a data folder" in missing.stderr
    made = run("key", "create", "shift", "--scope", "operate", *data)
    assert made.exit_code == 0 and made.stdout.startswith("lw_") and len(made.stdout.split()) == 1
    assert run("key", "create", "shift", "--scope", "read", *data).exit_code == 2
    assert run("key", "create", "x", "--scope", "king", *data).exit_code == 2
    assert run("key", "create", "\n", "--scope", "read", *data).exit_code == 2
    brief = json.loads(run("key", "create", "brief", "--scope", "read", "--days", "30", "--json", *data).stdout)
    listed = json.loads(run("key", "list", "--json", *data).stdout)
    assert [(k["name"], k["scope"]) for k in listed if k["valid"]] == [("shift", "operate"), ("brief", "read")]
    assert listed[1]["expires_at"] == brief["expires_at"] > listed[1]["created_at"]
    assert made.stdout.strip() not in json.dumps(listed) and "hash" not in listed[0]
    assert run("key", "revoke", "shift", *data).exit_code == 0
    assert run("key", "revoke", "shift", *data).exit_code == 2
    assert [k["valid"] for k in json.loads(run("key", "list", "--json", *data).stdout)] == [False, True]
    service = Service(tmp_path / "data")
    rows = TestClient(app_of(service.jobs, checks={})).get("/audit").json()
    assert [row["what"] for row in rows] == ["key_revoke", "key_create", "key_create"]
    assert all(row["key"].startswith("cli:") for row in rows)
    service.close()


@pytest.mark.parametrize(
    ("bind", "auth", "words"),
    [("0.0.0.0", None, "key create"), ("::", None, "key create"), ("127.0.0.1", True, "key create"),
     ("0.0.0.0", False, "--no-auth")],
)  # fmt: skip
def test_serve_refuses_what_is_not_safe(tmp_path: Path, bind: str, auth: bool | None, words: str) -> None:
    loops = tmp_path / "loops.yaml"
    loops.write_text(
        "loops: [{tag: A, bus: 'virtual:x', controller_node: 32, pv_unit: degC, pv_limits: {low: 0, high: 9}, "
        "t95_s: 9, sp_deviation: 2}]"
    )
    before = logging.getLogger().handlers[:]
    try:
        with pytest.raises(NotSafe, match=words):
            serve(Setup(loops, tmp_path / "data", bind, 0, auth=auth))
    finally:
        logging.getLogger().handlers[:] = before
        logging.captureWarnings(False)


@pytest.mark.parametrize("how", ["revoked", "expired"])
def test_a_stream_ends_with_the_key_that_it_was_opened_with(
    service: Service, open_client: Open, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr("loopwright.service.api.events.REVOKED_WITHIN_S", 0.05)
    asked = threading.Event()

    class Watched(Keyring):
        def still_valid(self, key_id: str) -> bool:
            found = super().still_valid(key_id)
            asked.set()
            return found

    keyring = Watched(service.store.engine)
    row, key = keyring.create("a", Scope.READ, timedelta(days=1))
    service.tune.hold.clear()
    job = service.jobs.start(TAG, FastRetune()).id
    client = open_client(keyring, key=key)
    with ThreadPoolExecutor(1) as beside:
        answer = beside.submit(client.get, f"/jobs/{job}/events")
        assert asked.wait(30) and not answer.done()
        if how == "revoked":
            keyring.revoke(row.id)
        else:
            with service.store.writing() as session:
                session.execute(update(KeyRow).values(expires_at="2020-01-01T00:00:00.000Z"))
        text = answer.result(30).text
    assert service.store.get(job).state == "running"
    assert text.startswith("retry: 2000\n\nid: 1\n")
    assert text.endswith(": the key of this stream was revoked or has expired\n\n")
