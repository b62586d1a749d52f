from __future__ import annotations

import os
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from loopwright.service.cli import main as cli
from loopwright.service.inputs.request import FastRetune
from loopwright.service.security.keys import Scope
from loopwright.service.states.job_state import JobState
from loopwright.service.store.backup import BackupProblem, back_up, restore
from loopwright.service.store.keyring import Keyring
from loopwright.service.store.lock import FolderInUse
from loopwright.service.store.store import Store
from loopwright.tuning.plan import Sample
from tests.unit.service.fakes import TAG, Service, add_samples


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "data"


def filled(data: Path) -> tuple[str, str, str]:
    """A finished job, a queued one, and a key, in a folder whose service is gone."""
    service = Service(data)
    job = service.jobs.start(TAG, FastRetune())
    service.wait(job.id)
    _, key = Keyring(service.store.engine).create("a", Scope.READ)
    service.close()
    store = Store(data)
    active = store.create("OTHER", {}, "me", False)
    store.close()
    return job.id, active.id, key


def test_there_and_back(data: Path, tmp_path: Path) -> None:
    done, active, key = filled(data)
    size = back_up(data, tmp_path / "b")
    assert size == (tmp_path / "b").stat().st_size and (tmp_path / "b").stat().st_mode & 0o777 == 0o600
    interrupted, aside = restore(tmp_path / "b", tmp_path / "new")
    assert (interrupted, aside) == (1, None)
    store, old = Store(tmp_path / "new"), Store(data)
    assert store.get(done).result == old.get(done).result and store.samples(done) == old.samples(done) != []
    *events, doubted = store.events(done)
    assert events == list(old.events(done))
    assert (doubted.kind, doubted.data["decision"]) == ("decision_begun", "unknown")
    assert Keyring(store.engine).check(key) is not None
    row = store.get(active)
    assert (row.state, row.reason) == ("interrupted", "service_stopped") and "back-up" in (row.detail or "")
    assert store.unfinished() == [] and old.get(active).state == "queued"
    store.close()
    old.close()
    assert not [path for path in (tmp_path / "new").iterdir() if path.name.startswith(".")]


def test_a_back_up_of_a_service_that_writes_is_of_one_moment(data: Path, tmp_path: Path) -> None:
    store = Store(data)
    stop = threading.Event()
    written = 0
    once_more = threading.Event()

    def write() -> None:
        nonlocal written
        while not stop.is_set():
            row = store.create("L", {}, "me", False)
            add_samples(store, row.id, "relay", [Sample(0.1 * n, 1.0, 2.0, 3.0, 2) for n in range(500)])
            store.move(row.id, JobState.FAILED, reason="internal")
            written += 1
            once_more.set()

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for n in range(5):
            once_more.clear()
            assert once_more.wait(60)  # it writes between any two
            seen = written
            back_up(data, tmp_path / f"b{n}")
            with closing(sqlite3.connect(tmp_path / f"b{n}")) as copy:
                # A job is three transactions; whatever the moment, none is there by half.
                jobs, ended, blocks = copy.execute(
                    "SELECT count(*), count(ended_at), (SELECT count(*) FROM sample_chunks) FROM jobs"
                ).fetchone()
                assert ended <= blocks <= jobs <= ended + 1 and ended >= seen
    finally:
        stop.set()
        writer.join()
        store.close()


def test_restore_keeps_what_was_there(data: Path, tmp_path: Path) -> None:
    done, _, _ = filled(data)
    back_up(data, tmp_path / "b")
    (data / "engine.sqlite").write_bytes(b"another database")
    store = Store(data)
    later = store.create("L", {}, "me", False).id
    store.close()
    with pytest.raises(BackupProblem, match="--replace"):
        restore(tmp_path / "b", data)
    _, aside = restore(tmp_path / "b", data, replace=True)
    assert aside is not None and (aside / "engine.sqlite").exists() and not (data / "engine.sqlite").exists()
    for folder, jobs in ((data, {done}), (aside, {done, later})):
        store = Store(folder)
        assert jobs <= {row.id for row in store.recent()} and (later in jobs) == (len(store.recent()) == 3)
        store.close()


def test_no_restore_over_a_running_service(data: Path, tmp_path: Path) -> None:
    service = Service(data)
    back_up(data, tmp_path / "b")
    with pytest.raises(FolderInUse):
        restore(tmp_path / "b", data, replace=True)
    assert service.store.recent() == [] and sorted(p.name for p in data.iterdir() if p.is_dir()) == []
    service.close()


def test_no_service_starts_in_the_middle_of_a_restore(data: Path, tmp_path: Path, monkeypatch: Any) -> None:
    filled(data)
    back_up(data, tmp_path / "b")
    tried = []
    restored = Store.restored

    def and_start(store: Store, source: str) -> int:
        with pytest.raises(FolderInUse):
            Store(data)
        tried.append(1)
        return restored(store, source)

    monkeypatch.setattr(Store, "restored", and_start)
    restore(tmp_path / "b", data, replace=True)
    assert tried


def _in_the_folder(data: Path, elsewhere: Path) -> Path:
    return data / "loopwright.sqlite"


def _of_the_engine(data: Path, elsewhere: Path) -> Path:
    return data / "engine.sqlite"


def _through_a_link_to_the_folder(data: Path, elsewhere: Path) -> Path:
    (elsewhere / "folder").symlink_to(data)
    return elsewhere / "folder" / "loopwright.sqlite-wal"


def _by_a_symlink(data: Path, elsewhere: Path) -> Path:
    (elsewhere / "link").symlink_to(data / "loopwright.sqlite")
    return elsewhere / "link"


