"""The plants in trouble, gain 1 and times in seconds, and those that are trouble by their poles alone."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.plants import Plant, plant_of
from loopwright.tuning.models import TransferFunction

MODES = 10
"""Of a rod: its slowest, by which it is simulated; the faster ones are a dead time."""


@cache
def trouble_plants() -> tuple[Plant, ...]:
    """On which each kind of trouble is tried."""
    return (
        plant_of("lag, dead time 0.3", TransferFunction((1.0,), (1.0, 1.0), 0.3)),
        plant_of("lag, dead time 1", TransferFunction((1.0,), (1.0, 1.0), 1.0)),
        plant_of("two lags, dead time 0.2", TransferFunction((1.0,), (1.0, 2.0, 1.0), 0.2)),
    )


def slower_lag(plant: Plant, T_s: float, dead_time: float = 1.0) -> Plant:
    """With one more lag in series, and so many times the dead time."""
    return _with(replace(plant, L=dead_time * plant.L), plant.num, np.convolve(plant.den, (T_s, 1.0)))


def creep(plant: Plant, share: float, T_s: float) -> Plant:
    """With a part of the effect through one more lag: G (1 - share + share/(T s + 1))."""
    num = np.convolve(plant.num, ((1.0 - share) * T_s, 1.0))
    return _with(plant, num, np.convolve(plant.den, (T_s, 1.0)))


def resonant(plant: Plant, frequency: float, damping: float) -> Plant:
    """In series with a lightly damped mode of gain 1; frequency: in those at which the plant without it is ultimate."""
    w = frequency * 2.0 * math.pi / plant.Pu
    return replace(plant, den=tuple(np.convolve(plant.den, (1.0 / w**2, 2.0 * damping / w, 1.0))))


def antiresonant(plant: Plant, frequency: float, damping: float, apart: float) -> Plant:
    """With a mode and, at a frequency so many times as high, a notch of the same damping: a slow swing beside the main
    effect, such as sloshing."""
    w = frequency * 2.0 * math.pi / plant.Pu
    num = np.convolve(plant.num, (1.0 / (apart * w) ** 2, 2.0 * damping / (apart * w), 1.0))
    return replace(resonant(plant, frequency, damping), num=tuple(num))


def rod(plant: Plant, kind: str) -> Plant:
    """Heat along a rod of diffusion time 1 s, by the product of its modes; a tenth of the plant's dead time more.

    cosh: 1/cosh(sqrt(s)), the far end of an insulated rod.  mid, near: cosh(x sqrt(s))/cosh(sqrt(s)), x 0.5 and 0.8 of
    the rod from that end.  tanh: tanh(sqrt(s))/sqrt(s), where the heat enters.
    """
    k = np.arange(1, MODES + 1)
    poles = ((k - 0.5) * math.pi) ** 2
    # the zeros, and the sum of the time constants of all of them: those of the poles make 1/2
    zeros, leads_s = {
        "cosh": (poles[:0], 0.0),
        "mid": (poles[:-1] / 0.5**2, 0.5**3),
        "near": (poles[:-1] / 0.8**2, 0.5 * 0.8**2),
        "tanh": ((k[:-1] * math.pi) ** 2, 1.0 / 6.0),
    }[kind]
    faster_s = (0.5 - float(np.sum(1.0 / poles))) - (leads_s - float(np.sum(1.0 / zeros)))
    num, den = (np.atleast_1d(np.poly(-roots) / np.prod(roots)) for roots in (zeros, poles))
    return plant_of(plant.name, TransferFunction(tuple(num), tuple(den), 0.1 * plant.L + max(faster_s, 0.0)))


def _with(plant: Plant, num: Iterable[float], den: Iterable[float]) -> Plant:
    return plant_of(plant.name, TransferFunction(tuple(map(float, num)), tuple(map(float, den)), plant.L))
