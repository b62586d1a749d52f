"""A loop that somebody has locked: no test begins on it and no decision writes to it, whoever asks and wherever."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from rich.console import Console
from sqlalchemy.orm import Session
from typer.testing import CliRunner

from loopwright.service.api.gate.gate import Policy
from loopwright.service.cli import main as cli
from loopwright.service.cli import terminal
from loopwright.service.cli.client import Client
from loopwright.service.errors import Locked, UnknownLoop
from loopwright.service.inputs.config import parse_site
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.fleet import Fleet, fleet_request
from loopwright.service.jobs.manager import Jobs
from loopwright.service.security.keys import Scope
from loopwright.service.server.assembly import make_jobs
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import LoopState, state_json
from loopwright.service.store import audit, loop_locks
from loopwright.service.store.backup import back_up, restore
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.store import Busy, Store
from loopwright.tuning.reasons import Reason
from tests.unit.service.api.test_api import assert_problem
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import (
    NEW,
    OLD,
    TAG,
    FakeController,
    FakeLoop,
    FakeTune,
    Service,
    ThreadEngine,
    fake_rehearse,
    held_acceptances,
    loop_entry,
)
from tests.unit.service.jobs.test_decisions import begun, proposed
from tests.unit.service.jobs.test_fleet import Deaf, idle_jobs
from tests.unit.service.jobs.test_jobs_machine import HandEngine
from tests.unit.service.postgres import Server

WHY = "valve is being overhauled"


def locked(client: TestClient, reason: str = WHY, by: str = "night shift", tag: str = TAG) -> Any:
    return client.post(f"/loops/{tag}/lock", json={"reason": reason, "by": by})


def entries(service: Service) -> list[tuple[str, str, str | None]]:
    """Locks and unlocks in the audit log, the first one first."""
    found = audit.trail(service.store.engine, 100, loop=TAG)
    return [(row.what, row.subject, row.by) for row in reversed(found) if "lock" in row.what]


def test_locked_and_unlocked(service: Service, client: TestClient) -> None:
    first = locked(client)
    assert first.status_code == 200 and (first.json()["running_job"], first.json()["note"]) == (None, None)
    lock = first.json()["locked"]
    assert (lock["reason"], lock["by"]) == (WHY, "night shift") and lock["since"].endswith("Z")
    again = locked(client, by="somebody else")  # the same reason: it stays as it is
    assert again.status_code == 200 and again.json() == first.json()
    problem = assert_problem(locked(client, "painting", "day shift"), 409)
    assert problem["reason"] == "locked"
    for words in (TAG, "night shift", WHY, lock["since"]):
        assert words in problem["detail"]
    assert client.get(f"/loops/{TAG}").json()["locked"] == lock
    assert {loop["tag"]: loop["locked"] for loop in client.get("/loops").json()} == {TAG: lock, "FIC-2": None}
    answer = client.post(f"/loops/{TAG}/unlock", json={"by": "day shift"})
    assert answer.json() == {"loop": TAG, "was_locked": lock}
    assert client.post(f"/loops/{TAG}/unlock").json() == {"loop": TAG, "was_locked": None}
    assert client.get(f"/loops/{TAG}").json()["locked"] is None
    assert entries(service) == [("lock", TAG, "night shift"), ("unlock", TAG, "day shift")]


@pytest.mark.parametrize(
    "body", [{}, {"reason": ""}, {"reason": "  "}, {"reason": "a\nb"}, {"reason": "x" * 201}, {"reason": "\x00"},
             {"reason": "x", "why": "y"}, {"reason": "x", "by": "y" * 101},
             {"reason": "x", "by": "a\nb"}]
)  # fmt: skip
def test_a_lock_says_why(client: TestClient, body: dict[str, Any]) -> None:
    answer = client.post(f"/loops/{TAG}/lock", json=body)
    assert_problem(answer, 422)


def test_a_loop_that_is_not_there(service: Service, client: TestClient) -> None:
    assert_problem(locked(client, tag="NONE"), 404)
    assert_problem(client.post("/loops/NONE/unlock"), 404)
    with pytest.raises(UnknownLoop):
        service.jobs.locking.lock("NONE", WHY, "me")


def test_no_test_begins_but_a_rehearsal_may(service: Service, client: TestClient) -> None:
    locked(client)
    problem = assert_problem(client.post(f"/loops/{TAG}/retune", json={"by": "me"}), 409)
    assert problem["reason"] == "locked" and "loopwright unlock" in problem["advice"] and WHY in problem["detail"]
    assert service.store.recent() == []
    assert client.post("/loops/FIC-2/retune", json={"by": "me"}).status_code == 202
    job = client.post(f"/loops/{TAG}/retune", json={"dry_run": True})
    assert job.status_code == 202
    service.wait(job.json()["id"])
    assert service.store.get(job.json()["id"]).state == "rehearsed"
    client.post(f"/loops/{TAG}/unlock")
    assert client.post(f"/loops/{TAG}/retune", json={"by": "me"}).status_code == 202


def test_no_decision_writes_to_it(service: Service, client: TestClient) -> None:
    job = proposed(service)
    locked(client)
    assert assert_problem(client.post(f"/jobs/{job}/accept"), 409)["reason"] == "locked"
    assert service.controller.state.gains == OLD and begun(service, job) == []
    client.post(f"/loops/{TAG}/unlock")
    assert client.post(f"/jobs/{job}/accept").status_code == 200
    locked(client)
    assert assert_problem(client.post(f"/jobs/{job}/rollback"), 409)["reason"] == "locked"
    assert service.controller.state.gains == NEW and begun(service, job) == ["accept"]
    assert not [row for row in audit.trail(service.store.engine, 100) if row.what.endswith("_failed")]


def test_a_proposal_may_be_declined_which_writes_nothing(service: Service, client: TestClient) -> None:
    job = proposed(service)
    locked(client)
    service.controller.absent = Reason.NODE_LOST
    assert client.post(f"/jobs/{job}/rollback").json()["state"] == "rolled_back"


def test_a_lock_that_comes_as_a_decision_reads_the_loop(
    service: Service, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The decision had looked before: it asks again in the transaction in which it begins to write."""
    job = proposed(service)
    read = FakeLoop.read

    def slow(loop: FakeLoop, beside_tests: bool = False) -> LoopState:
        service.jobs.locking.lock(TAG, WHY, "me")
        return read(loop)

    with monkeypatch.context() as patch:
        patch.setattr(FakeLoop, "read", slow)
        assert assert_problem(client.post(f"/jobs/{job}/accept"), 409)["reason"] == "locked"
    assert service.controller.state.gains == OLD and begun(service, job) == []
    assert not [row for row in audit.trail(service.store.engine, 100) if row.what.endswith("_failed")]


