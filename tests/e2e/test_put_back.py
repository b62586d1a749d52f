"""The previous gains come back by themselves on a live bus: after an acceptance the plant's gain rises, and PV
oscillates with swings that grow.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from tests.e2e.plantsite import MODEL_14, Plantsite

pytestmark = pytest.mark.timeout(400)
LOOP = replace(MODEL_14, kp=30.0, ti=6.0, pv_limits=(40.0, 60.0))
PACE = 4.0
RISES_TO = 3.3
"""Times the gain of the plant: under the new gains each period is then 1.4 times as large as the one before, under the
old ones the loop is stable."""
DESIGNED = {
    "method": "fast", "start": "design", "model": {"num": [0.03, 0.02], "den": [3.0, 4.0, 1.0], "dead_time_s": 1.0},
    "verify": False, "propose_anyway": True,
}  # fmt: skip
"""A proposal without a test: the model of the loop is given."""


@pytest.fixture
def here(bus: str, tmp_path: Path) -> Iterator[Plantsite]:
    with ExitStack() as stack:
        site = Plantsite(stack, tmp_path, LOOP, bus)
        site.at_rest(PACE)
        yield site


def test_gains_under_which_an_oscillation_grows_are_taken_back(here: Plantsite) -> None:
    url = here.retune(**DESIGNED)
    assert here.finished(url)["state"] == "proposed"
    assert here.http.post(f"{url}/accept", json={"by": "A. Lind"}).status_code == 200
    accepted = here.state().gains
    here.until_watched(url, lambda watch: watch["no_data"] is None)
    here.write("plant_gain", RISES_TO)
    here.write("plant_disturbance", 0.02)

    watch = here.until_watched(url, lambda watch: watch["trouble"] and watch["trouble"]["rolled_back"] is not None)
    trouble = watch["trouble"]
    assert (trouble["kind"], trouble["rolled_back"], trouble["reason"]) == ("growing_oscillation", True, None), trouble
    assert "PV oscillates under the new gains with a period of 3." in trouble["text"]
    assert here.job(url)["state"] == "rolled_back" and watch["end"] == "rolled_back"
    state = here.state()
    assert (state.gains.Kp, state.gains.Ti) == pytest.approx((LOOP.kp, LOOP.ti)) and state.gains != accepted
    assert here.is_home()
    latest = here.http.get("/audit").json()[0]
    assert (latest["what"], latest["by"], latest["subject"]) == ("rollback", "monitoring after acceptance", job_of(url))


def job_of(url: str) -> str:
    return url.rsplit("/", 1)[1]
