"""Plants drawn at random: lags, zeros, inverse responses, modes, integrators, dead time.

A number draws one plant. Numbers below 1000 are for the development of rules, those from 1000 on for judging
them: no rule is set on those.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.plants import Plant, plant_of
from loopwright.tuning.models import Reals, TransferFunction
from loopwright.tuning.reasons import Ended

SEED = 77
LAGS_S = (0.05, 10.0)
DEAD_TIME = (0.02, 2.0)
"""Range of the dead time, in sums of the lags."""
MAX_GAIN = 200.0
"""Largest ultimate gain times gain: beyond that the plant has next to no dead time."""
Random = np.random.Generator


def random_plants(numbers: range) -> list[Plant]:
    """The plants of these numbers."""
    return [random_plant(number) for number in numbers]


def random_plant(number: int) -> Plant:
    """The first plant of this number that can oscillate under proportional control."""
    random = np.random.default_rng([SEED, number])
    return next(plant for plant in _drawn(random, number) if plant is not None)


def _drawn(random: Random, number: int) -> Iterator[Plant | None]:
    """One plant after the other, None where a plant cannot oscillate."""
    while True:
        kind = str(random.choice(list(KINDS), p=[2.0 / 7.0] + 5 * [1.0 / 7.0]))
        num, den, lags = KINDS[kind](random)
        gain = _between(random, math.exp(-1.0), math.exp(1.0)) * float(random.choice([1.0, 1.0, 1.0, -1.0]))
        dead_time = float(lags.sum()) * _between(random, *DEAD_TIME)
        try:
            plant = plant_of(f"{kind}-{number}", TransferFunction(tuple(gain * num), tuple(den), dead_time))
        except Ended:
            yield None
            continue
        yield plant if plant.Ku * abs(gain) < MAX_GAIN else None


def _between(random: Random, low: float, high: float) -> float:
    """A number whose logarithm is even between these."""
    return float(np.exp(random.uniform(math.log(low), math.log(high))))


def _lags(random: Random, least: int = 1) -> Reals:
    count = int(random.integers(least, 5))
    return np.exp(random.uniform(math.log(LAGS_S[0]), math.log(LAGS_S[1]), count))


def _product(lags: Reals) -> Reals:
    """The denominator of these lags, highest power first."""
    return np.asarray(np.poly(-1.0 / lags) * np.prod(lags))


Drawn = tuple[Reals, Reals, Reals]
"""Numerator and denominator, highest power first, and the lags, s."""


def _of_lags(random: Random) -> Drawn:
    lags = _lags(random)
    return np.array([1.0]), _product(lags), lags


def _of_equal_lags(random: Random) -> Drawn:
    lags = np.ones(int(random.integers(2, 8)))
    return np.array([1.0]), _product(lags), lags


def _with_a_zero(random: Random) -> Drawn:
    lags = _lags(random, least=2)
    return np.array([_between(random, 0.1, 1.0) * float(lags.max()), 1.0]), _product(lags), lags


def _with_an_inverse_response(random: Random) -> Drawn:
    lags = _lags(random, least=2)
    return np.array([-float(random.uniform(0.1, 1.0) * lags.max()), 1.0]), _product(lags), lags


def _with_a_mode(random: Random) -> Drawn:
    lags, w, damping = _lags(random), _between(random, 0.2, 5.0), float(random.uniform(0.25, 0.9))
    den = np.asarray(np.polymul(_product(lags), [1.0 / w**2, 2.0 * damping / w, 1.0]), float)
    return np.array([1.0]), den, lags


def _integrating(random: Random) -> Drawn:
    lags = _lags(random)
    return np.array([1.0]), np.append(_product(lags), 0.0), lags


KINDS: dict[str, Callable[[Random], Drawn]] = {
    "lags": _of_lags,
    "equal lags": _of_equal_lags,
    "zero": _with_a_zero,
    "inverse response": _with_an_inverse_response,
    "mode": _with_a_mode,
    "integrating": _integrating,
}
