"""GET /loops/{tag}/history: what it answers, and what it refuses. What is heard: tests/unit/service/listening."""

from __future__ import annotations

import time

import pytest
from fastapi.testclient import TestClient

from loopwright.service.listening.bins import packed
from loopwright.service.listening.rings import Rings
from loopwright.service.store import history
from loopwright.service.store.history import HistoryBlock
from tests.unit.service.fakes import TAG, Service


def test_the_stored_history_is_answered_in_columns(service: Service, client: TestClient) -> None:
    rings, first_s = Rings(), round(time.time()) - 600.0
    known = rings.number_of((1.5, 20.0, 0.0, 0.0, 1.0, 0.0))
    for n in range(600):
        unknown = n < 10
        rings.put(first_s + 0.1 * n, n + 1, 50.05, 41.3, 50.0, 0 if unknown else known, -1 if unknown else 2, 0)
    rows = rings.unsaved(all_of_it=True)
    assert rows is not None
    last_s = float(rows.bins["until_s"][-1])
    history.write(service.store, [HistoryBlock(TAG, None, first_s, last_s, len(rows.bins), packed(rows))])

    answer = client.get(f"/loops/{TAG}/history", params={"points": 2000})
    assert answer.status_code == 200, answer.text
    found = answer.json()
    columns = {name: values for name, values in found.items() if isinstance(values, list)}
    lengths = {name: len(values) for name, values in columns.items() if name not in ("gain_sets", "gaps", "disturbed")}
    assert set(lengths.values()) == {len(rows.bins)} and sum(found["samples"]) == 600
    assert {50.05} == {*found["pv_min"], *found["pv_max"], *found["pv_mean"]} and set(found["mv_mean"]) == {41.3}
    assert (found["mode"][0], found["gains"][0]) == (None, None)
    assert (found["mode"][-1], found["gains"][-1], found["gain_sets"][0]["Kp"]) == ("automatic", 0, 1.5)
    assert [gap["to_s"] for gap in found["gaps"]] == [first_s, found["to_s"]]
    assert found["no_data"] == "listening is turned off" and found["to_s"] - found["from_s"] == 3600.0

    few = client.get(f"/loops/{TAG}/history", params={"points": 1, "from": first_s + 20.0, "to": first_s + 30.0}).json()
    assert len(few["at_s"]) == 1 and not few["gaps"]


def test_a_loop_that_is_not_there_is_404(client: TestClient) -> None:
    answer = client.get("/loops/NONE/history")
    assert answer.status_code == 404 and answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "query",
    [
        "points=0", "points=5001", "from=yesterday", "from=2026-01-02T00:00:00Z&to=2026-01-01T00:00:00Z",
        "from=2026-01-01T00:00:00Z&to=2026-01-10T00:00:00Z", "from=9999-12-31T00:00:00Z", "from=nan", "to=1e300",
        "from=0001-01-01T00:00:00Z",
    ],
)  # fmt: skip
def test_times_and_numbers_that_mean_nothing_are_422(client: TestClient, query: str) -> None:
    answer = client.get(f"/loops/{TAG}/history?{query}")
    assert answer.status_code == 422, answer.text
    assert answer.json()["reason"] == "bad_input" and answer.json()["errors"]
