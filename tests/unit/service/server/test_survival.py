"""Services that are killed, doubled or cut off from their database: processes, with their loops in files."""

from __future__ import annotations

import os
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import create_engine, select
from sqlalchemy.orm import Session

from loopwright.service.cli.child_process import ChildProcess, NotReady
from loopwright.service.store.database import WAIT_S
from loopwright.service.store.tables import EventRow
from tests.forked import ForkedProcess
from tests.unit.service.fakes import NEW, OLD, TAG
from tests.unit.service.gateway import HOME, STAGES, read_loop
from tests.unit.service.postgres import Server
from tests.unit.service.processes import until

pytestmark = pytest.mark.timeout(600)  # processes that start slowly on a busy machine


class Gateway:
    """The process of tests.unit.service.gateway, started again as often as a test likes. first: options of the first
    start alone."""

    def __init__(
        self,
        stack: ExitStack,
        folder: Path,
        database: str | None = None,
        host: str = "local",
        tags: Sequence[str] = (TAG,),
        more: Sequence[str] = (),
        first: Sequence[str] = (),
    ) -> None:
        self.folder = folder
        self.database = f"sqlite:///{folder / 'data' / 'loopwright.sqlite'}"
        self._stack = stack
        self._arguments = [f"--host={host}", *(f"--tag={tag}" for tag in tags), *more]
        if database is not None:
            self._arguments.append(f"--database={database}")
            self.database = database.replace("postgresql:", "postgresql+psycopg:")
        folder.mkdir(parents=True, exist_ok=True)
        self.serve(*first)

    def launch(self, *more: str) -> ChildProcess:
        arguments = ("tests.unit.service.gateway", str(self.folder), *self._arguments, *more)
        process = ForkedProcess("gateway", arguments, self.folder / "gateway.log")
        self._stack.callback(process.stop)
        return process

    def serve(self, *more: str) -> None:
        self.process = self.launch(*more)
        url = self.process.wait_ready(180).split()[1]
        self.http = httpx.Client(base_url=url, timeout=60.0, trust_env=False)
        self._stack.callback(self.http.close)

    def go(self, stage: str = "") -> None:
        (self.folder / (f"go-{stage}" if stage else "go")).touch()

    def retune(self, tag: str = TAG, **options: Any) -> str:
        answer = self.http.post(f"/loops/{tag}/retune", json={"by": "me"} | options)
        assert answer.status_code == 202, answer.text
        return str(answer.headers["location"])

    def until(self, url: str, wanted: Callable[[dict[str, Any]], bool], timeout_s: float = 120.0) -> dict[str, Any]:
        deadline = time.monotonic() + timeout_s
        while True:
            answer = self.http.get(url)
            if answer.status_code == 200 and wanted(answer.json()):
                return dict(answer.json())
            assert time.monotonic() < deadline, answer.text
            time.sleep(0.1)  # each look takes the service some ms of processor time

    def in_stage(self, url: str, stage: str) -> dict[str, Any]:
        """Runs the job up to the middle of a stage: the loop is on trial, and the API says which stage it is."""
        for before in STAGES[: STAGES.index(stage)]:
            self.go(before)

        def there(job: dict[str, Any]) -> bool:
            return bool(job["stage"] == stage and job["attempts"] > 0 and read_loop(self.folder, TAG).on_trial)

        return self.until(url, there)

    def over(self, url: str, timeout_s: float = 120.0) -> dict[str, Any]:
        return self.until(url, lambda job: job["state"] not in ("queued", "running"), timeout_s)

    def ran(self, tag: str = TAG) -> list[str]:
        return (self.folder / f"{tag}.ran").read_text().split()

    def events(self, url: str, kind: str) -> list[dict[str, Any]]:
        """As the database has them, whoever serves."""
        engine = create_engine(self.database)
        with Session(engine) as session:
            mine = select(EventRow).where(EventRow.job_id == url.rsplit("/", 1)[1], EventRow.kind == kind)
            found = [event.data for event in session.scalars(mine.order_by(EventRow.seq))]
        engine.dispose()
        return found


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest) -> str | None:
    """Nothing for the file in the data folder, or the URL of a fresh database on the tests' server."""
    if request.param == "sqlite":
        return None
    server: Server = request.getfixturevalue("postgres")
    return server.database()