def test_a_lock_waits_for_a_decision_that_writes(service: Service) -> None:
    """When it is answered, nothing writes any more."""
    job = proposed(service)
    with held_acceptances() as (inside, free), ThreadPoolExecutor(2) as pool:
        decision = pool.submit(service.jobs.decisions.accept, job, "me")
        assert inside.wait(10)
        lock = pool.submit(service.jobs.locking.lock, TAG, WHY, "me")
        while not service.jobs.locking.locks():
            assert not lock.done()
        free.set()
        assert decision.result(10).state == "accepted" and lock.result(10)[1] is None
    assert service.controller.state.gains == NEW


def test_a_running_test_goes_on_and_the_answer_says_how_to_end_it(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job = client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()["id"]
    assert service.tune.inside.wait(10)
    answer = locked(client).json()
    assert answer["running_job"] == f"/jobs/{job}" and f"loopwright job {job} --abort" in answer["note"]
    service.tune.hold.set()
    service.wait(job)
    assert service.store.get(job).state == "proposed" and service.controller.state.gains == OLD


def test_a_running_test_may_be_aborted_and_the_loop_is_made_safe(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    job = client.post(f"/loops/{TAG}/retune", json={"by": "me"}).json()["id"]
    assert service.tune.inside.wait(10)
    locked(client)
    assert client.post(f"/jobs/{job}/abort").status_code == 202
    service.wait(job)
    assert service.store.get(job).state == "aborted"
    assert service.controller.state.gains == OLD and not service.controller.state.on_trial


def test_a_job_that_waited_is_refused_at_its_turn(tmp_path: Path) -> None:
    engine = HandEngine()
    service = Service(tmp_path, engine=engine)
    job = service.jobs.start(TAG, FastRetune()).id
    assert service.jobs.locking.lock(TAG, WHY, "me")[1] is None  # nothing runs
    engine.begin(job)
    service.wait(job)
    row = service.store.get(job)
    assert (
        (row.state, row.reason) == ("refused", "locked") and WHY in (row.detail or "") and not row.restore_unconfirmed
    )
    assert not service.tune.inside.is_set() and service.controller.session_last == 0
    service.close()


def test_killed_during_its_test_a_locked_loop_is_made_safe_and_not_tested_again(tmp_path: Path) -> None:
    """Safety first: the session is closed all the same, and a loop that is not reached is monitored until it is."""
    first = Service(tmp_path, engine=Deaf())
    rows = {}
    for tag in first.loops:
        rows[tag] = first.jobs.start(tag, FastRetune()).id
    first.jobs.stop_watching()
    state = state_json(first.controller.state)
    for job in rows.values():
        first.store.move(job, JobState.RUNNING, attempt=1, found=state, previous_gains=state["gains"], session=7)
    first.jobs.locking.lock(TAG, WHY, "me")
    controller = first.controller
    controller.begin_session(7)
    controller.session_last = 7
    first.store.close()

    again = Service.__new__(Service)
    again.controller, again.tune, again.loops = controller, FakeTune(), first.loops
    again.store = Store(tmp_path)
    engine = HandEngine()
    again.jobs = again.more_jobs(lambda config: FakeLoop(controller), engine=engine)
    row = again.store.get(rows[TAG])
    assert (row.state, row.reason) == ("interrupted", "locked") and WHY in (row.detail or "")
    assert controller.session == 0 and row.restored is not None
    assert engine.queued == [rows["FIC-2"]]  # the other goes on
    again.close()


def test_a_locked_loop_is_looked_after(service: Service, client: TestClient) -> None:
    """What a job could not bring home is brought home, lock or not; and a person may answer for it."""
    job = service.jobs.start(TAG, FastRetune())
    service.wait(job.id)
    service.store.note(job.id, restore_unconfirmed=True)
    locked(client)
    service.jobs.aftercare.check_due_loops()
    assert not service.store.get(job.id).restore_unconfirmed
    service.store.note(job.id, restore_unconfirmed=True)
    assert client.post(f"/loops/{TAG}/acknowledge").json()["jobs"] == [f"/jobs/{job.id}"]


def test_a_retune_of_many_skips_it_and_says_so(service: Service, client: TestClient) -> None:
    locked(client)
    url = client.post("/batches", json={"by": "me", "pattern": "*", "stop_after_failures": 1}).json()["url"]
    for _ in range(5000):
        found = client.get(url).json()
        if found["ended_at"]:
            break
    parts = {part["loop"]: part for part in found["loops"]}
    assert (parts[TAG]["state"], parts[TAG]["reason"], parts[TAG]["job"]) == ("skipped", "locked", None)
    assert WHY in parts[TAG]["detail"] and "night shift" in parts[TAG]["detail"]
    assert found["state"] == "done" and found["failures"] == 0 and parts["FIC-2"]["state"] == "proposed"


def test_a_job_of_many_refused_at_its_turn_is_no_failure(tmp_path: Path) -> None:
    engine = HandEngine()
    service = Service(tmp_path, engine=engine)
    fleet = Fleet(service.jobs)
    retune = fleet.start(fleet_request(loops=[TAG], stop_after_failures=1)).id
    fleet.poll()
    service.jobs.locking.lock(TAG, WHY, "me")
    engine.begin(engine.queued[0])
    service.wait(service.store.recent()[0].id)
    fleet.poll()
    row, (part,) = fleet.get(retune)
    assert (row.state, part.reason, part.failed) == ("done", "locked", False)
    service.close()


def test_a_lock_outlives_the_service_and_a_back_up(tmp_path: Path) -> None:
    service = Service(tmp_path / "data")
    service.jobs.locking.lock(TAG, WHY, "me")
    service.close()
    back_up(tmp_path / "data", tmp_path / "b")
    restore(tmp_path / "b", tmp_path / "new")
    for folder in ("data", "new"):
        service = Service(tmp_path / folder)
        assert service.jobs.locking.locks()[TAG].reason == WHY
        with pytest.raises(Locked, match=WHY):
            service.jobs.start(TAG, FastRetune())
        service.close()


def test_from_another_gateway(tmp_path: Path, postgres: Server) -> None:
    """The lock of a loop is made at any gateway, and holds at its own."""
    database = postgres.database()
    stores = {name: Store(tmp_path / name, database, name) for name in ("a", "b")}
    engine = Deaf()
    here = idle_jobs(stores["a"], [loop_entry()], engine)
    there = idle_jobs(stores["b"], [loop_entry(tag="FIC-2")], Deaf())
    there.locking.lock(TAG, WHY, "gateway B")
    with pytest.raises(Locked, match="gateway B"):
        here.start(TAG, FastRetune())
    for jobs in (here, there):
        client = TestClient(app_of(jobs, checks={}))
        assert {x["tag"]: x["locked"] and x["locked"]["by"] for x in client.get("/loops").json()} == {
            TAG: "gateway B", "FIC-2": None,
        }  # fmt: skip
    assert here.locking.unlock(TAG, "gateway A") is not None and there.locking.locks() == {}
    for jobs in (here, there):
        jobs.stop()
    for store in stores.values():
        store.close()


@pytest.fixture(params=["sqlite", "postgresql"])
def racing(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[tuple[Jobs, FakeTune]]:
    database = None if request.param == "sqlite" else request.getfixturevalue("postgres").database()
    store, tune = Store(tmp_path, database), FakeTune()
    loops = parse_site({"loops": [loop_entry()]}, "test").loops
    controller = FakeController()
    jobs = make_jobs(loops, store, lambda config: FakeLoop(controller), tune, fake_rehearse, engine=ThreadEngine())
    jobs.boot()
    yield jobs, tune
    tune.hold.set()
    jobs.stop()
    store.close()


ROUNDS = 40


def test_locked_and_retuned_at_the_same_time(racing: tuple[Jobs, FakeTune]) -> None:
    """A test that the answer to the lock does not name never begins: its job is refused, or there is none."""
    jobs, tune = racing
    named = 0
    with ThreadPoolExecutor(2) as pool:
        for n in range(ROUNDS):
            tune.hold.clear()  # a test that begins stays there
            tune.inside.clear()
            together = threading.Barrier(2)

            def ask(together: threading.Barrier = together) -> str | None:
                together.wait(20)
                try:
                    return jobs.start(TAG, FastRetune()).id
                except Locked:
                    return None

            asked = pool.submit(ask)
            together.wait(20)
            if n == 0:
                assert tune.inside.wait(20)
            for _ in range(n % 8):  # later in each round, so that the lock comes at every point of the way
                jobs.locking.locks()
            _, running = jobs.locking.lock(TAG, WHY, "me")
            job = asked.result(20)
            if running is not None:
                assert running.id == job
                named += 1
                jobs.abort(running.id, "me")
            tune.hold.set()
            if job is not None:
                engine: Any = jobs.engine
                engine.join(20, job)
                row = jobs.store.get(job)
                if running is None:
                    assert (row.state, row.reason) == ("refused", "locked"), row.detail
            if running is None:
                assert not tune.inside.is_set(), "a test began after the lock was answered"
            jobs.locking.unlock(TAG, "me")
    assert named, "no test was running in any round, not even in the first"


def test_held_by_the_row_of_the_loop(tmp_path: Path, postgres: Server) -> None:
    """On a server a lock waits for who has just asked whether the loop is locked, and begins a test."""
    store = Store(tmp_path, postgres.database())
    store.own_loops({TAG: loop_entry()})
    asked, done = Session(store.engine), threading.Event()
    loop_locks.check(asked, TAG)

    def lock() -> None:
        with store.writing() as session:
            loop_locks.lock(session, TAG, WHY, "me")
        done.set()

    with ThreadPoolExecutor(1) as pool:
        waits = pool.submit(lock)
        assert not done.wait(0.3)
        asked.commit()
        asked.close()
        waits.result(20)
    store.close()


def test_a_busy_loop_that_is_locked_is_said_to_be_locked(service: Service, client: TestClient) -> None:
    service.tune.hold.clear()
    service.jobs.start(TAG, FastRetune())
    with pytest.raises(Busy):
        service.jobs.start(TAG, FastRetune())
    locked(client)
    with pytest.raises(Locked):
        service.jobs.start(TAG, FastRetune())


# the commands


@pytest.fixture
def run(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(Client, "post", lambda self, path, body: client.post(path, json=body).json())
    monkeypatch.setattr(Client, "get", lambda self, path: client.get(path).json())
    monkeypatch.setattr(Client, "pages", lambda self, path: client.get(path).json())

    def command(*arguments: str) -> str:
        ran = CliRunner().invoke(cli.app, list(arguments))
        assert ran.exit_code == 0, ran.output
        return ran.stdout

    return command


def test_the_commands(run: Any, service: Service) -> None:
    assert "is locked by night shift since" in run("lock", TAG, "--reason", WHY, "--by", "night shift")
    lock = json.loads(run("loop", TAG, "--json"))["locked"]
    assert (lock["reason"], lock["by"]) == (WHY, "night shift")
    assert f"by night shift: {WHY}" in run("loop", TAG)
    assert f"{TAG} is unlocked; it was locked by night shift: {WHY}" in run("unlock", TAG)
    assert f"{TAG} was not locked" in run("unlock", TAG)
    assert json.loads(run("lock", TAG, "--reason", WHY, "--json"))["locked"]["by"].startswith("cli:")
    assert entries(service)[1][2] == entries(service)[2][2] != "night shift"
    service.jobs.locking.unlock(TAG, "me")


def test_the_table_of_loops_shows_it(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run("lock", TAG, "--reason", "valve", "--by", "me")
    shown = io.StringIO()
    monkeypatch.setattr(terminal, "console", Console(width=200, file=shown))
    run("loops")
    run("loop", TAG)
    assert shown.getvalue().count("by me: valve") == 2 and "automatic" in shown.getvalue()


def test_who_may_only_look_may_not_lock(service: Service) -> None:
    keyring = Keyring(service.store.engine)
    client = TestClient(app_of(service.jobs, Policy(keyring), {}))
    for scope, status in ((Scope.READ, 403), (Scope.OPERATE, 200)):
        headers = {"Authorization": f"Bearer {keyring.create(scope.value, scope)[1]}"}
        for path, body in (("lock", {"reason": WHY}), ("unlock", {})):
            answer = client.post(f"/loops/{TAG}/{path}", json=body, headers=headers)
            assert answer.status_code == status, answer.text
    assert [row.key for row in audit.trail(service.store.engine, 2)] == ["operate", "operate"]
