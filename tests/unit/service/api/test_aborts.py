"""An abort is heard before it waits for anything: the database at each door, a body, a turn. Who it was is stored."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.gate.concurrency import Full, Places, stops_a_test
from loopwright.service.api.gate.gate import Policy
from loopwright.service.security.keys import Scope, new_key
from loopwright.service.security.sessions import BrowserSessions
from loopwright.service.store import audit
from loopwright.service.store import keyring as keyring_module
from loopwright.service.store.idempotency import IdempotencyKeys
from loopwright.service.store.keyring import ABORTS_FOR_S, REVOKED_WITHIN_S, Keyring
from loopwright.service.store.tables import AuditRow
from loopwright.tuning.reasons import Reason
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service, away
from tests.unit.service.processes import PATIENCE_S, until

KEY = {"Idempotency-Key": "7f1c4f5e-2b8f-4a36-9f3a-5d0b3c1e8a77"}


def aborted(service: Service, job_id: str) -> AuditRow:
    """The one entry of the abort in the audit log, when the job has ended for it."""
    service.wait(job_id)
    assert service.jobs.journal.flush(PATIENCE_S)
    row = service.store.get(job_id)
    assert (row.state, row.reason, row.stop_reason) == ("aborted", Reason.OPERATOR, Reason.OPERATOR)
    (event,) = [each for each in service.store.events(job_id) if each.kind == "abort_requested"]
    (entry,) = [each for each in audit.trail(service.store.engine, 100) if each.what == "abort"]
    assert (entry.subject, entry.by) == (job_id, event.data["by"])
    return entry


@pytest.mark.parametrize(
    ("method", "path", "stops"),
    [("POST", "/jobs/4f0c2a9be113/abort", True), ("POST", "/batches/4f0c2a9be113/abort", True),
     ("GET", "/jobs/4f0c2a9be113/abort", False), ("DELETE", "/jobs/4f0c2a9be113/abort", False),
     ("POST", "/jobs/4f0c2a9be113/accept", False), ("POST", "/loops/TIC-101/acknowledge", False),
     ("POST", "/jobs/x/abort/abort", False), ("POST", "/loops/x/abort", False)],
)  # fmt: skip
def test_which_requests_stop_a_test(method: str, path: str, stops: bool) -> None:
    assert stops_a_test(method, path) is stops


def test_with_an_idempotency_key_it_does_not_wait_for_the_claim(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `loopwright job ID --abort` sends it. The claim, which fails in the end, keeps neither the test nor the
    answer."""
    free = threading.Event()

    def locked(*_: Any) -> None:
        assert free.wait(PATIENCE_S)
        away()

    job_id = service.under_test()
    monkeypatch.setattr(IdempotencyKeys, "_claim", locked)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(client.post, f"/jobs/{job_id}/abort", json={"by": "operator A"}, headers=KEY)
        try:
            service.wait(job_id)
            assert not answer.done()
        finally:
            free.set()
    assert answer.result().status_code == 202
    assert aborted(service, job_id).by == "operator A"


def test_the_database_takes_nothing_from_the_claim_to_the_end(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.under_test()
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "writing", away)
        first = client.post(f"/jobs/{job_id}/abort", json={"by": "operator A"}, headers=KEY)
        again = client.post(f"/jobs/{job_id}/abort", json={"by": "operator A"}, headers=KEY)
        assert first.status_code == again.status_code == 202
    assert aborted(service, job_id).by == "operator A"


def test_another_request_that_the_database_does_not_take_is_refused_as_before(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.store, "writing", away)
    for path in (f"/loops/{TAG}/retune", f"/loops/{TAG}/acknowledge", "/jobs/4f0c2a9be113/accept"):
        assert_problem(client.post(path, json={}, headers=KEY), 503)


def without_a_turn(client: TestClient, path: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Places, "check", lambda *_: (_ for _ in ()).throw(Full(503, "64 aborts are under way already")))
        return client.post(path, json={"by": "me"}).status_code


def with_a_key_of_another_request(client: TestClient, path: str) -> int:
    assert client.post("/loops/FIC-2/acknowledge", json={}, headers=KEY).status_code == 200
    return client.post(path, json={"by": "me"}, headers=KEY).status_code


@pytest.mark.parametrize(("ask", "status"), [(without_a_turn, 503), (with_a_key_of_another_request, 422)])
def test_a_refused_one_is_heard_and_written_down(
    service: Service, client: TestClient, ask: Callable[[TestClient, str], int], status: int
) -> None:
    job_id = service.under_test()
    assert ask(client, f"/jobs/{job_id}/abort") == status
    assert aborted(service, job_id).key == "local"