def test_killed_in_every_stage_it_resumes_there_and_nothing_runs_twice(
    stack: ExitStack, tmp_path: Path, database: str | None
) -> None:
    gateway = Gateway(stack, tmp_path, database)
    url = gateway.retune()
    for attempt, stage in enumerate(STAGES, 1):
        job = gateway.in_stage(url, stage)
        assert job["attempts"] == attempt
        gateway.process.kill()
        assert read_loop(tmp_path, TAG).gains == NEW  # this controller does not go back by itself
        gateway.serve()
        found = gateway.events(url, "loop_found")
        assert len(found) == attempt and "the session was closed" in found[-1]["text"]
    gateway.go()
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", len(STAGES) + 1)
    # Each stage was cut off once and run again once; none of those finished before ran again.
    assert gateway.ran() == [stage for stage in STAGES for _ in range(2)]
    assert read_loop(tmp_path, TAG) == HOME and job["restored"]["gains"]["Kp"] == OLD.Kp
    assert [stage["state"] for stage in job["stages"]] == ["done"] * len(STAGES)
    samples = gateway.http.get(f"{url}/samples").json()
    assert samples["t_s"] == sorted(samples["t_s"]) and set(samples["stage"]) == set(STAGES)


def test_a_second_service_on_the_same_data_is_told_who_has_it(
    stack: ExitStack, tmp_path: Path, database: str | None
) -> None:
    gateway = Gateway(stack, tmp_path / "one", database)
    url = gateway.retune()
    gateway.in_stage(url, STAGES[0])
    if database is None:
        second = gateway.launch()
    else:  # another data folder, the same name: only the database can tell
        other = tmp_path / "other"
        other.mkdir()
        arguments = ("tests.unit.service.gateway", str(other), f"--tag={TAG}", f"--database={database}")
        second = ForkedProcess("second", arguments, tmp_path / "second.log")
        stack.callback(second.stop)
    with pytest.raises(NotReady) as refused:
        second.wait_ready(180)
    assert f"process {gateway.process.pid} on" in str(refused.value)
    gateway.go()
    assert gateway.over(url)["state"] == "proposed" and gateway.ran() == list(STAGES)


def test_sigterm_makes_the_loop_safe_and_does_not_resume(stack: ExitStack, tmp_path: Path) -> None:
    gateway = Gateway(stack, tmp_path)
    url = gateway.retune()
    gateway.in_stage(url, "ultimate")
    gateway.process.stop()
    assert read_loop(tmp_path, TAG) == HOME
    gateway.serve()
    job = gateway.http.get(url).json()
    assert (job["state"], job["reason"], job["attempts"]) == ("aborted", "service_stopped", 1)


def test_the_engines_own_file_may_be_lost(stack: ExitStack, tmp_path: Path) -> None:
    gateway = Gateway(stack, tmp_path)
    url = gateway.retune()
    gateway.in_stage(url, "ultimate")
    gateway.process.kill()
    for file in (tmp_path / "data").glob("engine.sqlite*"):
        file.unlink()
    gateway.go()
    gateway.serve()
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", 2)


