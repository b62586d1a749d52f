"""Files that are damaged before the start or under the running service; disks that are full or can only be read."""

from __future__ import annotations

import logging
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from httpx import Response
from sqlalchemy import event, text
from typer.testing import CliRunner

from loopwright.service.api import operations
from loopwright.service.cli import main as cli
from loopwright.service.inputs.request import FastRetune
from loopwright.service.jobs.dbos_engine import DurableEngine
from loopwright.service.states.job_state import JobState
from loopwright.service.store.damage import FileCheck, Log, read_log
from loopwright.service.store.database import ENGINE_FILE, FILE, BadDatabase
from loopwright.service.store.journal_writes import event_of
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Sample
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import OLD, TAG, Service, add_samples
from tests.unit.service.processes import until


def overwrite(path: Path, at: int, length: int = 100) -> None:
    content = bytearray(path.read_bytes())
    content[at : at + length] = b"\xaa" * length
    path.write_bytes(content)


# the write-ahead log

PAGE = 4096
FRAME = 24 + PAGE


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a kill leaves it: forty transactions are in the log only."""
    folder, copy = tmp_path_factory.mktemp("live"), tmp_path_factory.mktemp("killed") / "data"
    with closing(sqlite3.connect(folder / FILE, isolation_level=None)) as live:
        live.execute("PRAGMA journal_mode=WAL")
        live.execute("CREATE TABLE t (x)")
        for _ in range(40):
            live.execute("INSERT INTO t VALUES (?)", ("y" * 3000,))
        shutil.copytree(folder, copy)
    return copy


def harmed(killed: Path, folder: Path, at: int) -> Path:
    shutil.copytree(killed, folder / "data")
    wal = folder / "data" / f"{FILE}-wal"
    overwrite(wal, at if at >= 0 else wal.stat().st_size + at)
    return folder / "data" / FILE


def test_a_log_that_is_whole(killed: Path) -> None:
    frames = ((killed / f"{FILE}-wal").stat().st_size - 32) // FRAME
    assert read_log(killed / FILE) == Log(frames)


@pytest.mark.parametrize("at", [32 + 24, 32 + 20 * FRAME, 32 + 20 * FRAME + 500, 32 + 20 * FRAME + 4, 0, 8])
def test_a_log_that_is_damaged_in_its_middle(killed: Path, tmp_path: Path, at: int) -> None:
    file = harmed(killed, tmp_path, at)
    before = (file.with_name(f"{FILE}-wal")).read_bytes()
    assert read_log(file).lost > 0
    assert file.with_name(f"{FILE}-wal").read_bytes() == before
    with closing(sqlite3.connect(file)) as connection:  # SQLite says nothing of it: that is why we look
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_a_last_write_that_was_interrupted(killed: Path, tmp_path: Path) -> None:
    file = harmed(killed, tmp_path, -500)
    found = read_log(file)
    assert found.lost == 0 and found.interrupted
    wal = file.with_name(f"{FILE}-wal")
    wal.write_bytes(wal.read_bytes()[:-1000])
    assert read_log(file) == found


def test_a_log_begun_anew_over_an_older_one(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as live:
        live.execute("PRAGMA journal_mode=WAL")
        live.execute("CREATE TABLE t (x)")
        for _ in range(20):
            live.execute("INSERT INTO t VALUES (?)", ("y" * 3000,))
        live.execute("PRAGMA wal_checkpoint(RESTART)")
        live.execute("INSERT INTO t VALUES (1)")
        assert read_log(tmp_path / FILE) == Log(1)
        live.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        assert read_log(tmp_path / FILE) == Log()


# at the start


def filled(folder: Path) -> list[str]:
    """Twenty jobs with samples."""
    store, ids = Store(folder), []
    for n in range(20):
        row = store.create(f"L{n}", {"text": "x" * 1000}, "me", False)
        add_samples(store, row.id, "relay", [Sample(0.1 * k, 50.0, 50.0, 40.0 + k, 2) for k in range(1000)])
        ids.append(row.id)
    store.close()
    return ids


def test_a_damaged_page_is_said_at_the_start(tmp_path: Path) -> None:
    filled(tmp_path)
    overwrite(tmp_path / FILE, 2 * PAGE, PAGE)
    before = (tmp_path / FILE).read_bytes()
    for _ in range(2):
        with pytest.raises(BadDatabase) as refused:
            Store(tmp_path)
        words = str(refused.value)
        assert str(tmp_path / FILE) in words and "loopwright check-data" in words and "loopwright restore" in words
    assert (tmp_path / FILE).read_bytes() == before


def test_a_job_that_a_damaged_log_would_lose_is_not_lost_silently(tmp_path: Path) -> None:
    store = Store(tmp_path / "live")
    for n in range(20):
        store.create(f"L{n}", {}, "me", False)
    shutil.copytree(tmp_path / "live", tmp_path / "killed")
    store.close()
    wal = tmp_path / "killed" / f"{FILE}-wal"
    overwrite(wal, wal.stat().st_size * 2 // 3)
    with pytest.raises(BadDatabase, match="later transactions would be lost"):
        Store(tmp_path / "killed")


def test_a_check_that_takes_long_goes_on_beside_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(tmp_path)
    # Where the start has nothing to read.
    overwrite(tmp_path / FILE, (pages_of(tmp_path, "sample_chunks")[1] - 1) * PAGE, PAGE)
    opened, check = threading.Event(), FileCheck.run

    def beside(self: FileCheck) -> None:
        opened.wait(60)
        check(self)

    monkeypatch.setattr(FileCheck, "run", beside)
    monkeypatch.setattr(FileCheck, "wait", lambda *_: False)
    store = Store(tmp_path)
    assert store.damaged is None
    opened.set()
    until(lambda: store.damaged is not None)
    assert store.damaged is not None and "check-data" in store.damaged
    store.close()


def test_damage_that_the_start_meets_is_said_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check is not through yet."""
    filled(tmp_path)
    overwrite(tmp_path / FILE, (pages_of(tmp_path, "jobs")[1] - 1) * PAGE, PAGE)
    monkeypatch.setattr("loopwright.service.store.damage.FileCheck.wait", lambda *_: False)
    with pytest.raises(BadDatabase, match="check-data"):
        Store(tmp_path)


