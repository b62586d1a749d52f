"""The end of a service: by a signal, and where it does not come to its start."""

from __future__ import annotations

import logging
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from sqlalchemy import text

from loopwright.service.server import serving
from loopwright.service.server.signals import Signals
from loopwright.service.store.database import ENGINE_FILE, FILE
from loopwright.service.store.lock import FolderLock
from loopwright.service.store.store import Store
from tests.unit.service.fakes import NEW, TAG, loop_entry
from tests.unit.service.gateway import HOME, read_loop
from tests.unit.service.processes import until
from tests.unit.service.server.test_survival import Gateway

pytestmark = pytest.mark.timeout(600)  # processes that start slowly on a busy machine
ROOT = Path(__file__).parents[4]
SIGNALS = (signal.SIGTERM, signal.SIGINT)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def under_test(stack: ExitStack, tmp_path: Path) -> tuple[Gateway, str]:
    """A service in the middle of a test of its loop, and the URL of the job."""
    gateway = Gateway(stack, tmp_path)
    url = gateway.retune()
    gateway.in_stage(url, "ultimate")
    assert read_loop(tmp_path, TAG).gains == NEW
    return gateway, url


def ended(gateway: Gateway) -> int:
    until(lambda: gateway.process.poll() is not None, "the end of the service")
    status = gateway.process.poll()
    assert status is not None
    return status


def log_of(gateway: Gateway) -> str:
    return (gateway.folder / "gateway.log").read_text()


def job_in(folder: Path, url: str) -> tuple[str, str | None]:
    with closing(Store(folder / "data")) as store:
        row = store.get(url.rpartition("/")[2])
    return row.state, row.reason


@pytest.mark.parametrize("number", SIGNALS, ids=lambda number: signal.Signals(number).name)
def test_a_stop_by_a_signal_is_a_success_and_leaves_nothing_in_the_wal(
    under_test: tuple[Gateway, str], tmp_path: Path, number: int
) -> None:
    gateway, url = under_test
    files = [tmp_path / "data" / name for name in (FILE, ENGINE_FILE)]
    assert all(wal(file) for file in files)  # there is something to be written
    gateway.process.signal(number)
    assert ended(gateway) == 0, log_of(gateway)
    assert not any(wal(file) for file in files)
    assert read_loop(tmp_path, TAG) == HOME
    said = log_of(gateway)
    assert "Traceback" not in said
    assert f"{signal.Signals(number).name}: the service ends; it waits until these loops are restored" in said
    assert f"{TAG} (job {url.rpartition('/')[2]})" in said
    assert job_in(tmp_path, url) == ("aborted", "service_stopped")


def wal(file: Path) -> int:
    """How many bytes SQLite keeps beside the file."""
    beside = file.with_name(f"{file.name}-wal")
    return beside.stat().st_size if beside.exists() else 0


def test_the_file_alone_holds_everything_after_a_stop(under_test: tuple[Gateway, str], tmp_path: Path) -> None:
    gateway, url = under_test
    gateway.process.signal(signal.SIGTERM)
    assert ended(gateway) == 0, log_of(gateway)
    alone = tmp_path / "copied.sqlite"
    alone.write_bytes((tmp_path / "data" / FILE).read_bytes())
    with closing(sqlite3.connect(alone)) as file:
        found = file.execute("SELECT state FROM jobs WHERE id = ?", (url.rpartition("/")[2],)).fetchall()
    assert found == [("aborted",)]


def test_the_wal_is_emptied_beside_a_connection_that_is_not_given_back(tmp_path: Path) -> None:
    """SQLite does it by itself only as the last connection is closed; a request may be answered still."""
    store = Store(tmp_path)
    with store.engine.connect() as held:
        held.execute(text("SELECT count(*) FROM jobs")).one()
        store.create(TAG, {}, "me", False)
        assert wal(tmp_path / FILE)
        store.close()
        assert not wal(tmp_path / FILE)


@pytest.mark.parametrize("first", SIGNALS, ids=lambda number: signal.Signals(number).name)
def test_further_signals_do_not_cut_the_stop_short(under_test: tuple[Gateway, str], tmp_path: Path, first: int) -> None:
    gateway, url = under_test
    held = tmp_path / f"{TAG}.held"
    held.touch()
    gateway.process.signal(first)
    until(lambda: "the service ends" in log_of(gateway), "word of the signal")
    for again in (signal.SIGINT, signal.SIGTERM, signal.SIGINT):
        lines = len(log_of(gateway).splitlines())
        gateway.process.signal(again)
        until(lambda: len(log_of(gateway).splitlines()) > lines, "word of a further signal")  # noqa: B023 - called here
        said = log_of(gateway).splitlines()[-1]
        assert f"{signal.Signals(again).name} again" in said and "is not cut short" in said and TAG in said
    assert gateway.process.poll() is None and read_loop(tmp_path, TAG).gains == NEW
    held.unlink()
    assert ended(gateway) == 0, log_of(gateway)
    assert read_loop(tmp_path, TAG) == HOME
    assert job_in(tmp_path, url) == ("aborted", "service_stopped")


def test_a_stream_ends_before_a_stop_that_takes_long(stack: ExitStack, tmp_path: Path) -> None:
    """A job's stream ends with the job; where its loop takes longer to come home than the server waits for its
    connections, the stream ends before, as a stream that is to be resumed."""
    gateway = Gateway(stack, tmp_path, more=["--streams-grace-s=1"])
    url = gateway.retune()
    gateway.in_stage(url, "ultimate")
    held = tmp_path / f"{TAG}.held"
    held.touch()
    with gateway.http.stream("GET", f"{url}/events") as stream:
        lines = stream.iter_lines()
        assert next(line for line in lines if line.startswith("event: progress"))
        gateway.process.signal(signal.SIGTERM)
        said = list(lines)
    assert gateway.process.poll() is None and read_loop(tmp_path, TAG).gains == NEW
    assert said[-2:] == [": the service ends, and the job has not ended yet", ""]
    held.unlink()
    assert ended(gateway) == 0, log_of(gateway)
    assert "Traceback" not in log_of(gateway) and " ERROR " not in log_of(gateway), log_of(gateway)
    assert read_loop(tmp_path, TAG) == HOME
    assert job_in(tmp_path, url) == ("aborted", "service_stopped")


