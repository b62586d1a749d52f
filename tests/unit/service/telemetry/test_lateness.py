"""The event loop is watched: what holds it up is seen in /metrics and in the log."""

from __future__ import annotations

import asyncio
import logging
import time

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from loopwright.service.telemetry.lateness import EVERY_S, Lateness, watched_event_loop
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import Service

HELD_S = 0.3


def test_the_worst_of_the_last_minute() -> None:
    lateness = Lateness()
    assert lateness.worst_s(1000.0) == 0.0
    for at, late in ((1000.0, 0.01), (1000.5, 0.04), (1000.9, 0.02), (1030.0, 0.03)):
        assert lateness.note(late, at) is None
    assert lateness.worst_s(1059.9) == 0.04 and lateness.worst_s(1061.0) == 0.03 and lateness.worst_s(1091.0) == 0.0


def test_it_is_told_once_a_minute_at_most() -> None:
    lateness = Lateness()
    assert lateness.note(0.06, 1000.0) == 0.06
    assert [lateness.note(0.5, at) for at in (1000.1, 1030.0, 1059.9)] == [None] * 3
    assert lateness.note(0.05, 1060.0) is None  # not late enough
    assert lateness.note(0.07, 1060.1) == 0.5
    assert len(lateness.by_second) <= 61


def test_a_handler_that_blocks_is_seen(service: Service, caplog: pytest.LogCaptureFixture) -> None:
    app = app_of(service.jobs)

    @app.get("/block")
    async def block() -> None:
        time.sleep(HELD_S)

    async def ask() -> str:
        transport = httpx.ASGITransport(app)
        async with (
            watched_event_loop(),
            httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client,
        ):
            await asyncio.sleep(2 * EVERY_S)  # it has begun
            assert (await client.get("/block")).status_code == 200
            await asyncio.sleep(2 * EVERY_S)  # and has seen it
            return (await client.get("/metrics")).text

    with caplog.at_level(logging.WARNING):
        text = asyncio.run(ask())
    families = {family.name: family for family in text_string_to_metric_families(text)}
    (worst,) = families["loopwright_event_loop_late_worst_seconds"].samples
    assert worst.value > HELD_S - 2 * EVERY_S
    buckets = families["loopwright_event_loop_late_seconds"].samples
    found = {sample.labels["le"]: sample.value for sample in buckets if sample.name.endswith("_bucket")}
    assert found["+Inf"] > found["0.2"]
    assert any("the event loop was held up for" in record.message for record in caplog.records)


def test_the_service_watches_its_own(service: Service) -> None:
    app = app_of(service.jobs)

    async def names() -> set[str]:
        async with app.router.lifespan_context(app):
            return {task.get_name() for task in asyncio.all_tasks()}

    assert "event loop watch" in asyncio.run(names())
