"""Plants and controllers as the papers write them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from loopwright.tuning.gains import Gains
from loopwright.tuning.models import FOPDT, SOPDT, Reals, TransferFunction
from validation.references import References

FIVE_LAGS = TransferFunction((1.0,), (1.0, 5.0, 10.0, 10.0, 5.0, 1.0))
"""1/(s+1)^5, the example of the five-stage paper."""


def plant(entry: dict[str, Any]) -> TransferFunction:
    """Of the 50 models, of the pole-placement and of the ME-PSO paper."""
    dead_time = entry.get("delay", entry.get("dead_time", 0.0))
    return TransferFunction(tuple(entry["num"]), tuple(entry["den"]), float(dead_time))


def sopdt(references: References, name: str) -> SOPDT:
    """An object of the direct-synthesis paper."""
    o = references.rules["direct_synthesis"]["objects"][name]
    return SOPDT(K=o["K"], T1=o["T1"], T2=o["T2"], L=o["L"])


def moments(references: References, name: str) -> FOPDT:
    """The FOPDT by moments of a plant of the ME-PSO paper, in closed form: its plants have multiple poles."""
    p = references.rules["me_pso"]["plants"][name]
    mean = sum(p["lags"]) - sum(p["zeros"]) + p["L"]
    T = math.sqrt(sum(x * x for x in p["lags"]) - sum(x * x for x in p["zeros"]))
    return FOPDT(1.0, T, mean - T)


def ideal_pid(Kp: float, Ti: float, Td: float) -> Gains:
    """The derivative on the error and without a filter, as in the papers on direct synthesis and IMC."""
    return Gains(Kp, Ti, Td, c=1.0)


def of_numerator(C: list[float]) -> Gains:
    """Of the pole-placement paper's (C0 s + C1)/s or (C0 s^2 + C1 s + C2)/s."""
    if len(C) == 2:
        return Gains(C[0], C[0] / C[1])
    return Gains(C[1], C[1] / C[2], C[0] / C[1], c=1.0)


def numerator(gains: Gains) -> list[float]:
    pi = [gains.Kp, gains.Kp / gains.Ti]
    return [gains.Kp * gains.Td, *pi] if gains.Td else pi


def samples(t: Reals, y: Reals, end: float, step: float) -> tuple[Reals, Reals]:
    """A response on a uniform grid from 0 to `end`, s."""
    grid: Reals = np.asarray(step * np.arange(round(end / step) + 1), dtype=float)
    return grid, np.asarray(np.interp(grid, t, y))
