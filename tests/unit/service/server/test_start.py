"""SIGTERM while the service starts: it ends cleanly, and the jobs of the service before it are not lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import create_engine, select

from loopwright.service.jobs.engine import WORKFLOW_VERSION
from loopwright.service.states.job_state import JobState
from loopwright.service.states.loop_state import state_json
from loopwright.service.store.database import FILE
from loopwright.service.store.store import Store
from loopwright.service.store.tables import JobRow
from tests.unit.service.fakes import NEW, TAG
from tests.unit.service.gateway import HOME, STAGES, main, read_loop, write_loop

pytestmark = pytest.mark.timeout(600)  # processes that start slowly on a busy machine
ROOT = Path(__file__).parents[4]
SESSION = 77

BEFORE_IT_WORKS = (
    "before loopwright.service.server.serving:Store.__init__",
    "after loopwright.service.server.serving:Store.__init__",
    "before loopwright.service.server.serving:Signals.tell",
    "before loopwright.service.jobs.manager:Store.own_loops",
    "before loopwright.service.jobs.recovery:Recovery.recover",
    "before loopwright.service.jobs.dbos_engine:DurableEngine.launch",
    "after loopwright.service.jobs.dbos_engine:DurableEngine.launch",
)
AS_IT_WORKS = (
    "before loopwright.service.jobs.retention:Retention.start",
    "before loopwright.service.server.serving:_Server.serve",
    "before loopwright.service.server.serving:_Server.startup",
    "before loopwright.service.jobs.fleet:Fleet.boot",
)


def left(folder: Path) -> str:
    """A job in the middle of its test, and its loop on trial, as kill -9 leaves them."""
    folder.mkdir()
    write_loop(folder, TAG, replace(HOME, gains=NEW, on_trial=True))
    (folder / f"{TAG}.session").write_text(json.dumps({"number": SESSION, "home": state_json(HOME)}))
    with closing(Store(folder / "data")) as store:
        row = store.create(TAG, {}, "me", False, version=WORKFLOW_VERSION)
        found = {"found": state_json(HOME), "previous_gains": state_json(HOME)["gains"], "session": SESSION}
        store.move(row.id, JobState.RUNNING, attempt=1, **found)
    return row.id


def gateway(folder: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.unit.service.gateway", str(folder), f"--tag={TAG}", *more]
    return subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_it_ends_cleanly_at_whatever_moment(tmp_path: Path) -> None:
    job_id = left(tmp_path / "left")
    moments = dict(enumerate((*BEFORE_IT_WORKS, *AS_IT_WORKS)))
    for number in moments:
        shutil.copytree(tmp_path / "left", tmp_path / str(number))
    command = [sys.executable, "-m", "tests.unit.service.server.test_start", str(tmp_path), *moments.values()]
    subprocess.run(command, cwd=ROOT, check=True, timeout=500)
    for number, when in moments.items():
        output = (tmp_path / f"{number}.log").read_text()
        assert (tmp_path / f"{number}.status").read_text() == "0", (when, output)
        assert "Traceback" not in output and (when in AS_IT_WORKS or "ready" not in output), (when, output)
        with closing(Store(tmp_path / str(number) / "data")) as store:
            row = store.get(job_id)
        if when in BEFORE_IT_WORKS:
            assert row.state == "running", (when, row.detail)
        else:  # the jobs were taken up: they end as at any SIGTERM, their loops restored
            assert (row.state, row.reason) == ("aborted", "service_stopped"), (when, row.detail)
            assert read_loop(tmp_path / str(number), TAG) == HOME, when


def test_what_it_has_left_the_next_start_goes_on_with(tmp_path: Path) -> None:
    """The engine had been given the job, and believes that it was run."""
    job_id = left(tmp_path / "one")
    first = gateway(tmp_path / "one", "--sigterm=after loopwright.service.jobs.dbos_engine:DurableEngine.launch")
    assert first.communicate(timeout=300) and first.returncode == 0
    (tmp_path / "one" / "go").touch()
    second = gateway(tmp_path / "one")
    assert second.stdout is not None and second.stdout.readline().startswith("ready")
    with closing(create_engine(f"sqlite:///{tmp_path / 'one' / 'data' / FILE}").connect()) as database:
        until = time.monotonic() + 120
        state = ""
        while state != "proposed" and time.monotonic() < until:
            time.sleep(0.1)
            state = database.scalars(select(JobRow.state).where(JobRow.id == job_id)).one()
            database.rollback()
    second.send_signal(signal.SIGTERM)
    second.communicate(timeout=120)
    assert (state, second.returncode) == ("proposed", 0)
    assert (tmp_path / "one" / f"{TAG}.ran").read_text().split() == list(STAGES)


def ended_at(folder: Path, moments: list[str]) -> None:
    """A service for each moment, forked from this process, which has everything imported: that is what takes time."""
    children = {}
    for number, when in enumerate(moments):
        child = os.fork()
        if child == 0:
            log = os.open(folder / f"{number}.log", os.O_WRONLY | os.O_CREAT)
            os.dup2(log, 1)
            os.dup2(log, 2)
            sys.argv = ["gateway", str(folder / str(number)), f"--tag={TAG}", f"--sigterm={when}"]
            main()
            return
        children[child] = number
    while children:
        child, status = os.wait()
        (folder / f"{children.pop(child)}.status").write_text(str(os.waitstatus_to_exitcode(status)))


if __name__ == "__main__":
    ended_at(Path(sys.argv[1]), sys.argv[2:])