def _by_a_hard_link(data: Path, elsewhere: Path) -> Path:
    (elsewhere / "link").hardlink_to(data / "loopwright.sqlite")
    return elsewhere / "link"


def _of_another_service(data: Path, elsewhere: Path) -> Path:
    Store(elsewhere / "other").close()
    return elsewhere / "other" / "loopwright.sqlite"


@pytest.mark.parametrize(
    "where",
    [_in_the_folder, _of_the_engine, _through_a_link_to_the_folder, _by_a_symlink, _by_a_hard_link,
     _of_another_service],
)  # fmt: skip
@pytest.mark.parametrize("replace", [False, True])
def test_a_back_up_does_not_take_the_place_of_what_the_service_writes(
    data: Path, tmp_path: Path, where: Any, replace: bool
) -> None:
    """Its service would go on writing into a file that has no name any more."""
    store = Store(data)
    file = (data / "loopwright.sqlite").stat().st_ino
    there = sorted(data.iterdir())
    with pytest.raises(BackupProblem, match="name a file elsewhere"):
        back_up(data, where(data, tmp_path), replace)
    later = store.create("L", {}, "me", False).id
    store.close()
    assert (data / "loopwright.sqlite").stat().st_ino == file and set(data.iterdir()) <= set(there)
    store = Store(data)
    assert store.get(later).loop == "L"
    store.close()


def test_a_back_up_replaces_nothing_but_a_file(data: Path, tmp_path: Path) -> None:
    """A device node, such as /dev/null, is as little a file as a pipe is."""
    Store(data).close()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "nowhere").symlink_to(tmp_path / "missing")
    for name in ("pipe", "folder", "nowhere"):
        target = tmp_path / name
        before = target.lstat()
        with pytest.raises(BackupProblem, match="is not a file that"):
            back_up(data, target, replace=True)
        assert (target.lstat().st_ino, target.lstat().st_mode) == (before.st_ino, before.st_mode)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:20_000])


def _scramble(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[8192:16384] = b"\xaa" * 8192
    path.write_bytes(content)


def _other_tables(path: Path) -> None:
    path.unlink()
    with closing(sqlite3.connect(path)) as made:
        made.execute("CREATE TABLE alembic_version (version_num)")


def _never_released(path: Path) -> None:
    with closing(sqlite3.connect(path)) as made:
        made.execute("UPDATE alembic_version SET version_num = '0018'")
        made.commit()


def _newer(path: Path) -> None:
    with closing(sqlite3.connect(path)) as made:
        made.execute("UPDATE alembic_version SET version_num = '9999'")
        made.commit()


@pytest.mark.parametrize(
    "harm",
    [
        _cut,
        _scramble,
        _other_tables,
        _newer,
        _never_released,
        Path.unlink,
        lambda path: path.write_bytes(b"no database"),
    ],
)
def test_what_is_not_a_whole_back_up_is_refused_and_nothing_changes(data: Path, tmp_path: Path, harm: Any) -> None:
    done, _, _ = filled(data)
    back_up(data, tmp_path / "b")
    harm(tmp_path / "b")
    with pytest.raises(BackupProblem):
        restore(tmp_path / "b", data, replace=True)
    store = Store(data)
    assert store.get(done).state == "proposed"
    store.close()


def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of what is synced from now on."""
    done: list[str] = []
    fsync = os.fsync

    def remember(opened: int) -> None:
        done.append(Path(os.readlink(f"/proc/self/fd/{opened}")).name)
        fsync(opened)

    monkeypatch.setattr(os, "fsync", remember)
    return done


def test_what_is_reported_as_done_outlives_a_power_cut(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file, and the folder that names it."""
    filled(data)
    done = synced(monkeypatch)
    back_up(data, tmp_path / "b")
    assert done[-2:] == ["b", tmp_path.name]
    done.clear()
    _, aside = restore(tmp_path / "b", data, replace=True)
    assert aside is not None and done[-3:] == [aside.name, "loopwright.sqlite", data.name]


def test_no_room(data: Path, tmp_path: Path) -> None:
    """A full disk: the command says so, and leaves no half file."""
    filled(data)
    code = (
        "import resource, sys; from loopwright.service.cli.main import main; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (30000, 30000)); "
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        f"sys.argv = ['loopwright', 'backup', {str(tmp_path / 'b')!r}, '--data', {str(data)!r}]; main()"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 2 and ran.stderr.startswith("loopwright: ") and "Traceback" not in ran.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]


def test_the_commands(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: object) -> Any:
        return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])

    file = tmp_path / "b.sqlite"
    assert "not a data folder" in run("backup", file, "--data", data).stderr
    filled(data)
    assert run("backup", file, "--data", data).exit_code == 0
    again = run("backup", file, "--data", data)
    assert again.exit_code == 2 and "--replace" in again.stderr
    assert run("backup", file, "--data", data, "--replace").exit_code == 0
    assert run("backup", tmp_path / "no" / "folder", "--data", data).exit_code == 2
    own = run("backup", data / "loopwright.sqlite", "--data", data, "--replace")
    assert own.exit_code == 2 and "is in the data folder" in own.stderr
    assert run("restore", file, "--data", data).exit_code == 2
    done = run("restore", file, "--data", data, "--replace")
    assert done.exit_code == 0 and "1 job(s)" in done.stdout and "replaced-" in done.stdout
    monkeypatch.setenv("LOOPWRIGHT_DATABASE", "postgresql://somewhere/else")
    for command in ("backup", "restore"):
        assert "pg_dump" in run(command, file, "--data", data, "--replace").stderr
    monkeypatch.delenv("LOOPWRIGHT_DATABASE")
    store = Store(data)
    refused = run("restore", file, "--data", data, "--replace")
    assert refused.exit_code == 2 and "stop it first" in refused.stderr
    store.close()
