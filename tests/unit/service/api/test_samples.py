"""The samples of a job on their way to a client: what is written, in how much memory, and beside what else."""

from __future__ import annotations

import asyncio
import csv
import gzip
import io
import json
import math
import threading
import tracemalloc
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import delete
from sqlalchemy.pool import QueuePool

from loopwright.service.api.samples import Gone, Reading, csv_text, json_text, parts
from loopwright.service.api.web.compressed import takes_gzip
from loopwright.service.jobs.stored_record import record_columns
from loopwright.service.store import sample_blocks
from loopwright.service.store.store import Store
from loopwright.service.store.tables import ChunkRow
from loopwright.tuning.plan import Sample
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service, add_samples

TS = 0.1
LONG = 4096
"""Samples of the longest block there is."""
PER_BLOCK = 200


def block_of_samples(first: int, count: int = PER_BLOCK) -> list[Sample]:
    n = np.arange(first, first + count)
    pv = np.float32(50.0 + np.sin(0.01 * n)).astype(float)
    return [Sample(round(TS * k, 6), 50.0, y, 45.25, 2) for k, y in zip(n.tolist(), pv.tolist(), strict=True)]


def filled(store: Store, blocks: int) -> str:
    """A job with so many blocks, the first of another stage."""
    job = store.create(TAG, {}, "test", True).id
    for k in range(blocks):
        add_samples(store, job, "preflight" if k == 0 else "relay", block_of_samples(k * PER_BLOCK))
    return job


def test_columns_and_rows_are_the_samples(client: TestClient, service: Service) -> None:
    job = filled(service.store, 40)  # more than are read at once
    columns = client.get(f"/jobs/{job}/samples").json()
    assert columns.pop("job") == job
    assert list(columns) == ["stage", "t_s", "sp", "pv", "mv", "mode"]
    assert {len(column) for column in columns.values()} == {40 * PER_BLOCK}
    assert columns["stage"] == ["preflight"] * PER_BLOCK + ["relay"] * 39 * PER_BLOCK
    expected = [sample for k in range(40) for sample in block_of_samples(k * PER_BLOCK)]
    assert columns["t_s"] == [sample.t for sample in expected]
    assert np.array_equal(np.float32(columns["pv"]), np.float32([sample.pv for sample in expected]))
    rows = list(csv.DictReader(io.StringIO(client.get(f"/jobs/{job}/samples?format=csv").text)))
    assert [float(row["pv"]) for row in rows] == columns["pv"] and [float(row["t_s"]) for row in rows] == columns["t_s"]
    for name, values in record_columns(service.store.blocks(job)).items():
        assert list(values) == columns[name]


def test_one_stage_and_none(client: TestClient, service: Service) -> None:
    job = filled(service.store, 2)
    assert set(client.get(f"/jobs/{job}/samples?stage=relay").json()["stage"]) == {"relay"}
    assert client.get(f"/jobs/{job}/samples?stage=nothing").json() == {
        "job": job, "stage": [], "t_s": [], "sp": [], "pv": [], "mv": [], "mode": [],
    }  # fmt: skip
    assert client.get(f"/jobs/{job}/samples?stage=nothing&format=csv").text == "stage,t_s,sp,pv,mv,mode\n"


def test_what_is_no_number_is_null(client: TestClient, service: Service) -> None:
    job = service.store.create(TAG, {}, "test", True).id
    values = (math.nan, math.inf, -math.inf, 0.1)
    add_samples(service.store, job, "relay", [Sample(0.0, 50.0, pv, 1.0, 2) for pv in values])
    assert client.get(f"/jobs/{job}/samples").json()["pv"] == [None, None, None, 0.1]
    assert "relay,0.0,50.0,nan,1.0,2\n" in client.get(f"/jobs/{job}/samples?format=csv").text


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_decimal_is_the_float32_that_was_stored(value: float) -> None:
    (text,) = sample_blocks.Block("relay", 0.0, 1, sample_blocks.pack([Sample(0.0, 0.0, value, 0.0, 2)])).texts("pv")
    assert np.float32(text).tobytes() == np.float32(value).tobytes()
    assert len(text.lstrip("-").partition("e")[0].replace(".", "").strip("0")) <= 9


