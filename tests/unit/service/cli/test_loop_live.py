"""`loopwright loop TAG --follow`: what is heard of a loop, as lines, as a table, as JSON."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from rich.console import Console

from loopwright.service.cli import client as client_module
from loopwright.service.cli import loop_live
from loopwright.service.cli.client import ApiError, Client
from loopwright.service.live.messages import RETRY_MS, LiveJob, LiveJobs, LiveLoopRow, Loops, event

ROW: dict[str, Any] = {
    "tag": "TIC-101", "pv": 64.98, "sp": 65.0, "mv": 40.1, "mode": "automatic", "age_s": 0.1, "under_test": False,
    "on_trial": False, "no_data": None, "gateway": "local", "job": None, "last_job": None,
}  # fmt: skip
JOB: dict[str, Any] = {
    "id": "4f0c2a9be113", "url": "/jobs/4f0c2a9be113", "loop": "TIC-101", "gateway": "local", "state": "running",
    "dry_run": False, "by": "me", "stage": "relay", "progress": 0.42, "remaining_plant_time_s": 31.2,
    "remaining_wall_time_s": 31.2,
    "plant_time_s": 22.7, "stopping": False,
}  # fmt: skip


def rows(*changes: dict[str, Any]) -> str:
    return event("loops", Loops(now_s=1769860830.5, loops=[LiveLoopRow(**ROW | each) for each in changes]))


def streaming(*answers: httpx.Response | Exception) -> Client:
    """A client whose live streams are these in turn; Ctrl-C comes where there are no more."""
    left = list(answers)

    def answer(request: httpx.Request) -> httpx.Response:
        assert request.url.path == "/live" and request.url.params["loops"] == "TIC-101"
        if not left:
            raise KeyboardInterrupt
        now = left.pop(0)
        if isinstance(now, Exception):
            raise now
        return now

    client = Client("http://gateway")
    client._http = httpx.Client(base_url="http://gateway", transport=httpx.MockTransport(answer))  # noqa: SLF001
    return client


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "time", SimpleNamespace(sleep=lambda seconds: None))


def text(*messages: str) -> httpx.Response:
    return httpx.Response(200, text=f"retry: {RETRY_MS}\n" + "".join(messages))


def test_a_line_for_each_second_with_the_job_that_has_the_loop(capsys: pytest.CaptureFixture[str]) -> None:
    job = event("jobs", LiveJobs(jobs=[LiveJob(**JOB)]))
    under_test = {"job": JOB["url"], "mode": "experiment", "under_test": True}
    silent = {"pv": None, "sp": None, "mv": None, "mode": None, "no_data": "no data for 4 s"}
    client = streaming(text(rows({}, {"tag": "B"}), job, rows(under_test), rows(silent)))
    loop_live.follow(client, "TIC-101", "degC", Console(), as_json=False)
    one, two, three, lost = capsys.readouterr().out.splitlines()
    assert one.endswith("  SP 65.00 degC, PV 64.98 degC, MV 40.10 %, automatic")
    assert two.endswith("experiment, job 4f0c2a9be113: Relay test 42%, about 31 s of plant time left")
    assert three.endswith("  no data: no data for 4 s")
    assert lost == "the service at http://gateway has ended the stream, it is tried again"


def test_a_service_that_is_away_is_tried_again(capsys: pytest.CaptureFixture[str]) -> None:
    client = streaming(text(rows({})), httpx.ConnectError("refused"), text(rows({"pv": 65.02})))
    loop_live.follow(client, "TIC-101", "degC", Console(), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert ["PV" in each for each in lines] == [True, False, False, True, False]
    assert "is not reached (refused)" in lines[2]


def test_json_is_an_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    loop_live.follow(streaming(text(rows({}), rows({"mv": 41.0}))), "TIC-101", "degC", Console(), as_json=True)
    assert [json.loads(each)["mv"] for each in capsys.readouterr().out.splitlines()] == [40.1, 41.0]


def test_a_terminal_has_one_table(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(force_terminal=True, width=100)
    other = {"under_test": True, "on_trial": True, "no_data": "no data for 4 s"}
    loop_live.follow(streaming(text(rows({}), rows(other))), "TIC-101", "degC", console, as_json=False)
    shown = capsys.readouterr().out
    assert "TIC-101 at " in shown and "64.98 degC" in shown and "no test" in shown
    assert "under test by another tuner" in shown and "gains on trial" in shown and "no data: no data" in shown


def test_an_unknown_loop_is_an_error() -> None:
    answer = httpx.Response(404, json={"detail": "there is no loop TIC-101"})
    with pytest.raises(ApiError, match="there is no loop"):
        loop_live.follow(streaming(answer), "TIC-101", "degC", Console(), as_json=False)


def test_the_end_of_who_reads_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(client: Client, tag: str) -> Iterator[str]:
        yield "a line"
        raise BrokenPipeError

    redirected: list[tuple[int, int]] = []
    monkeypatch.setattr(loop_live, "presents", broken)
    monkeypatch.setattr(os, "dup2", lambda a, b: redirected.append((a, b)))
    monkeypatch.setattr(sys.stdout, "fileno", lambda: 1, raising=False)
    loop_live.follow(streaming(), "TIC-101", "degC", Console(), as_json=False)
    assert len(redirected) == 1
