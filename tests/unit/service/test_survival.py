"""Services that are killed, doubled or cut off from their database: processes, with their loops in files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import create_engine, select
from sqlalchemy.orm import Session

from service.processes import Process
from service.store.tables import EventRow
from tests.unit.service.fakes import NEW, OLD, TAG
from tests.unit.service.gateway import HOME, STAGES, read_loop


class Gateway:
    """The process of tests.unit.service.gateway, started again as often as a test likes."""

    def __init__(self, stack: ExitStack, folder: Path, *arguments: str) -> None:
        self.folder = folder
        self.database = f"sqlite:///{folder / 'data' / 'loopwright.sqlite'}"
        self._stack = stack
        self._arguments = arguments
        folder.mkdir(parents=True, exist_ok=True)
        self.serve()

    def launch(self, *more: str) -> Process:
        arguments = ("tests.unit.service.gateway", str(self.folder), *(self._arguments or ("--tag", TAG)), *more)
        process = Process("gateway", arguments, self.folder / "gateway.log")
        self._stack.callback(process.stop)
        return process

    def serve(self, *more: str) -> None:
        self.process = self.launch(*more)
        url = self.process.wait_ready(30).split()[1]
        self.http = httpx.Client(base_url=url, timeout=20.0, trust_env=False)
        self._stack.callback(self.http.close)

    def go(self, stage: str = "") -> None:
        (self.folder / (f"go-{stage}" if stage else "go")).touch()

    def retune(self, tag: str = TAG, **options: Any) -> str:
        answer = self.http.post(f"/loops/{tag}/retune", json=options)
        assert answer.status_code == 202, answer.text
        return str(answer.headers["location"])

    def until(self, url: str, wanted: Callable[[dict[str, Any]], bool], timeout_s: float = 20.0) -> dict[str, Any]:
        deadline = time.monotonic() + timeout_s
        while True:
            answer = self.http.get(url)
            if answer.status_code == 200 and wanted(answer.json()):
                return dict(answer.json())
            assert time.monotonic() < deadline, answer.text
            time.sleep(0.02)

    def in_stage(self, url: str, stage: str) -> dict[str, Any]:
        """Runs the job up to the middle of a stage: the loop is on trial, and the API says which stage it is."""
        for before in STAGES[: STAGES.index(stage)]:
            self.go(before)

        def there(job: dict[str, Any]) -> bool:
            return bool(job["stage"] == stage and job["attempts"] > 0 and read_loop(self.folder, TAG).on_trial)

        return self.until(url, there)

    def over(self, url: str, timeout_s: float = 20.0) -> dict[str, Any]:
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


def test_killed_in_every_stage_it_resumes_there_and_nothing_runs_twice(stack: ExitStack, tmp_path: Path) -> None:
    gateway = Gateway(stack, tmp_path)
    url = gateway.retune()
    for attempt, stage in enumerate(STAGES, 1):
        job = gateway.in_stage(url, stage)
        assert job["attempts"] == attempt
        gateway.process.kill()
        assert read_loop(tmp_path, TAG).gains == NEW  # this controller does not go back by itself
        gateway.serve()
        found = gateway.events(url, "loop_found")
        assert len(found) == attempt and "brought back" in found[-1]["text"]
    gateway.go()
    job = gateway.over(url)
    assert (job["state"], job["attempts"]) == ("proposed", len(STAGES) + 1)
    # Each stage was cut off once and run again once; none of those finished before ran again.
    assert gateway.ran() == [stage for stage in STAGES for _ in range(2)]
    assert read_loop(tmp_path, TAG) == HOME and job["restored"]["gains"]["Kp"] == OLD.Kp
    assert [stage["state"] for stage in job["stages"]] == ["done"] * len(STAGES)
    samples = gateway.http.get(f"{url}/samples").json()
    assert samples["t_s"] == sorted(samples["t_s"]) and set(samples["stage"]) == set(STAGES)