def test_a_locked_database_delays_nothing_but_the_answers(stack: ExitStack, tmp_path: Path) -> None:
    """Locked for longer than a request waits: 503 meanwhile, and the job is not disturbed."""
    gateway = Gateway(stack, tmp_path)
    url = gateway.retune()
    gateway.in_stage(url, "relay")
    with closing(sqlite3.connect(tmp_path / "data" / "loopwright.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        gateway.go()
        until(lambda: read_loop(tmp_path, TAG) == HOME)  # the job runs to its end while nothing can be written
        began = time.monotonic()
        answer = gateway.http.post(f"/loops/{TAG}/lock", json={"reason": "valve out"})
        assert (answer.status_code, answer.headers["retry-after"]) == (503, "5")
        # At most one wait for another writer of the process, and one for the file; the rest is for a busy machine.
        assert WAIT_S <= time.monotonic() - began < 2 * WAIT_S + 30
        # The job has not ended as far as anybody is told, and hears of an abort; its test is over.
        assert gateway.http.post(f"{url}/abort").status_code == 202
        other.execute("ROLLBACK")
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", 1)
    assert [stage["state"] for stage in job["stages"]] == ["done"] * len(STAGES)
    assert len(gateway.http.get(f"{url}/samples").json()["t_s"]) == 10 * len(STAGES)


def test_a_database_that_is_away_for_15_s(stack: ExitStack, tmp_path: Path, postgres: Server) -> None:
    gateway = Gateway(stack, tmp_path, postgres.database())
    url = gateway.retune()
    gateway.in_stage(url, "relay")
    postgres.stop()
    try:
        began = time.monotonic()
        assert [gateway.http.get(path).status_code for path in (url, "/jobs", "/loops")] == [503] * 3
        gateway.go("relay")
        while time.monotonic() - began < 15:
            time.sleep(0.1)
        until(lambda: gateway.ran() == ["relay", "ultimate"])  # the job goes on
    finally:
        postgres.start()
    gateway.go()
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", 1)
    assert len(gateway.http.get(f"{url}/samples").json()["t_s"]) == 10 * len(STAGES)


def test_a_second_gateway_as_the_server_comes_back_is_refused(
    stack: ExitStack, tmp_path: Path, postgres: Server
) -> None:
    """The lock is gone with the server, and the first one's job runs."""
    database = postgres.database()
    gateway = Gateway(stack, tmp_path / "one", database)
    url = gateway.retune()
    gateway.in_stage(url, "relay")
    postgres.stop()
    postgres.start()
    with pytest.raises(NotReady) as refused:
        another(stack, tmp_path, database).wait_ready(120)
    assert f"process {gateway.process.pid} on" in str(refused.value)
    gateway.go()
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", 1)


def test_a_gateway_that_comes_too_late_for_its_name_ends_its_tests(
    stack: ExitStack, tmp_path: Path, postgres: Server
) -> None:
    """It stood still, as a machine that swaps does, while the server was restarted and another took its name."""
    database = postgres.database()
    gateway = Gateway(stack, tmp_path / "one", database)
    url = gateway.retune()
    gateway.in_stage(url, "relay")
    os.kill(gateway.process.pid, signal.SIGSTOP)
    try:
        postgres.stop()
        postgres.start()
        other = another(stack, tmp_path, database)
        other.wait_ready(120)
    finally:
        os.kill(gateway.process.pid, signal.SIGCONT)
    deadline = time.monotonic() + 60
    while read_loop(tmp_path / "one", TAG) != HOME and time.monotonic() < deadline:
        time.sleep(0.02)
    assert read_loop(tmp_path / "one", TAG) == HOME
    answer = gateway.http.get("/readyz")
    assert answer.status_code == 503
    assert f"process {other.pid} on" in answer.json()["parts"]["engine"]["detail"]
    refused = gateway.http.post(f"/loops/{TAG}/retune", json={"by": "me"})
    assert refused.status_code == 503 and "has taken the name" in refused.json()["detail"]
    # It is the other one's now, and nobody has ended it.
    gateway.until(url, lambda job: job["state"] == "running" and job["attempts"] == 2)
    assert gateway.process.stop() == 0  # by itself, though the job goes on at the other one
    assert "Traceback" not in (tmp_path / "one" / "gateway.log").read_text()


def another(stack: ExitStack, folder: Path, database: str) -> ChildProcess:
    """A gateway of the same name with a data folder of its own."""
    (folder / "other").mkdir()
    arguments = ("tests.unit.service.gateway", str(folder / "other"), f"--tag={TAG}", f"--database={database}")
    process = ForkedProcess("another", arguments, folder / "another.log")
    stack.callback(process.stop)
    return process


def test_a_clock_set_back_an_hour(stack: ExitStack, tmp_path: Path) -> None:
    gateway = Gateway(stack, tmp_path, more=("--hours-back=1",))
    url = gateway.retune()
    gateway.in_stage(url, "relay")
    (tmp_path / "clock-is-back").touch()
    gateway.in_stage(url, "ultimate")
    gateway.process.kill()
    gateway.serve()
    gateway.go()
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", 2)
    assert job["ended_at"] < job["created_at"]  # so it really was
    again = gateway.over(gateway.retune())
    assert again["state"] == "proposed"
    assert [found["id"] for found in gateway.http.get("/jobs").json()] == [again["id"], job["id"]]


def test_two_gateways_on_one_database(stack: ExitStack, tmp_path: Path, postgres: Server) -> None:
    """Each runs the jobs of its own loops, and answers for all."""
    database = postgres.database()
    a = Gateway(stack, tmp_path / "a", database, "gw-a", ["A-1", "A-2"])
    b = Gateway(stack, tmp_path / "b", database, "gw-b", ["B-1"])
    for gateway in (a, b):
        hosts = {loop["tag"]: loop["gateway"] for loop in gateway.http.get("/loops").json()}
        assert hosts == {"A-1": "gw-a", "A-2": "gw-a", "B-1": "gw-b"}
    assert a.http.get("/loops/B-1").json()["live"] is None
    # Asked at the other one, run at home.
    on_a, on_b = b.retune("A-1"), a.retune("B-1")
    for gateway, url in ((a, on_b), (b, on_a)):
        gateway.until(url, lambda job: job["stage"] == "relay" and job["attempts"] == 1)
    assert a.ran("A-1") == ["relay"] and b.ran("B-1") == ["relay"]
    assert not (tmp_path / "a" / "B-1.ran").exists() and not (tmp_path / "b" / "A-1.ran").exists()
    assert b.http.post("/loops/A-1/retune", json={"by": "me"}).status_code == 409
    a.process.kill()
    b.go()
    assert b.over(on_b)["attempts"] == 1
    waiting = b.retune("A-2")  # for a host that is away
    assert [b.http.get(url).json()["state"] for url in (on_a, waiting)] == ["running", "queued"]
    assert read_loop(tmp_path / "a", "A-1").gains == NEW
    a.serve()
    assert read_loop(tmp_path / "a", "A-1") == HOME or a.http.get(on_a).json()["attempts"] == 2
    b.until(on_a, lambda job: job["attempts"] == 2)
    b.until(waiting, lambda job: job["stage"] == "relay")
    assert b.http.post(f"{waiting}/abort", json={"by": "at b"}).status_code == 202
    ended = b.over(waiting)
    assert (ended["state"], ended["reason"]) == ("aborted", "operator")
    a.go()
    assert b.over(on_a)["state"] == "proposed"
    assert read_loop(tmp_path / "a", "A-1") == read_loop(tmp_path / "a", "A-2") == HOME
    # Decided at the other one, written at home.
    assert b.http.post(f"{on_a}/accept").json()["state"] == "accepted"
    assert read_loop(tmp_path / "a", "A-1").gains == NEW
    assert b.http.post(f"{on_a}/rollback").json()["state"] == "rolled_back"
    assert read_loop(tmp_path / "a", "A-1") == HOME


def test_killed_as_it_carries_out_a_decision_of_another_gateway(
    stack: ExitStack, tmp_path: Path, postgres: Server
) -> None:
    """It has noted that it is about to write, and is gone: it does not write when it is back, until somebody asks."""
    database = postgres.database()
    dies = "--sigkill=after loopwright.service.store.store:Store.begin_decision"
    a = Gateway(stack, tmp_path / "a", database, "gw-a", ["A-1"], first=[dies])
    b = Gateway(stack, tmp_path / "b", database, "gw-b", ["B-1"])
    a.go()
    job = b.retune("A-1")
    assert b.over(job)["state"] == "proposed"
    answer = b.http.post(f"{job}/accept", json={"by": "at b"})
    assert answer.status_code == 202 and answer.json()["decision_request"]["state"] == "under_way", answer.text
    until(lambda: a.process.poll() is not None)
    a.serve()
    asked = b.until(job, lambda job: job["decision_request"]["state"] != "under_way")
    assert (asked["state"], asked["decision_request"]["state"]) == ("proposed", "cut_off")
    assert read_loop(tmp_path / "a", "A-1") == HOME and not (tmp_path / "a" / "A-1.accepted").exists()
    assert b.http.post(f"{job}/accept", json={"by": "at b"}).json()["state"] == "accepted"
    assert read_loop(tmp_path / "a", "A-1").gains == NEW
    assert len((tmp_path / "a" / "A-1.accepted").read_text().split()) == 1


def test_a_database_that_is_restarted_before_a_decision_is_carried_out(
    stack: ExitStack, tmp_path: Path, postgres: Server
) -> None:
    """The gateway that was asked, the one that has the loop and their rows go on by themselves."""
    database = postgres.database()
    a = Gateway(stack, tmp_path / "a", database, "gw-a", ["A-1"])
    b = Gateway(stack, tmp_path / "b", database, "gw-b", ["B-1"])
    a.go()
    job = b.retune("A-1")
    assert b.over(job)["state"] == "proposed"

    def seen() -> str:
        return str(next(each["last_seen"] for each in b.http.get("/gateways").json() if each["name"] == "gw-a"))

    before = seen()
    postgres.stop()
    try:
        answer = b.http.post(f"{job}/accept", json={"by": "at b"})
        assert answer.status_code == 503 and answer.headers["retry-after"], answer.text
    finally:
        postgres.start()
    b.until(job, lambda job: job["state"] == "proposed")
    until(lambda: seen() > before)
    assert read_loop(tmp_path / "a", "A-1") == HOME
    answer = b.http.post(f"{job}/accept", json={"by": "at b"})
    assert answer.status_code == 200, answer.text
    assert read_loop(tmp_path / "a", "A-1").gains == NEW
    assert len((tmp_path / "a" / "A-1.accepted").read_text().split()) == 1


@pytest.mark.parametrize(
    ("path", "body"),
    [(f"/loops/{TAG}/retune", {"Ms": 1.4, "by": "me"}),
     ("/batches", {"pattern": "*", "by": "me"})],
)  # fmt: skip
def test_killed_before_it_has_answered_a_repetition_with_the_key_begins_nothing_twice(
    stack: ExitStack, tmp_path: Path, database: str | None, path: str, body: dict[str, Any]
) -> None:
    cut = "before loopwright.service.store.idempotency:IdempotencyKeys.keep"
    gateway = Gateway(stack, tmp_path, database, first=[f"--sigkill={cut}"])
    key = {"Idempotency-Key": "once"}
    with pytest.raises(httpx.TransportError):
        gateway.http.post(path, json=body, headers=key)
    gateway.serve()
    first, again = (gateway.http.post(path, json=body, headers=key) for _ in range(2))
    assert first.status_code == 202 and first.headers["location"] == again.headers["location"], first.text
    assert first.json()["id"] == again.json()["id"]
    gateway.go()
    gateway.until(first.headers["location"], lambda found: found["ended_at"] is not None, 60)
    assert len(gateway.http.get("/jobs").json()) == 1
    assert len(gateway.http.get("/batches").json()) == (path == "/batches")
