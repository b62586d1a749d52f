from __future__ import annotations

import os
import threading
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import Mock

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError, StatementError

from loopwright.service.states.job_state import MOVES, IllegalMove, JobState
from loopwright.service.store import database as opening
from loopwright.service.store import lock
from loopwright.service.store.database import USUAL, BadDatabase, urgent
from loopwright.service.store.job_rows import NoSuchJob
from loopwright.service.store.jobs import UnknownWord
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Busy, ForeignLoop, Store
from loopwright.service.store.tables import Base
from loopwright.tuning.plan import Sample
from loopwright.tuning.reasons import Reason
from tests.unit.service.fakes import add_samples
from tests.unit.service.postgres import Server


def test_migrations_make_the_tables_of_the_code(store: Store) -> None:
    with store.engine.connect() as connection:
        differences = compare_metadata(MigrationContext.configure(connection), Base.metadata)
    assert differences == []


def test_a_present_database_is_opened_without_migrations(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    config = Config()
    config.set_main_option("script_location", "loopwright.service.store:migrations")
    head = ScriptDirectory.from_config(config).get_current_head()
    assert opening.revision(store.engine) == opening.present_revision() == head
    monkeypatch.setattr(command, "upgrade", Mock(side_effect=AssertionError("migrated again")))
    opening.migrate(store.engine)


@pytest.mark.parametrize(
    ("revision", "said"), [("0018", "from before 0.1.0.*start with a new data folder"), ("9999", "a newer version")]
)
def test_tables_of_another_time_are_refused_and_left_as_they_were(tmp_path: Path, revision: str, said: str) -> None:
    store = Store(tmp_path)
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :it"), {"it": revision})
    store.close()
    before = (tmp_path / opening.FILE).read_bytes()
    with pytest.raises(BadDatabase, match=said):
        Store(tmp_path)
    assert (tmp_path / opening.FILE).read_bytes() == before


def test_a_word_that_is_not_known_names_its_job(store: Store) -> None:
    """One that a later version wrote, say: the other jobs can be read as ever."""
    good, bad = (store.create(loop, {}, "me", False) for loop in "AB")
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE jobs SET reason = 'full_moon' WHERE id = :id"), {"id": bad.id})
    with pytest.raises(UnknownWord, match=f"job {bad.id} holds 'full_moon', which is no Reason"):
        store.get(bad.id)
    assert store.get(good.id) == good
    with pytest.raises(StatementError, match="full_moon"):
        store.note(good.id, reason="full_moon")


def test_one_active_job_per_loop_holds_in_the_database_itself(store: Store) -> None:
    store.create("A", {}, "me", False)
    copy = (
        "INSERT INTO jobs (id, loop, state, dry_run, request, by, created_at, plant_time_s)"
        " SELECT 'x', loop, 'running', dry_run, request, by, created_at, 0 FROM jobs"
    )
    with store.engine.connect() as connection, pytest.raises(IntegrityError):
        connection.execute(text(copy))


def test_a_power_cut_loses_nothing_that_was_committed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.engine.connect() as connection:
        found = [connection.execute(text(f"PRAGMA {name}")).scalar() for name in ("journal_mode", "synchronous")]
        assert [*found, connection.execute(text("PRAGMA busy_timeout")).scalar()] == ["wal", 2, 5000]
    store.close()


def test_one_active_job_per_loop(store: Store) -> None:
    first = store.create("A", {}, "me", False)
    with pytest.raises(Busy) as caught:
        store.create("A", {}, "you", False)
    assert caught.value.job_id == first.id
    store.create("A", {}, "you", True)
    store.create("B", {}, "you", False)
    store.move(first.id, JobState.RUNNING)
    with pytest.raises(Busy):
        store.create("A", {}, "you", False)
    store.move(first.id, JobState.PROPOSED)
    store.create("A", {}, "you", False)
    assert [row.loop for row in store.recent()] == ["A", "B", "A", "A"]


def test_what_was_written_is_there_after_reopening(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job = store.create("A", {"sp_deviation": float("nan")}, "me", False)
    store.move(job.id, JobState.RUNNING)
    store.close()
    store = Store(tmp_path)
    row = store.get(job.id)
    assert row.state == "running" and row.request == {"sp_deviation": None} and row.started_at
    assert [event.seq for event in store.events(job.id)] == [1, 2]
    assert [event.kind for event in store.events(job.id, after=1)] == ["state"]
    store.close()


def test_a_data_folder_has_one_service(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with pytest.raises(FolderInUse, match=f"process {os.getpid()} on"):
        Store(tmp_path)
    store.close()
    Store(tmp_path).close()


def test_a_data_folder_has_one_host_whatever_it_is_called(tmp_path: Path) -> None:
    store = Store(tmp_path)
    job = store.create("A", {}, "me", False)
    store.close()
    store = Store(tmp_path, host="renamed")
    assert [row.id for row in store.unfinished()] == [job.id]
    store.close()


def test_a_database_has_one_service_per_host_name(tmp_path: Path, postgres: Server) -> None:
    database = postgres.database()
    a, b = Store(tmp_path / "a", database, "a"), Store(tmp_path / "b", database, "b")
    with pytest.raises(FolderInUse, match=f"host 'a' is served already: loopwright a, process {os.getpid()} on"):
        Store(tmp_path / "c", database, "a")
    a.close()
    taken = Store(tmp_path / "c", database, "a")
    b.check_lock()
    for store in (taken, b):
        store.close()


def test_a_connection_that_comes_back_after_the_end_is_closed(tmp_path: Path, postgres: Server) -> None:
    """A thread of the engine may outlast it."""
    store = Store(tmp_path, postgres.database())
    connection = store.engine.connect()
    held = connection.connection.driver_connection
    store.close()
    connection.close()
    assert held is not None and held.closed


def test_a_lock_lost_with_the_server_is_taken_again_unless_another_was_faster(
    tmp_path: Path, postgres: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "PATIENCE_S", 0.5)
    database = postgres.database()
    a = Store(tmp_path / "a", database, "a")
    postgres.stop()
    a.check_lock()  # a server that is away is no reason to end
    postgres.start()
    a.check_lock()
    with pytest.raises(FolderInUse):
        Store(tmp_path / "b", database, "a")
    postgres.stop()
    postgres.start()
    other = Store(tmp_path / "b", database, "a")
    with pytest.raises(FolderInUse, match=f"process {os.getpid()} on .* has taken the name 'a'"):
        a.check_lock()
    other.close()
    with pytest.raises(FolderInUse):  # given back, and not to the one that was away
        a.check_lock()
    a.close()


def test_who_has_a_name_has_time_to_come_for_it_after_the_server_was_restarted(
    tmp_path: Path, postgres: Server
) -> None:
    """The second one starts before the first has noticed anything, and finds no lock."""
    database = postgres.database()
    a = Store(tmp_path / "a", database, "a")
    postgres.stop()
    postgres.start()
    found: list[object] = []

    def second() -> None:
        try:
            found.append(Store(tmp_path / "b", database, "a"))
        except FolderInUse as error:
            found.append(error)

    starts = threading.Thread(target=second)
    starts.start()
    with a.reading() as session:  # it has looked, and waits
        while not session.scalar(text("SELECT count(*) FROM pg_stat_activity WHERE query LIKE 'SELECT claim%'")):
            session.rollback()
    a.check_lock()
    starts.join()
    assert len(found) == 1 and isinstance(found[0], FolderInUse) and "served already" in str(found[0])
    a.move(a.create("A", {}, "me", False).id, JobState.RUNNING)
    a.close()


def test_nobody_waits_for_the_dead_nor_for_who_has_left(
    tmp_path: Path, postgres: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "PATIENCE_S", 1e9)
    database = postgres.database()
    Store(tmp_path / "a", database, "a").close()
    killed = Store(tmp_path / "b", database, "a")
    assert killed.host_lock is not None
    killed.host_lock.drop()
    killed.engine.dispose()
    killed.folder_lock.close()
    Store(tmp_path / "b", database, "a").close()  # the same folder: its lock says that the one before is dead


def test_who_has_lost_its_name_writes_nothing_more(
    tmp_path: Path, postgres: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was paused, say, and has not looked yet."""
    monkeypatch.setattr(lock, "PATIENCE_S", 0.1)
    database = postgres.database()
    a = Store(tmp_path / "a", database, "a")
    job = a.create("A", {}, "me", False)
    postgres.stop()
    postgres.start()
    b = Store(tmp_path / "b", database, "a")
    b.move(job.id, JobState.RUNNING)
    with pytest.raises(FolderInUse):
        a.move(job.id, JobState.ABORTED)
    assert a.get(job.id).state == "running"
    for store in (a, b):
        store.close()


def test_the_loops_of_a_host_that_may_come_back_are_not_taken(tmp_path: Path, postgres: Server) -> None:
    database = postgres.database()
    a, b = Store(tmp_path / "a", database, "a"), Store(tmp_path / "b", database, "b")
    a.own_loops({"X": {"tag": "X"}})
    postgres.stop()
    postgres.start()
    comes = threading.Timer(0.5, a.check_lock)
    comes.start()
    with pytest.raises(ForeignLoop):
        b.own_loops({"X": {"tag": "X"}})
    comes.join()
    for store in (a, b):
        store.close()


def test_loops_belong_to_their_host(tmp_path: Path, postgres: Server) -> None:
    database = postgres.database()
    a, b = Store(tmp_path / "a", database, "a"), Store(tmp_path / "b", database, "b")
    a.own_loops({"A-1": {"tag": "A-1"}, "X": {"tag": "X"}})
    b.own_loops({"B-1": {"tag": "B-1"}})
    with pytest.raises(ForeignLoop, match="X of a"):
        b.own_loops({"B-1": {}, "X": {}})
    assert [row.tag for row in b.foreign_loops()] == ["A-1", "X"]
    a.own_loops({"A-1": {"tag": "A-1"}})  # a gives X up
    b.own_loops({"B-1": {}, "X": {}})
    assert [(row.tag, row.host) for row in a.foreign_loops()] == [("B-1", "b"), ("X", "b")]
    found = a.foreign_loop("X")
    assert found is not None and found.host == "b" and b.foreign_loop("X") is None
    job = b.create("X", {}, "me", False)
    b.close()
    a.own_loops({"A-1": {}, "X": {}})  # the bus has moved while b was not running: with the job that was on it
    assert a.foreign_loops()[0].tag == "B-1" and [row.id for row in a.unfinished()] == [job.id]
    b = Store(tmp_path / "b", database, "b")
    with pytest.raises(ForeignLoop):
        b.own_loops({"B-1": {}, "X": {}})
    for store in (a, b):
        store.close()


def test_two_hosts_may_append_to_one_job_at_the_same_time(tmp_path: Path, postgres: Server) -> None:
    database = postgres.database()
    stores = [Store(tmp_path / name, database, name) for name in ("a", "b")]
    job = stores[0].create("A", {}, "me", False)
    threads = [
        threading.Thread(target=lambda store=store: [store.append(job.id, "note", {}, 0.0) for _ in range(30)])
        for store in stores
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [event.seq for event in stores[0].events(job.id)] == list(range(1, 62))
    for store in stores:
        store.close()


@pytest.mark.parametrize("url", ["mysql://u:secret@h/d", "nonsense", "postgres://u:secret@h/d"])
def test_other_databases_are_refused_without_telling_the_password(tmp_path: Path, url: str) -> None:
    with pytest.raises(BadDatabase) as refused:
        Store(tmp_path, url)
    assert "secret" not in str(refused.value) and "postgresql://" in str(refused.value)
    Store(tmp_path).close()  # the folder is free again


def test_samples_come_back(store: Store) -> None:
    job = store.create("A", {}, "me", False)
    samples = [Sample(86400.0 + 0.02 * n, 50.0, 50.0 + 0.001 * n, 41.3, n % 4) for n in range(5000)]
    add_samples(store, job.id, "relay", samples[:4096])
    add_samples(store, job.id, "verify", samples[4096:])
    blocks = store.samples(job.id)
    assert [(stage, len(block)) for stage, block in blocks] == [("relay", 4096), ("verify", 904)]
    back = [sample for _, block in blocks for sample in block]
    for one, other in zip(back, samples, strict=True):
        assert one == pytest.approx(other, rel=1e-7)
    assert [stage for stage, _ in store.samples(job.id, "verify")] == ["verify"]


def test_unknown_job(store: Store) -> None:
    with pytest.raises(NoSuchJob):
        store.get("none")


@pytest.mark.parametrize("now", list(JobState))
def test_only_the_moves_of_the_table(store: Store, now: JobState) -> None:
    job = store.create("A", {}, "me", False)
    for wanted in JobState:
        with store.engine.begin() as connection:
            connection.execute(text("UPDATE jobs SET state = :now"), {"now": now.value})
        if wanted in MOVES[now]:
            assert store.move(job.id, wanted).state is wanted
        else:
            with pytest.raises(IllegalMove):
                store.move(job.id, wanted)


def test_nothing_leaves_an_end_and_every_state_can_be_reached() -> None:
    reachable = {JobState.QUEUED}.union(*MOVES.values())
    assert reachable == set(JobState)
    for end in ("rolled_back", "refused", "aborted", "failed", "interrupted"):
        assert not MOVES[JobState(end)]


def test_what_is_urgent_has_connections_of_its_own(store: Store) -> None:
    """Whatever has taken all the others, a job can be told to stop."""
    job = store.create("L", {}, "me", False)
    with ExitStack() as stack:
        while store.engine.pool.checkedout() < sum(USUAL):  # type: ignore[attr-defined]
            stack.enter_context(store.engine.connect())
        token = urgent.set(True)
        try:
            assert store.request_stop(job.id, Reason.OPERATOR, "me").stop_reason == "operator"
            assert store.get(job.id).stop_reason == "operator"
        finally:
            urgent.reset(token)
