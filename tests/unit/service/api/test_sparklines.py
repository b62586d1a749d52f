"""GET /history: all loops in one answer, from memory; a gap is told, and a loop that is not heard is empty."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from loopwright.service.listening.bins import GAP_BEFORE, Rows
from loopwright.service.listening.listening import Listening
from loopwright.service.listening.rings import Rings
from tests.unit.service.apps import app_of
from tests.unit.service.fakes import TAG, Service

T0 = 1_769_860_800.0


def test_a_gap_is_an_entry_of_nulls(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    listening = Listening(service.jobs.directory.loops, service.store, on=False)
    rings = Rings()
    for n, gap in ((1, GAP_BEFORE), (2, 0), (300, GAP_BEFORE), (301, 0)):
        rings.put(T0 + 0.1 * n, n, 50.0 + n, 40.0, float("nan") if n == 1 else 50.0, 0, 2, gap)

    def memory(tag: str, from_s: float, to_s: float, points: int) -> Rows:
        assert abs(to_s - from_s - 60.0) < 1e-3
        return rings.rows(T0, T0 + 60.0, points) if tag == TAG else Rows()

    monkeypatch.setattr(listening, "memory", memory)
    with TestClient(app_of(service.jobs, listening=listening)) as client:
        found = client.get("/history", params={"seconds": 60, "points": 100}).json()
        assert [loop for loop in found["loops"] if loop["tag"] == TAG] == [
            {
                "tag": TAG,
                "at_s": [T0 + 0.1, T0 + 0.2, None, T0 + 30.0, T0 + 30.1],
                "pv_min": [51.0, 52.0, None, 350.0, 351.0],
                "pv_max": [51.0, 52.0, None, 350.0, 351.0],
                "sp": [None, 50.0, None, 50.0, 50.0],
            }
        ]
        few = client.get("/history", params={"seconds": 60, "points": 2}).json()["loops"][-1]
        assert [each for each in few["pv_max"] if each is not None] == [52.0, 351.0]
        assert [each for each in few["pv_min"] if each is not None] == [51.0, 350.0]


def test_a_loop_that_is_not_heard_is_empty(client: TestClient) -> None:
    found = client.get("/history").json()
    assert found["loops"][-1] == {"tag": TAG, "at_s": [], "pv_min": [], "pv_max": [], "sp": []}
    assert abs(found["to_s"] - found["from_s"] - 300.0) < 0.01


@pytest.mark.parametrize("query", ["seconds=0", "seconds=nan", "seconds=1e9", "points=0", "points=501"])
def test_what_means_nothing_is_422(client: TestClient, query: str) -> None:
    assert client.get(f"/history?{query}").status_code == 422
