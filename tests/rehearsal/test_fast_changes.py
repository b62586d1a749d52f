"""Plants that change as the new gains take over, or are not linear, once proposed for with a story of loads."""

from __future__ import annotations

import pytest

from benchmarks.cases import FURTHER
from benchmarks.plants import plants
from benchmarks.tuning import measure

PLANTS = {plant.name: plant for plant in plants()}


@pytest.mark.parametrize(
    ("plant", "case", "seed"),
    [
        ("P7_T=1_L1=0.02", "gain falls to 0.4 with them", 1),
        ("P7_T=1_L1=0.02", "dead time 0.25 Pu longer with them", 1),
        ("P2_T=20", "gain falls to 0.4 with them", 2),
        ("P2_T=200", "gain falls to 0.4 with them", 1),
        ("reactor", "nonlinear reactor, 15 %", 2),
    ],
)
def test_a_load_that_the_relay_had_not_shown_is_not_believed(plant: str, case: str, seed: int) -> None:
    ran = measure(FURTHER[case], PLANTS[plant], seed)
    assert ran.reason is not None, f"proposed, Ms {ran.Ms}"