def test_the_engines_file_is_made_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(2):
        engine = DurableEngine(tmp_path, None, "local", 0.02)
        engine.launch(lambda job_id: None, {"q": 1})
        engine.close()
        overwrite(tmp_path / ENGINE_FILE, PAGE, 4 * PAGE)
    (aside,) = tmp_path.glob("damaged-*")
    assert (aside / ENGINE_FILE).exists() and "is made anew" in caplog.text


def test_a_job_that_only_the_engine_knows_is_said(service: Service, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.ERROR)
    service.jobs.worker.work("0123456789ab")
    assert "job 0123456789ab was begun and is not in the database" in caplog.text


# in operation


@pytest.fixture
def client(service: Service) -> Iterator[TestClient]:
    with TestClient(app_of(service.jobs), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture(autouse=True)
def asked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operations, "FRESH_S", 0.0)


def database(client: TestClient) -> Any:
    answer = client.get("/readyz")
    part = answer.json()["parts"]["database"]
    assert answer.status_code == (200 if part["ready"] else 503), answer.text
    return part


def in_the_middle(service: Service) -> str:
    """A job whose loop is on trial gains."""
    service.tune.hold.clear()
    job_id = service.jobs.start(TAG, FastRetune()).id
    assert service.tune.inside.wait(20)
    until(lambda: service.controller.state.on_trial)
    return job_id


def test_damage_under_the_running_service(service: Service, client: TestClient) -> None:
    """No work is taken, the test ends with its loop at home, and every answer says why."""
    in_the_middle(service)
    service.jobs.journal.flush(20)
    with service.store.engine.connect() as connection:
        connection.execute(text("PRAGMA wal_checkpoint(TRUNCATE)"))
    file = service.store.folder / FILE
    with file.open("r+b") as opened:
        opened.seek(PAGE)
        opened.write(b"\xaa" * (file.stat().st_size - PAGE))
    service.store.engine.dispose()  # what a connection has read before, it does not read again
    answers = [client.get("/jobs"), client.post(f"/loops/{TAG}/retune", json={"by": "me"})]
    assert [answer.status_code for answer in answers] == [503, 503]
    for answer in answers:
        assert answer.headers["content-type"] == "application/problem+json" and "damaged" in answer.json()["detail"]
    answer = client.get("/readyz")
    part = answer.json()["parts"]["database"]
    assert answer.status_code == 503 and "loopwright check-data" in part["detail"]
    until(lambda: service.jobs.stopping and service.controller.session == 0)
    until(lambda: not service.jobs.under_test())
    assert service.controller.state.gains == OLD and not service.controller.state.on_trial
    refused = client.post("/loops/FIC-2/retune", json={"by": "me"})
    assert refused.status_code == 503 and "damaged" in refused.json()["detail"]


