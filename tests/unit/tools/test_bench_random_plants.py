"""The plants drawn at random: the same ones for the same number, each with an ultimate point that is its own."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from benchmarks.plants import Plant, plants
from benchmarks.random_plants import KINDS, random_plant, random_plants

DRAWN = random_plants(range(60))


def test_a_number_draws_one_plant() -> None:
    assert random_plant(1007) == random_plant(1007) == random_plants(range(1000, 1010))[7]
    assert len({each.name for each in DRAWN}) == len(DRAWN) == 60
    assert not {each.name for each in DRAWN} & {each.name for each in plants()}


def test_every_kind_is_drawn() -> None:
    assert {each.name.rsplit("-", 1)[0] for each in DRAWN} == set(KINDS)


@pytest.mark.parametrize("plant", DRAWN[::6], ids=lambda plant: plant.name)
def test_it_oscillates_at_its_ultimate_point(plant: Plant) -> None:
    """By complex numbers alone: 1 + Ku G(i wu) is zero there, with the sign of the plant's gain."""
    s = 2j * math.pi / plant.Pu
    G = complex(np.polyval(plant.num, s) / np.polyval(plant.den, s)) * cmath.exp(-s * plant.L)
    assert abs(1.0 + math.copysign(plant.Ku, plant.num[-1]) * G) == pytest.approx(0.0, abs=1e-6)
