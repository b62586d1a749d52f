"""The service's container on a data volume of another version: the command that it runs, on such a folder."""

from __future__ import annotations

import socket
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from loopwright.service.cli.demo import loops_yaml
from loopwright.service.store.database import FILE, migrate, sqlite


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "loops.yaml").write_text(loops_yaml("virtual:unused"))
    (tmp_path / "data").mkdir()
    return tmp_path


def serve(folder: Path, port: int = 0) -> subprocess.CompletedProcess[str]:
    command = ["-m", "loopwright.service", "serve", "--loops", f"{folder}/loops.yaml", "--data", f"{folder}/data"]
    command += ["--port", str(port)]
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=200, check=False)


def test_of_a_newer_version_it_is_refused_in_one_line_and_not_changed(folder: Path) -> None:
    file = folder / "data" / FILE
    engine = sqlite(file)
    migrate(engine)
    engine.dispose()
    with closing(sqlite3.connect(file)) as made:
        made.execute("UPDATE alembic_version SET version_num = '9999'")
        made.commit()
        before = list(made.iterdump())
    done = serve(folder)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and "made by a newer version" in done.stderr and "'9999'" in done.stderr
    with closing(sqlite3.connect(file)) as made:
        assert list(made.iterdump()) == before


def test_no_folder_can_be_made_there(folder: Path) -> None:
    (folder / "data").rmdir()
    (folder / "data").write_text("a file where the folder should be")
    done = serve(folder)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and "it is a file" in done.stderr


def test_a_port_that_is_taken_is_named(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        done = serve(folder, other.getsockname()[1])
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and "choose another port with --port" in done.stderr


def test_a_port_that_is_none_is_refused(folder: Path) -> None:
    done = serve(folder, 65536)
    assert done.returncode == 2 and "--port" in done.stderr and "Traceback" not in done.stderr