def test_times_are_as_they_were_counted() -> None:
    """Not with the tail of a float32, which at 409.1 s is 0.00001 s."""
    (times,) = [sample_blocks.Block("relay", 12.3, LONG, sample_blocks.pack(block_of_samples(123, LONG))).texts("t_s")]
    assert times == [repr(sample.t) for sample in block_of_samples(123, LONG)]


@pytest.mark.parametrize(
    "accepted, compressed",
    [("gzip", True), ("br;q=1.0, gzip;q=0.8", True), ("GZIP", True), ("gzip;q=0", False), ("gzip; q=0.00", False),
     ("gzip;q=0.001", True), ("", False), ("identity", False), ("xgzip", False)],
)  # fmt: skip
def test_compressed_for_who_takes_that(client: TestClient, service: Service, accepted: str, compressed: bool) -> None:
    job = filled(service.store, 3)
    assert takes_gzip(accepted) == compressed
    plain = client.get(f"/jobs/{job}/samples", headers={"Accept-Encoding": "identity"})
    with client.stream("GET", f"/jobs/{job}/samples", headers={"Accept-Encoding": accepted}) as answer:
        raw = b"".join(answer.iter_raw())
    assert answer.headers["vary"] == "Accept-Encoding"
    assert answer.headers.get("content-encoding") == ("gzip" if compressed else None)
    assert (gzip.decompress(raw) if compressed else raw) == plain.content
    assert not compressed or len(raw) < 0.3 * len(plain.content)


def test_samples_that_come_meanwhile_are_left_out(service: Service) -> None:
    job = filled(service.store, 2)
    text = json_text(Reading(service.store, job))
    begun = [next(text) for _ in range(4)]
    add_samples(service.store, job, "relay", block_of_samples(2 * PER_BLOCK))
    columns = json.loads("".join(begun) + "".join(text))
    assert {len(column) for name, column in columns.items() if name != "job"} == {2 * PER_BLOCK}


def test_samples_that_are_deleted_meanwhile_break_the_answer_off(service: Service) -> None:
    job = filled(service.store, 2)
    text = json_text(Reading(service.store, job))
    [next(text) for _ in range(6)]  # all stages and the first of the times
    with service.store.writing() as session:
        session.execute(delete(ChunkRow))
    with pytest.raises(Gone):
        list(text)


def many(store: Store, blocks: int) -> str:
    """A job with so many blocks, packed once."""
    job = store.create(TAG, {}, "test", True).id
    data = sample_blocks.pack(block_of_samples(0, LONG))
    with store.writing() as session:
        session.add_all(
            ChunkRow(job_id=job, seq=k + 1, stage="relay", first_t_s=k * LONG * TS, count=LONG, data=data)
            for k in range(blocks)
        )
    return job


@pytest.mark.parametrize("writer", [json_text, lambda of: csv_text(of.blocks())], ids=["json", "csv"])
def test_the_samples_are_never_all_in_memory(service: Service, writer: Any) -> None:
    """So many took 22 MB, and 1.5 million 806 MB. The blocks that are read at once are 1 MB, and so is their text."""
    job = many(service.store, 10)
    tracemalloc.start()
    try:
        length = sum(map(len, parts(writer(Reading(service.store, job)), compress=True)))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert length > 100_000 and peak < 5e6


@pytest.mark.parametrize("query", ["", "?format=csv"])
def test_nothing_of_a_download_is_done_in_the_event_loop(
    service: Service, monkeypatch: pytest.MonkeyPatch, query: str
) -> None:
    job = many(service.store, 3)
    real, threads = sample_blocks.Block.texts, set[int]()

    def watched(block: sample_blocks.Block, column: str) -> list[str]:
        threads.add(threading.get_ident())
        return real(block, column)

    monkeypatch.setattr(sample_blocks.Block, "texts", watched)

    async def download() -> int:
        transport = httpx.ASGITransport(app_of(service.jobs))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return len((await client.get(f"/jobs/{job}/samples{query}")).content)

    assert asyncio.run(download()) > 100_000
    assert threads and threading.get_ident() not in threads


def test_a_slow_client_holds_no_connection_to_the_database(store: Store) -> None:
    job = filled(store, 20)
    for _ in json_text(Reading(store, job)):
        assert isinstance(store.engine.pool, QueuePool) and store.engine.pool.checkedout() <= store.shared