class Disk:
    """What every connection is told of the disk, those that are opened meanwhile for good."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.pragma = ""
        event.listen(store.engine, "connect", self._told)
        # A transaction asks a connection that is there already, too: as writes to a disk do.
        event.listen(store.engine, "checkout", self._told)

    def _told(self, connection: Any, *_: object) -> None:
        cursor = connection.cursor()
        for pragma in (self.pragma or "max_page_count=1073741823").split(";"):
            cursor.execute(f"PRAGMA {pragma}")
        cursor.close()


FULL = "max_page_count=1"  # less than there are: not one more
ONLY_READ = "query_only=ON"


@pytest.mark.parametrize(("pragma", "words"), [(FULL, "full"), (ONLY_READ, "readonly")])
def test_a_disk_that_takes_nothing_for_a_while(service: Service, client: TestClient, pragma: str, words: str) -> None:
    """What is read only stays so for the connections that were opened then: they are given up."""
    disk = Disk(service.store)
    job_id = in_the_middle(service)
    assert database(client)["ready"]
    disk.pragma = pragma
    service.jobs.journal.put(event_of(job_id, "note", {"text": "x" * 20_000}, 0.0))  # for which there is no page left
    service.tune.hold.set()
    until(lambda: service.controller.session == 0)  # the test runs to its end
    until(lambda: not (part := database(client))["ready"] and (words in part["detail"] or "nothing" in part["detail"]))
    if pragma == ONLY_READ:  # a small report may find room on a full disk
        refused = client.post("/loops/FIC-2/retune", json={"by": "me"})
        assert refused.status_code == 503 and refused.headers["retry-after"], refused.text
    assert service.store.get(job_id).state == "running"
    disk.pragma = ""
    service.wait(job_id)
    assert service.store.get(job_id).state == JobState.PROPOSED.value
    assert sum(len(block) for _, block in service.store.samples(job_id)) == 20
    until(lambda: database(client)["ready"])
    answers: list[Response] = []

    def accepted() -> bool:
        answers.append(client.post("/loops/FIC-2/retune", json={"by": "me"}))
        return answers[-1].status_code == 202

    until(accepted)
    # A connection of then that has only read since is given up by the first write on it, and with it all others.
    assert [(each.status_code, "retry-after" in each.headers) for each in answers[:-1]] in ([], [(503, True)])


# loopwright check-data


def run(*arguments: object) -> Any:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def test_data_that_are_whole(tmp_path: Path) -> None:
    filled(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    done = run("check-data", "--data", tmp_path)
    assert done.exit_code == 0 and "whole; readable rows: " in done.stdout and "jobs 20," in done.stdout
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "lock"}
    assert after == {name: content for name, content in before.items() if name != "lock"}
    store = Store(tmp_path)  # a service that runs is looked at, too
    assert run("check-data", "--data", tmp_path).exit_code == 0
    refused = run("check-data", "--data", tmp_path, "--salvage", tmp_path / "s")
    assert refused.exit_code == 2 and "stop it" in refused.stderr
    store.close()
    assert "not a data folder" in run("check-data", "--data", tmp_path / "nothing").stderr


def pages_of(folder: Path, table: str) -> list[int]:
    """The numbers of the pages that hold its rows."""
    with closing(sqlite3.connect(folder / FILE)) as connection:
        try:
            wanted = "SELECT pageno FROM dbstat WHERE name = ? AND pagetype IN ('leaf', 'overflow') ORDER BY path"
            return [row[0] for row in connection.execute(wanted, (table,))]
        except sqlite3.OperationalError:
            pytest.skip("this SQLite does not say where its tables are")


@pytest.mark.parametrize("table", ["events", "jobs", "sample_chunks"])
def test_what_can_be_read_of_a_damaged_file_is_copied_and_taken(tmp_path: Path, table: str) -> None:
    data = tmp_path / "data"
    ids = filled(data)
    pages = pages_of(data, table)
    overwrite(data / FILE, (pages[len(pages) // 2] - 1) * PAGE, PAGE)
    told = run("check-data", "--data", data)
    assert told.exit_code == 3 and "damaged" in told.stdout and "--salvage FILE" in told.stdout
    made = run("check-data", "--data", data, "--salvage", tmp_path / "s.sqlite")
    assert made.exit_code == 3 and "restore it with: loopwright restore" in made.stdout
    assert run("restore", tmp_path / "s.sqlite", "--data", data, "--replace").exit_code == 0
    store = Store(data)
    jobs = [row.id for row in store.recent()]
    assert set(jobs) <= set(ids) and (len(jobs) == 20 or (table == "jobs" and jobs))
    assert any(store.events(job_id) for job_id in jobs)
    store.create("NEW", {}, "me", False)
    store.close()


def test_what_a_damaged_log_still_has_is_copied(tmp_path: Path) -> None:
    store = Store(tmp_path / "live")
    for n in range(20):
        store.create(f"L{n}", {}, "me", False)
    shutil.copytree(tmp_path / "live", tmp_path / "killed")
    store.close()
    wal = tmp_path / "killed" / f"{FILE}-wal"
    overwrite(wal, wal.stat().st_size * 2 // 3)
    before = wal.read_bytes()
    told = run("check-data", "--data", tmp_path / "killed", "--salvage", tmp_path / "s")
    assert told.exit_code == 3 and "later transactions cannot be read" in told.stdout and wal.read_bytes() == before
    assert run("restore", tmp_path / "s", "--data", tmp_path / "killed", "--replace").exit_code == 0
    store = Store(tmp_path / "killed")
    assert 0 < len(store.recent()) < 20
    store.close()
