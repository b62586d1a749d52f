"""A POST that is repeated with its Idempotency-Key: one effect, one answer, whatever breaks in between."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from loopwright.service.api.gate.gate import Policy
from loopwright.service.api.gate.limits import RequestLimits
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.manager import Jobs
from loopwright.service.security.keys import Scope
from loopwright.service.store import audit, idempotency_effects
from loopwright.service.store.clock_watch import STEP, ClockWatch, Seen
from loopwright.service.store.hosts import Ages, keep_seen
from loopwright.service.store.idempotency import MAX_BYTES, Answer, IdempotencyKeys, OtherRequest
from loopwright.service.store.idempotency_effects import Claim, StillAnswering
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.store import Store
from loopwright.tuning.reasons import Failed, Reason
from tests.unit.service.api.test_api import GOLDEN, assert_problem
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import NEW, TAG, Service, away, held_acceptances
from tests.unit.service.postgres import Server
from tests.unit.service.processes import until

KEY = {"Idempotency-Key": "7f1c4f5e-2b8f-4a36-9f3a-5d0b3c1e8a77"}
RETUNE = f"/loops/{TAG}/retune"
MODEL = {"model": {"K": 1.0, "T_s": 3.0, "L_s": 1.0}, "method": "simc"}
YES = Answer(200, {"content-type": "application/json"}, b'{"yes": true}')
AT = datetime(2026, 1, 31, 12, tzinfo=UTC)


def post(client: TestClient, path: str, body: dict[str, Any] | None = None, **headers: str) -> Any:
    named = {"by": "me"} if path.endswith("/retune") and body is None else {}
    return client.post(path, json=body or named, headers=KEY | headers)


def same(one: Any, other: Any) -> bool:
    names = ("content-type", "location", "content-length")
    return (one.status_code, one.content) == (other.status_code, other.content) and all(
        one.headers.get(name) == other.headers.get(name) for name in names
    )


def proposed(service: Service) -> str:
    job = service.jobs.start(TAG, FastRetune()).id
    service.wait(job)
    assert service.store.get(job).state == "proposed"
    return job


def running(service: Service) -> str:
    service.tune.hold.clear()
    job = service.jobs.start(TAG, FastRetune()).id
    assert service.tune.inside.wait(10)
    return job


# what is asked: its path and body, and how often it may have been done


def a_retune(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    service.tune.hold.clear()  # so that the second one would find the loop busy
    return RETUNE, {"by": "me"}


def a_dry_run(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return RETUNE, {"dry_run": True}


def a_retune_of_many(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return "/batches", {"by": "me", "pattern": "*"}


def an_acceptance(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return f"/jobs/{proposed(service)}/accept", {"by": "me"}


def a_rollback(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return f"/jobs/{proposed(service)}/rollback", {}


def an_abort(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return f"/jobs/{running(service)}/abort", {}


def an_abort_of_many(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    service.tune.hold.clear()
    found = client.post("/batches", json={"by": "me", "pattern": "*"}).json()
    assert service.tune.inside.wait(10)
    return f"{found['url']}/abort", {}


def a_tuning(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return "/tunings", MODEL


def an_acknowledged_loop(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return f"/loops/{TAG}/acknowledge", {}


def a_lock(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    return f"/loops/{TAG}/lock", {"reason": "valve", "by": "me"}


def an_unlock(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    client.post(f"/loops/{TAG}/lock", json={"reason": "valve"})
    return f"/loops/{TAG}/unlock", {}


def an_acknowledgement(service: Service, client: TestClient) -> tuple[str, dict[str, Any]]:
    service.tune.ends = Failed(Reason.NODE_LOST, "silent")
    service.wait(service.jobs.start(TAG, FastRetune()).id)
    (alarm,) = client.get("/alarms").json()
    return f"/alarms/{alarm['id']}/acknowledge", {"by": "me"}


Asked = Callable[[Service, TestClient], tuple[str, dict[str, Any]]]
EVERY: list[Asked] = [
    a_retune, a_dry_run, a_retune_of_many, an_acceptance, a_rollback, an_abort, an_abort_of_many, a_tuning,
    an_acknowledged_loop, a_lock, an_unlock, an_acknowledgement,
]  # fmt: skip


def done(service: Service) -> tuple[int, int, int]:
    """Jobs, retunes of many and entries of the audit log."""
    return (
        len(service.store.recent()),
        len(TestClient(app_of(service.jobs, checks={})).get("/batches").json()),
        len(audit.trail(service.store.engine, 1000)),
    )


@pytest.mark.parametrize("asked", EVERY)
def test_repeated_with_its_key_it_is_done_once_and_answered_the_same(
    service: Service, client: TestClient, asked: Asked
) -> None:
    path, body = asked(service, client)
    first = post(client, path, body)
    assert first.status_code in (200, 202), first.text
    service.tune.hold.set()
    for row in service.store.unfinished():
        service.wait(row.id)
    was = done(service) if asked is not a_retune_of_many else None  # whose thread goes on making jobs
    again = [post(client, path, body) for _ in range(3)]
    assert all(same(first, other) for other in again)
    assert was is None or done(service) == was
    assert len(client.get("/batches").json()) == (1 if "batches" in path else 0)


def test_every_post_of_the_document_takes_the_key_and_says_so() -> None:
    document = json.loads(GOLDEN.read_text())
    posts = {path: item["post"] for path, item in document["paths"].items() if "post" in item}
    paths = {path.replace("{tag}", "").replace("{job_id}", "").replace("{batch_id}", "") for path in posts}
    assert len(paths) >= 10
    for operation in posts.values():
        (key,) = [x for x in operation["parameters"] if x["name"] == "Idempotency-Key"]
        assert key["in"] == "header" and not key["required"] and {"409", "422"} <= operation["responses"].keys()


def test_quotes_around_the_key_make_no_difference(service: Service, client: TestClient) -> None:
    first = post(client, RETUNE)
    service.wait(first.json()["id"])
    assert same(first, post(client, RETUNE, **{"Idempotency-Key": f'"{KEY["Idempotency-Key"]}"'}))


def test_another_key_is_another_request(service: Service, client: TestClient) -> None:
    jobs = set()
    for n in range(3):
        answer = post(client, RETUNE, **{"Idempotency-Key": f"k{n}"})
        service.wait(answer.json()["id"])
        jobs.add(answer.headers["location"])
    assert len(jobs) == 3


@pytest.mark.parametrize(
    ("path", "body"),
    [(RETUNE, {"Ms": 1.4}), (RETUNE, {"by": "you"}), ("/loops/FIC-2/retune", {}), (f"{RETUNE}?x=1", {}),
     ("/batches", {"by": "me", "pattern": "*"})],
)  # fmt: skip
def test_the_same_key_with_another_request_is_refused_in_words(
    service: Service, client: TestClient, path: str, body: dict[str, Any]
) -> None:
    first = post(client, RETUNE)
    service.wait(first.json()["id"])
    detail = assert_problem(post(client, path, body), 422)["detail"]
    assert KEY["Idempotency-Key"] in detail and "another path or body" in detail and "a key of its own" in detail
    assert len(service.store.recent()) == 1


@pytest.mark.parametrize("key", ["", " ", "a b", "a,b", "ä", '"a', 'a"', '""', "x" * 129, '"a";p=1', "a\\b"])
def test_keys_that_are_none(service: Service, client: TestClient, key: str) -> None:
    answer = client.post(RETUNE, json={}, headers={"Idempotency-Key": key.encode()})
    assert "1 to 128" in assert_problem(answer, 422)["detail"]
    assert service.store.recent() == []


def test_two_keys_are_none(service: Service, client: TestClient) -> None:
    assert_problem(client.post(RETUNE, json={}, headers=[("Idempotency-Key", "a"), ("Idempotency-Key", "b")]), 422)
    assert service.store.recent() == []


def test_a_get_has_no_need_of_it(client: TestClient) -> None:
    assert client.get("/loops", headers={"Idempotency-Key": "a b"}).status_code == 200


def test_while_the_first_is_being_answered(service: Service, client: TestClient) -> None:
    """409 with Retry-After, and the answer of the first when there is one."""
    job = proposed(service)
    with held_acceptances() as (inside, free), ThreadPoolExecutor(1) as pool:
        first = pool.submit(post, client, f"/jobs/{job}/accept")
        try:
            assert inside.wait(10)
            answer = post(client, f"/jobs/{job}/accept")
            assert "still being answered" in assert_problem(answer, 409)["detail"]
            assert int(answer.headers["retry-after"]) >= 1
        finally:
            free.set()
        assert first.result(10).status_code == 200
    assert same(first.result(), post(client, f"/jobs/{job}/accept"))


def test_many_at_the_same_time_make_one_job(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    together = threading.Barrier(8)

    def ask(_: int) -> Any:
        together.wait(10)
        return post(client, RETUNE)

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(ask, range(8)))
    (job,) = service.store.recent()
    for answer in answers:
        if answer.status_code == 202:
            assert answer.headers["location"] == f"/jobs/{job.id}"
        else:
            assert answer.status_code == 409 and answer.headers["retry-after"], answer.text
    assert any(answer.status_code == 202 for answer in answers)


def test_keys_are_of_who_asks(service: Service) -> None:
    keyring = Keyring(service.store.engine)
    client = TestClient(app_of(service.jobs, Policy(keyring), {}), raise_server_exceptions=False)
    for name, tag in (("a", TAG), ("b", "FIC-2")):
        key = keyring.create(name, Scope.OPERATE)[1]
        assert post(client, f"/loops/{tag}/retune", Authorization=f"Bearer {key}").status_code == 202
    assert len(service.store.recent()) == 2
    read = keyring.create("c", Scope.READ)[1]
    assert post(client, RETUNE, Authorization=f"Bearer {read}").status_code == 403


def test_what_was_not_understood_may_be_corrected_under_the_same_key(service: Service, client: TestClient) -> None:
    assert post(client, RETUNE, {"Ms": 9}).status_code == 422
    assert post(client, "/loops/NONE/retune").status_code == 404
    assert post(client, RETUNE, {"Ms": 1.4, "by": "me"}).status_code == 202


def test_what_failed_is_tried_anew(service: Service, client: TestClient) -> None:
    job = proposed(service)
    service.controller.absent = Reason.NODE_LOST
    assert post(client, f"/jobs/{job}/accept").status_code == 503
    service.controller.absent = None
    assert post(client, f"/jobs/{job}/accept").status_code == 200
    service.controller.absent = Reason.NODE_LOST
    assert post(client, f"/jobs/{job}/accept").status_code == 200


def test_who_was_told_no_does_not_find_that_it_began_later(service: Service, client: TestClient) -> None:
    """A repetition that was delayed on the way comes when the loop is free."""
    job = running(service)
    first = post(client, RETUNE)
    assert_problem(first, 409)
    service.tune.hold.set()
    service.wait(job)
    again = post(client, RETUNE)
    assert same(first, again) and again.headers["location"] == f"/jobs/{job}"
    assert len(service.store.recent()) == 1


def test_a_defect_is_no_answer_to_keep(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(service.jobs, "start", lambda *_: 1 / 0)
        assert post(client, RETUNE).status_code == 500
    assert post(client, RETUNE).status_code == 202


def test_an_error_after_the_job_was_made_does_not_make_another(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(service.store, "events_by_job", away)
        assert_problem(post(client, RETUNE), 503)
    (job,) = service.store.recent()
    service.wait(job.id)
    again = post(client, RETUNE)
    assert (again.status_code, again.headers["location"]) == (202, f"/jobs/{job.id}")
    assert len(service.store.recent()) == 1


def test_a_body_that_is_too_long_is_refused_with_a_key_too(service: Service) -> None:
    limits = RequestLimits(body_bytes=1000)
    client = TestClient(app_of(service.jobs, Policy(None, limits), {}), raise_server_exceptions=False)
    for content in (b" " * 2000, iter([b" " * 600, b" " * 600])):
        assert_problem(client.post(RETUNE, content=content, headers=KEY), 413)


def test_a_database_that_is_away(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(IdempotencyKeys, "_claim", away)
        answer = post(client, RETUNE)
        assert_problem(answer, 503)
        assert answer.headers["retry-after"] and service.store.recent() == []
    with monkeypatch.context() as patch:  # the job is made, and its asker is told so
        patch.setattr(IdempotencyKeys, "keep", away)
        first = post(client, RETUNE)
        assert first.status_code == 202
    service.wait(first.json()["id"])
    assert post(client, RETUNE).headers["location"] == first.headers["location"]
    assert len(service.store.recent()) == 1


def test_a_long_answer_is_computed_again(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loopwright.service.store.idempotency.MAX_BYTES", 10)
    first, again = post(client, "/tunings", MODEL), post(client, "/tunings", MODEL)
    assert first.status_code == again.status_code == 200 and first.json() == again.json()
    assert post(client, "/tunings", MODEL | {"method": "amigo"}).status_code == 200  # nothing is kept


# cut off: what a service leaves that is killed


def killed(*_: Any) -> None:
    """Stands for the end of the process: nobody is answered, and nothing is written any more."""
    raise RuntimeError("killed")


def next_start(service: Service) -> TestClient:
    return TestClient(app_of(service.jobs, checks={}), raise_server_exceptions=False)


MADE: dict[Asked, int] = {
    a_retune: 202, a_dry_run: 202, a_retune_of_many: 202, an_acceptance: 200, a_rollback: 200, an_abort: 202,
    an_abort_of_many: 202,
}  # fmt: skip


@pytest.mark.parametrize("asked", MADE)
def test_killed_between_the_effect_and_the_kept_answer(
    service: Service, client: TestClient, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, body = asked(service, client)
    with monkeypatch.context() as patch:
        patch.setattr(IdempotencyKeys, "keep", killed)
        patch.setattr(IdempotencyKeys, "let_go", killed)
        assert post(client, path, body).status_code == 500
    service.tune.hold.set()
    was = done(service)
    again = next_start(service)
    first = post(again, path, body)
    assert first.status_code == MADE[asked], first.text
    assert ("location" in first.headers) == (MADE[asked] == 202 and not path.endswith("/abort"))
    assert path.startswith(first.json()["url"]) or first.headers["location"] == first.json()["url"]
    assert same(first, post(again, path, body))
    if asked is not a_retune_of_many:  # whose thread goes on making jobs
        assert done(service) == was
    assert len(client.get("/batches").json()) == (1 if "batches" in path else 0)


def test_killed_before_the_effect(service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(service.jobs, "start", killed)
        patch.setattr(IdempotencyKeys, "let_go", killed)
        assert post(client, RETUNE).status_code == 500
    assert post(next_start(service), RETUNE).status_code == 202
    assert len(service.store.recent()) == 1


def test_answers_outlive_the_service(tmp_path: Path) -> None:
    answers = []
    for _ in range(2):
        service = Service(tmp_path)
        with TestClient(app_of(service.jobs)) as client:
            answers.append(post(client, RETUNE))
            service.wait(answers[0].json()["id"])
        service.close()
    assert same(*answers)


# the keys in the store


@pytest.fixture
def keys(store: Store) -> IdempotencyKeys:
    return IdempotencyKeys(store, maximum=3)


def claim(keys: IdempotencyKeys, key: str, print_: str = "f", at: datetime = AT, who: str = "me") -> Claim:
    found = keys.claim(who, key, print_, at)
    assert isinstance(found, Claim)
    return found


def test_kept_for_a_day(keys: IdempotencyKeys) -> None:
    keys.keep(claim(keys, "a"), YES)
    assert keys.claim("me", "a", "f", AT + timedelta(hours=23, minutes=59)) == YES
    with pytest.raises(OtherRequest):
        keys.claim("me", "a", "g", AT + timedelta(hours=23, minutes=59))
    claim(keys, "a", "g", AT + timedelta(hours=24, minutes=1))


def test_a_clock_that_jumps_ahead_forgets_no_key(store: Store) -> None:
    wall, passed_s = AT, 0.0
    keys = IdempotencyKeys(store, ages=Ages(store, STEP, ClockWatch(lambda: wall, lambda: passed_s)))
    keys.keep(claim(keys, "a"), YES)
    wall += timedelta(days=2)
    assert keys.claim("me", "a", "f", wall) == YES
    wall, passed_s = wall + timedelta(hours=23), 23 * 3600.0
    assert keys.claim("me", "a", "f", wall) == YES
    wall, passed_s = wall + timedelta(hours=2), 25 * 3600.0  # a day that the service itself has seen
    claim(keys, "a", "g", wall)


@pytest.mark.parametrize("days", [0.8, 2.0, 400.0])
def test_a_clock_that_jumped_while_the_service_was_stopped_forgets_no_key(days: float, store: Store) -> None:
    before = AT - timedelta(hours=12)
    keys = IdempotencyKeys(store)
    keys.keep(claim(keys, "a", at=before), YES)
    keep_seen(store, Seen(AT), None)
    wall = AT + timedelta(days=days)
    again = IdempotencyKeys(store, ages=Ages(store, STEP, ClockWatch(lambda: wall, lambda: 0.0)))
    assert again.claim("me", "a", "f", wall) == YES


def test_what_is_being_answered_is_not_forgotten_for_its_age(keys: IdempotencyKeys) -> None:
    first = claim(keys, "a")
    with pytest.raises(StillAnswering):
        keys.claim("me", "a", "f", AT + timedelta(hours=25))
    keys.keep(first, YES)


def test_the_oldest_of_too_many_are_forgotten_of_each_principal_apart(keys: IdempotencyKeys) -> None:
    keys.keep(claim(keys, "other", who="you"), YES)
    for n in range(5):
        keys.keep(claim(keys, str(n), at=AT + timedelta(seconds=n)), YES)
    late = AT + timedelta(seconds=9)
    assert keys.claim("me", "4", "f", late) == keys.claim("you", "other", "f", late) == YES
    assert [isinstance(keys.claim("me", n, "f", late + timedelta(seconds=int(n))), Claim) for n in "01"] == [True] * 2


def test_what_is_being_answered_is_not_forgotten_for_want_of_room(keys: IdempotencyKeys) -> None:
    first = claim(keys, "first")
    for n in range(6):
        keys.keep(claim(keys, str(n), at=AT + timedelta(seconds=n)), YES)
    with pytest.raises(StillAnswering):
        keys.claim("me", "first", "f", AT + timedelta(seconds=9))
    keys.keep(first, YES)


def test_a_long_answer_is_not_kept(keys: IdempotencyKeys) -> None:
    import random

    long = random.Random(1).randbytes(2 * MAX_BYTES)
    keys.keep(claim(keys, "a"), Answer(200, {}, long))
    claim(keys, "a", "g")


# several gateways


@pytest.fixture
def two(tmp_path: Path, postgres: Server) -> Iterator[tuple[Store, Store]]:
    url = postgres.database()
    one, other = (Store(tmp_path / name, url, name) for name in ("gw-1", "gw-2"))
    yield one, other
    one.close()
    other.close()


def test_gateways_share_keys(two: tuple[Store, Store]) -> None:
    here, there = (IdempotencyKeys(store) for store in two)
    held = claim(here, "a")
    with pytest.raises(StillAnswering):
        there.claim("me", "a", "f", AT)
    here.keep(held, YES)
    assert there.claim("me", "a", "f", AT) == YES
    with pytest.raises(OtherRequest):
        there.claim("me", "a", "g", AT)


def test_another_gateway_takes_over_from_one_that_is_gone(two: tuple[Store, Store]) -> None:
    here, there = (IdempotencyKeys(store) for store in two)
    claim(here, "nothing done")
    half = claim(here, "job made")
    token = idempotency_effects.current.set(half)
    job = two[0].create("L", {}, "me", False).id
    idempotency_effects.current.reset(token)
    assert claim(there, "job made").effect == f"/jobs/{job}"  # also while it lives: what it was to do is done
    two[0].close()  # the server lets go of what the gateway held a moment later
    found: list[Claim] = []

    def taken_over() -> bool:
        try:
            found.append(claim(there, "nothing done"))
        except StillAnswering:
            return False
        return True

    until(taken_over)
    assert found[0].effect is None


def test_who_was_taken_over_from_makes_no_second_job(two: tuple[Store, Store], monkeypatch: pytest.MonkeyPatch) -> None:
    """A gateway whose lock was lost for a moment is taken for gone while it is still answering."""
    here, there = (IdempotencyKeys(store) for store in two)
    first = claim(here, "a")
    monkeypatch.setattr("loopwright.service.store.lock.HostLock.free", lambda *_: True)
    second = claim(there, "a")
    for store, held, jobs in ((two[0], first, 0), (two[1], second, 1)):
        token = idempotency_effects.current.set(held)
        try:
            store.create("L", {}, "me", False)
        except StillAnswering:
            assert held is first
        idempotency_effects.current.reset(token)
        assert len(two[0].recent()) == jobs
    here.keep(first, Answer(500, {}, b""))
    there.keep(second, YES)
    assert here.claim("me", "a", "f", AT) == YES


def test_the_service_has_new_gains_once(service: Service, client: TestClient) -> None:
    """Accepted and rolled back: the acceptance repeated late is its answer, and does not bring the gains back."""
    job = proposed(service)
    first = post(client, f"/jobs/{job}/accept")
    assert service.controller.state.gains == NEW
    assert client.post(f"/jobs/{job}/rollback").status_code == 200
    old = service.controller.state.gains
    assert same(first, post(client, f"/jobs/{job}/accept")) and service.controller.state.gains == old != NEW


def test_jobs_of_the_fleet_are_not_of_the_request(service: Service, client: TestClient) -> None:
    """The jobs that a retune of many begins later note nothing beside its key."""
    first = post(client, "/batches", {"by": "me", "pattern": "*"})
    assert isinstance(service.jobs, Jobs) and first.headers["location"].startswith("/batches/")
    for _ in range(2000):
        if client.get(first.headers["location"]).json()["ended_at"]:
            break
    again = post(client, "/batches", {"by": "me", "pattern": "*"})
    assert len(service.store.recent()) == 2 and same(first, again)