def test_a_signal_after_everything_has_ended_ends_a_process_that_hangs(tmp_path: Path) -> None:
    hangs = (
        "import os, signal, threading\n"
        "from loopwright.service.server.signals import Signals\n"
        "with Signals():\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "threading.Thread(target=threading.Event().wait).start()\n"
        "print('hangs', flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", hangs], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "hangs\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(120) == 0


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> Iterator[Callable[[], list[str]]]:
    """What the handling of signals has logged; the signals have the handlers of before again at the end."""
    caplog.set_level(logging.INFO)
    before = {each: signal.getsignal(each) for each in SIGNALS}
    yield lambda: [record.getMessage() for record in caplog.records if record.name == Signals.__module__]
    for each, handler in before.items():
        signal.signal(each, handler)


def test_the_log_says_what_was_awaited_when_the_signal_came(said: Callable[[], list[str]]) -> None:
    under_test = [TAG]
    with Signals() as signals:
        signals.tell(under_test.clear, lambda: f"it waits for {under_test}")
        signal.raise_signal(signal.SIGTERM)
    assert said() == [f"SIGTERM: the service ends; it waits for ['{TAG}']"] and not under_test


def test_a_signal_that_came_before_has_the_end_called_at_once(said: Callable[[], list[str]]) -> None:
    ended: list[int] = []
    with Signals() as signals:
        signal.raise_signal(signal.SIGINT)
        assert not said()
        signals.tell(lambda: ended.append(1), lambda: "nothing is awaited")
        assert ended
    assert said() == ["SIGINT: the service ends; it has not started yet"]


def test_an_end_that_cannot_be_begun_ends_the_service_as_any_error_does(said: Callable[[], list[str]]) -> None:
    """The error rises where the service waits for requests, and the loops are restored as all is closed."""

    def end() -> None:
        raise OSError(24, "too many open files")

    with pytest.raises(OSError, match="too many"), Signals() as signals:
        signals.tell(end, lambda: "nothing is awaited")
        signal.raise_signal(signal.SIGTERM)
    assert said() == ["SIGTERM: the service ends; nothing is awaited"]


def test_signals_that_nobody_sent_are_the_callers_again() -> None:
    before = [signal.getsignal(each) for each in SIGNALS]
    with Signals():
        assert [signal.getsignal(each) for each in SIGNALS] != before
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_a_taken_port_is_found_before_anything_is_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def begun(*_: Any, **__: Any) -> None:
        pytest.fail("something was begun")

    for name in ("Pool", "Store", "DurableEngine", "make_jobs"):
        monkeypatch.setattr(serving, name, begun)
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(OSError):
        serving.serve(serving.Setup(loops_in(tmp_path), tmp_path / "data", "127.0.0.1", other.getsockname()[1]))


def loops_in(folder: Path) -> Path:
    file = folder / "loops.yaml"
    file.write_text(yaml.safe_dump({"loops": [loop_entry()]}))
    return file


def port_taken(data: Path, stack: ExitStack) -> list[str]:
    other = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    return [f"--port={other.getsockname()[1]}"]


def folder_in_use(data: Path, stack: ExitStack) -> list[str]:
    data.mkdir()
    stack.enter_context(closing(FolderLock(data)))
    return []


def newer_database(data: Path, stack: ExitStack) -> list[str]:
    Store(data).close()
    with closing(sqlite3.connect(data / FILE)) as file:
        file.execute("UPDATE alembic_version SET version_num = '9999'")
        file.commit()
    return []


def no_database(data: Path, stack: ExitStack) -> list[str]:
    data.mkdir()
    (data / FILE).write_text("no database" * 1000)
    return []


def no_keys(data: Path, stack: ExitStack) -> list[str]:
    return ["--bind=0.0.0.0"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (port_taken, "choose another port with --port"),
        (folder_in_use, "is in use"),
        (newer_database, "made by a newer version"),
        (no_database, "database"),
        (no_keys, "loopwright key create"),
    ],
)
def test_a_start_that_fails_is_one_sentence_and_leaves_nothing(
    stack: ExitStack, tmp_path: Path, given: Callable[[Path, ExitStack], list[str]], words: str
) -> None:
    data = tmp_path / "data"
    place = [f"--loops={loops_in(tmp_path)}", f"--data={data}", "--port=0"]
    command = [sys.executable, "-m", "loopwright.service", "serve", *place, *given(data, stack)]
    with (tmp_path / "errors").open("w") as errors:
        process = subprocess.Popen(command, cwd=ROOT, stderr=errors, start_new_session=True)
        assert process.wait(120) == 2
    until(lambda: not members(process.pid), "the end of every process it had begun")
    said = (tmp_path / "errors").read_text().splitlines()
    assert len(said) == 1 and words in said[0], said
    assert given is not port_taken or not data.exists()
    stack.close()
    if data.exists():
        FolderLock(data).close()  # nobody has it


def members(session: int) -> list[int]:
    """The processes of a session, those aside that are over and only wait to be asked for their status."""
    found = []
    for each in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of, *_ = each.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(of) == session and state != "Z":
            found.append(int(each.parent.name))
    return found