def test_a_job_that_ends_while_the_request_waits_was_aborted_by_it(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = service.store.request_stop

    def slow(job_id: str, *more: Any) -> Any:
        service.wait(job_id)
        until(lambda: service.jobs.running(job_id) is None)
        return write(job_id, *more)

    job_id = service.under_test()
    monkeypatch.setattr(service.store, "request_stop", slow)
    answer = client.post(f"/jobs/{job_id}/abort", json={"by": "operator A"})
    assert (answer.status_code, answer.json()["state"]) == (202, "aborted")
    assert aborted(service, job_id).by == "operator A"
    assert_problem(client.post(f"/jobs/{job_id}/abort", json={"by": "operator B"}), 409)
    assert aborted(service, job_id).by == "operator A"


class Door:
    """A service with keys, one of which has begun a test; then its database cannot be reached."""

    def __init__(self, service: Service, signed_in: bool) -> None:
        self.now = 0.0
        self.service = service
        self.keyring = Keyring(service.store.engine, lambda: self.now)
        self.sessions = BrowserSessions(lambda: self.now)
        policy = Policy(self.keyring, sessions=self.sessions)
        self.client = TestClient(
            app_of(service.jobs, policy, {}), base_url="http://plant.example", raise_server_exceptions=False
        )
        self.signed_in = signed_in

    def let_in(self, scope: Scope = Scope.OPERATE, valid_for: timedelta | None = None) -> str:
        row, key = self.keyring.create("control room", scope, valid_for)
        if self.signed_in:
            self.client.headers["X-Loopwright-CSRF"] = self.client.post("/session", json={"key": key}).json()["csrf"]
        else:
            self.client.headers["Authorization"] = f"Bearer {key}"
        assert self.client.get("/loops").status_code == 200
        return row.id

    def cut_off(self, monkeypatch: pytest.MonkeyPatch, since_s: float = 60.0) -> None:
        self.now += since_s
        monkeypatch.setattr(self.keyring, "_session", away)
        monkeypatch.setattr(self.service.store, "writing", away)


@pytest.fixture(params=[False, True], ids=["key", "session"])
def door(service: Service, request: pytest.FixtureRequest) -> Iterator[Door]:
    found = Door(service, request.param)
    yield found
    found.client.close()


def test_a_key_that_was_valid_aborts_while_the_keys_cannot_be_read(
    service: Service, door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    key_id, job_id = door.let_in(), service.under_test()
    with monkeypatch.context() as patch:
        door.cut_off(patch)
        assert door.client.post(f"/jobs/{job_id}/abort", json={"by": "A"}).status_code == 202
        for method, path in (("GET", "/loops"), ("POST", f"/jobs/{job_id}/accept"), ("POST", f"/loops/{TAG}/retune")):
            detail = assert_problem(door.client.request(method, path), 503)["detail"]
            assert "the database with the keys" in detail
    assert aborted(service, job_id).key_id == key_id


def test_an_abort_does_not_wait_long_for_keys_that_are_not_read(
    service: Service, door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    door.let_in()
    job_id, over = service.under_test(), threading.Event()

    def silent(*_: Any) -> None:
        assert over.wait(PATIENCE_S)
        away()

    with monkeypatch.context() as patch:
        door.cut_off(patch)
        patch.setattr(door.keyring, "_session", silent)
        try:
            assert door.client.post(f"/jobs/{job_id}/abort", json={"by": "A"}).status_code == 202
        finally:
            over.set()
    assert aborted(service, job_id).by == "A"


Then = Callable[[Door, pytest.MonkeyPatch], None]


def not_known(door: Door, _: pytest.MonkeyPatch) -> None:
    door.client.headers["Authorization"] = f"Bearer {new_key()[1]}"


def another_secret(door: Door, _: pytest.MonkeyPatch) -> None:
    key = str(door.client.headers["Authorization"])
    door.client.headers["Authorization"] = key[:-1] + ("A" if key[-1] != "A" else "B")


def revoked_and_seen(door: Door, _: pytest.MonkeyPatch) -> None:
    Keyring(door.service.store.engine).revoke("control room")
    door.now += REVOKED_WITHIN_S + 0.01
    assert door.client.get("/loops").status_code == 401


def expired(_: Door, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(keyring_module, "now", lambda: "9999-01-01T00:00:00.000Z")


def nothing(*_: Any) -> None: ...


@pytest.mark.parametrize(
    ("scope", "then", "since_s", "with_key", "signed_in"),
    [
        (Scope.READ, nothing, 60.0, 403, 403),
        (Scope.OPERATE, expired, 60.0, 503, 503),
        (Scope.OPERATE, revoked_and_seen, 60.0, 503, 401),
        (Scope.OPERATE, nothing, ABORTS_FOR_S + 1.0, 503, 401),
        (Scope.OPERATE, not_known, 60.0, 503, None),
        (Scope.OPERATE, another_secret, 60.0, 503, None),
    ],
)
def test_which_keys_do_not_abort_while_the_keys_cannot_be_read(
    service: Service,
    door: Door,
    monkeypatch: pytest.MonkeyPatch,
    scope: Scope,
    then: Then,
    since_s: float,
    with_key: int,
    signed_in: int | None,
) -> None:
    """signed_in: the status for a session, None where a key alone can be so."""
    status = signed_in if door.signed_in else with_key
    if status is None:
        return
    job_id = service.under_test()
    door.let_in(scope, timedelta(hours=1))
    with monkeypatch.context() as patch:
        then(door, patch)
        door.cut_off(patch, since_s)
        assert_problem(door.client.post(f"/jobs/{job_id}/abort", json={"by": "A"}), status)
    running = service.jobs.running(job_id)
    assert running is not None and running.stop_reason is None


def test_an_abort_without_the_keys_opens_the_door_for_nothing_else(
    service: Service, door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither a key nor a session counts as looked at by it."""
    door.let_in()
    job_id = service.under_test()
    with monkeypatch.context() as patch:
        door.cut_off(patch)
        assert door.client.post(f"/jobs/{job_id}/abort").status_code == 202
    Keyring(service.store.engine).revoke("control room")
    assert_problem(door.client.get("/loops"), 401)


def test_a_key_in_use_by_a_session_alone_counts_as_seen(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads of an hour ago count, not only the sign-in."""
    now = [0.0]
    keyring = Keyring(service.store.engine, lambda: now[0])
    row, key = keyring.create("a", Scope.OPERATE)
    assert keyring.check(key) is not None
    now[0] = ABORTS_FOR_S
    assert keyring.still_valid(row.id)
    now[0] = 2 * ABORTS_FOR_S
    assert keyring.last_valid(row.id) is not None
    Keyring(service.store.engine).revoke("a")
    assert not keyring.still_valid(row.id)
    assert keyring.last_valid(row.id) is None
